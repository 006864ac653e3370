"""What a point can be coloured by: any attribute of the table, as one byte a point, with what the byte means."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.dimensions import Dimension, in_order

Values = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]

NO_VALUE: Final = 255
"""The byte of a value that is not a number, or is none of the kinds that are named."""
_MOST_KINDS: Final = 40
"""Whole numbers with more values than this are shown as a scale."""
_ALL_KINDS: Final = ("classification",)
"""Whole numbers that are kinds however many there are: classes of other programs, and those that a lasso gives."""
_COLOURS: Final = ("red", "green", "blue")
_MEASURES: Final = ("intensity", *_COLOURS, "nir")
"""Whole numbers that are a scale however few values they take."""
_STEPS: Final = 254
_SHOWN: Final = (1.0, 99.0)
"""Percentiles between which colours span at first: single wild values would take all of them."""
TIME: Final = "gps_time"


@dataclass(frozen=True, slots=True)
class Shade:
    """One attribute as bytes.

    Attributes
    ----------
    name, label, unit : str
    kinds : tuple of int
        Values of an attribute that tells kinds apart; empty: it is a scale.
    by_code : bool
        The byte of a kind is its value; else its rank among `kinds`.
    low, step : float
        The value of byte 0, and of one step, where it is a scale.
    shown : tuple of float
        Values between which colours span at first.
    """

    name: str
    label: str
    unit: str
    kinds: tuple[int, ...] = ()
    by_code: bool = False
    low: float = 0.0
    step: float = 1.0
    shown: tuple[float, float] = (0.0, 1.0)

    def encode(self, values: Values) -> Bytes:
        """Bytes of values, shape (n,)."""
        if self.kinds:
            if self.by_code:
                return np.asarray(values, np.uint8)
            order = np.asarray(self.kinds)
            rank = np.minimum(np.searchsorted(order, values), len(order) - 1)
            return np.where(order[rank] == values, rank, NO_VALUE).astype(np.uint8)
        out = np.empty(len(values), np.uint8)
        _encode(np.ascontiguousarray(values, np.float64), self.low, self.step, out)
        return out

    def plain(self) -> dict[str, Any]:
        """For the page."""
        return {
            "name": self.name, "label": self.label, "unit": self.unit, "kinds": list(self.kinds), "byCode": self.by_code,
            "low": self.low, "step": self.step, "shown": list(self.shown),
        }  # fmt: skip


def shades_of(columns: Mapping[str, Values], time_s: Values | None, keep: Sequence[str] = ()) -> list[Shade]:
    """The attributes of some points that tell something: those with one value only do not.

    Parameters
    ----------
    columns : mapping of str to ndarray
        As in `Points`.
    time_s : ndarray, optional
        From the first point on.
    keep : sequence of str
        Columns that are wanted whatever they hold.
    """
    found = []
    for entry in in_order(columns):
        values = np.asarray(columns[entry.name])
        if entry.name in keep or _tells(values):
            found.append(_kinds(entry, values) or _scale(entry.name, entry.brief, entry.unit, values))
    if time_s is not None and _tells(time_s):
        found.append(_scale(TIME, "time", "s", time_s))
    return found


def _tells(values: Values) -> bool:
    """Whether not all of them are the same."""
    known = values[np.isfinite(values)]
    return len(known) > 0 and bool(known.min() != known.max())


def _kinds(entry: Dimension, values: Values) -> Shade | None:
    """An attribute that tells kinds apart; None where it is a scale."""
    if entry.scale is not None or entry.unit or entry.stored.kind not in "ui" or entry.name in _MEASURES:
        return None
    kinds = tuple(int(each) for each in np.unique(values))
    if len(kinds) > _MOST_KINDS and entry.name not in _ALL_KINDS:
        return None
    return Shade(entry.name, entry.brief, "", kinds, entry.stored == np.uint8)


def _scale(name: str, label: str, unit: str, values: Values) -> Shade:
    known = np.asarray(values, np.float64)
    known = known[np.isfinite(known)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    step = (high - low) / _STEPS or 1.0
    if name in _COLOURS:  # together they are one: from black on, in steps of the one byte or the two that they are in
        low, step = 0.0, 257.0 if high > 255.0 else 1.0
    elif values.dtype.kind in "ui" and high - low <= _STEPS:
        step = 1.0  # every value as it is
    shown = np.percentile(known, _SHOWN) if len(known) else np.array([low, high])
    return Shade(name, label, unit, low=low, step=step, shown=(float(shown[0]), float(shown[1])))


@njit(cache=True, nogil=True)
def _encode(values: Any, low: float, step: float, out: Any) -> None:
    """Fill in the bytes of a scale."""
    for i in range(len(values)):
        steps = np.rint((values[i] - low) / step)
        out[i] = np.uint8(min(max(steps, 0.0), np.float64(_STEPS))) if np.isfinite(steps) else np.uint8(NO_VALUE)
