"""Which points are wanted: by time, by area, by flight line, by class; and how many each choice left out."""

from collections.abc import Collection, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import shapely

from groundproc.cloud.classes import NO_SURFACE
from groundproc.cloud.points import Points

Mask = npt.NDArray[np.bool_]
Spans = npt.NDArray[np.int64]
"""Spans of time, shape (k, 2): first instant and the one after the last [ns]."""

_CLASS, _LINE = "classification", "point_source_id"
_ALL_CLASSES: Final = 256


class Choice(Protocol):
    """One condition on points."""

    @property
    def name(self) -> str:
        """What points that it leaves out are counted under."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Attributes that it looks at, where points have them."""

    def keeps(self, points: Points) -> Mask:
        """Which points it keeps, shape (n,)."""


@dataclass(frozen=True, slots=True)
class Times:
    """By the time at which the laser was fired.

    Attributes
    ----------
    name : str
    spans_ns : ndarray of int64, shape (k, 2)
        In UTC, in any order.
    within : bool
        What lies within them is kept; else it is left out.
    """

    name: str
    spans_ns: Spans
    within: bool = True
    columns: tuple[str, ...] = ()

    def keeps(self, points: Points) -> Mask:
        """See `Choice`."""
        inside = np.zeros(len(points), np.bool_)
        if not len(points):
            return inside
        low, high = int(points.time_ns.min()), int(points.time_ns.max())
        for start, end in self.spans_ns:
            if start <= high and end > low:
                inside |= (points.time_ns >= start) & (points.time_ns < end)
        return inside if self.within else ~inside


@dataclass(frozen=True, slots=True)
class Area:
    """By an area on the map.

    Attributes
    ----------
    shape : shapely geometry
        In the horizontal CRS of the points.
    outside : bool
        What lies outside of it is kept; else what lies within.
    """

    shape: Any
    outside: bool = False
    name: str = "area"
    columns: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        shapely.prepare(self.shape)

    def keeps(self, points: Points) -> Mask:
        """See `Choice`; who lies on the edge, lies within."""
        x, y = points.xyz_m[:, 0], points.xyz_m[:, 1]
        west, south, east, north = self.shape.bounds
        inside = np.asarray((x >= west) & (x <= east) & (y >= south) & (y <= north))
        inside[inside] = shapely.intersects_xy(self.shape, x[inside], y[inside])
        return ~inside if self.outside else inside


@dataclass(frozen=True, slots=True)
class Lines:
    """By flight line: `point_source_id`."""

    numbers: frozenset[int]
    name: str = "lines"
    columns: tuple[str, ...] = (_LINE,)

    def keeps(self, points: Points) -> Mask:
        """See `Choice`."""
        return np.isin(points[_LINE], np.array(sorted(self.numbers), np.int64))


@dataclass(frozen=True, slots=True)
class Classes:
    """By class: points of these are left out; points that have no class are kept."""

    left_out: frozenset[int] = frozenset(NO_SURFACE)
    name: str = "classes"
    columns: tuple[str, ...] = (_CLASS,)

    def keeps(self, points: Points) -> Mask:
        """See `Choice`."""
        if _CLASS not in points:
            return np.ones(len(points), np.bool_)
        kept = np.ones(_ALL_CLASSES, np.bool_)
        kept[list(self.left_out)] = False
        return np.asarray(kept[points[_CLASS]])


SURFACES: Final = Classes()
"""What stands: neither noise nor what moved."""


def standing(points: Points, all_classes: bool = False) -> Mask:
    """THE rule for commands that make surfaces of some points and write all of them: of which surfaces are made, shape (n,).

    Those that write none of the points leave the others out as they read: `reader.look(path, SURFACES)`.

    Parameters
    ----------
    points : Points
        With the column `classification` where the cloud has one.
    all_classes : bool
        The user wants noise and what moves in surfaces too.
    """
    return np.ones(len(points), np.bool_) if all_classes else SURFACES.keeps(points)


CLASS: Final = _CLASS
"""The column that the rule looks at."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Several choices, one after the other.

    Attributes
    ----------
    choices : sequence of Choice
    left_out : dict of str to int
        Points that each choice has left out, by the one met first; counted as they pass.
    """

    choices: Sequence[Choice]
    left_out: MutableMapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for each in self.choices:
            self.left_out.setdefault(each.name, 0)

    def mask(self, points: Points) -> Mask | None:
        """Which of some points are wanted, shape (n,); None: all of them."""
        wanted = np.ones(len(points), np.bool_)
        left = len(points)
        for each in self.choices:
            wanted &= each.keeps(points)
            now = int(np.count_nonzero(wanted))
            self.left_out[each.name] += left - now
            left = now
        return None if left == len(points) else wanted

    def of(self, points: Points, columns: Collection[str] | None = None) -> Points:
        """Those of some points that are wanted, with all columns or some of those they have."""
        wanted = self.mask(points)
        if columns is not None:
            points = replace(points, columns={name: points[name] for name in columns if name in points})
        return points if wanted is None else points.masked(wanted)
