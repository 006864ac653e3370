"""Classes changed by loops drawn around points: what the page does to the points that it shows, done to the whole cloud.

A loop holds in the picture that it was drawn in, so each edit brings the matrix of that picture. The rules are those of
`web/measure.js`: even-odd, points behind the eye and outside of a section are not meant, nor are classes that were hidden.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import UsageError
from groundproc.cloud.reader import Cloud, chunks
from groundproc.cloud.rewriter import Rewriter

Array = npt.NDArray[np.float64]
Classes = npt.NDArray[np.uint8]

_MOST_CORNERS: Final = 2_000
MOST_EDITS: Final = 10_000
_OLD_FORMATS: Final = 6
"""Point formats below have five bits for the class (LAS 1.4 R15, table 8)."""


@dataclass(frozen=True, slots=True)
class Slab:
    """A section: what lies within `half` of a line in plan, and between its ends.

    Attributes
    ----------
    across, along : tuple of float
        Direction (x, y), place of the middle along it, half of the width [m].
    """

    across: tuple[float, float, float, float]
    along: tuple[float, float, float, float]

    def holds(self, local_m: Array) -> npt.NDArray[np.bool_]:
        """Which of some places, shape (n, 3), lie in it."""
        inside = np.ones(len(local_m), np.bool_)
        for x, y, middle, half in (self.across, self.along):
            inside &= np.abs(x * local_m[:, 0] + y * local_m[:, 1] - middle) <= half
        return inside


@dataclass(frozen=True, slots=True)
class Edit:
    """One loop.

    Attributes
    ----------
    matrix : ndarray, shape (4, 4)
        From places, counted from the scene's origin, to the picture: x and y from -1 to 1 after division by the last.
    loop : ndarray, shape (k, 2)
        Corners in the picture.
    to : int
        The class that points get.
    of : tuple of int or None
        Classes that are meant; None: all.
    slab : Slab or None
    """

    matrix: Array
    loop: Array
    to: int
    of: tuple[int, ...] | None
    slab: Slab | None

    def meant(self, local_m: Array, classes: Classes) -> npt.NDArray[np.bool_]:
        """Which of some points, shape (n, 3), it changes."""
        meant = classes != self.to
        if self.of is not None:
            meant &= np.isin(classes, self.of)
        if self.slab is not None:
            meant &= self.slab.holds(local_m)
        at = np.flatnonzero(meant)
        homogeneous = local_m[at] @ self.matrix[:, :3].T + self.matrix[:, 3]
        ahead = homogeneous[:, 3] > 0.0
        at, place = at[ahead], homogeneous[ahead, :2] / homogeneous[ahead, 3:]
        near = ((place >= self.loop.min(axis=0)) & (place <= self.loop.max(axis=0))).all(axis=1)
        at, place = at[near], place[near]
        found = np.zeros(len(classes), np.bool_)
        found[at[_within(self.loop, place)]] = True
        return found


def _within(loop: Array, place: Array) -> npt.NDArray[np.bool_]:
    """Even-odd rule for places, shape (n, 2)."""
    inside = np.zeros(len(place), np.bool_)
    x, y = place[:, 0], place[:, 1]
    for (ax, ay), (bx, by) in zip(loop.tolist(), np.roll(loop, 1, axis=0).tolist(), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
    return inside


def edits_of(tree: Any) -> list[Edit]:
    """Edits as the page sends them.

    Raises
    ------
    UsageError
        They are none.
    """
    if not isinstance(tree, list) or len(tree) > MOST_EDITS:
        raise UsageError(f"edits: expected a list of {MOST_EDITS} at most")
    return [_edit(each) for each in tree]


def _edit(tree: Any) -> Edit:
    try:
        matrix = _numbers(tree["matrix"], (16,)).reshape(4, 4).T  # the page's are column by column
        loop = _numbers(tree["loop"], (len(tree["loop"]), 2))
        slab = None
        if tree.get("slab") is not None:
            across, along = (tuple(_numbers(tree["slab"][name], (4,)).tolist()) for name in ("plane", "ends"))
            slab = Slab(across, along)
        of = None if tree.get("of") is None else tuple(_class(each) for each in tree["of"])
        edit = Edit(matrix, loop, _class(tree["to"]), of, slab)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UsageError(f"edits: {error} found, expected a matrix, a loop and a class") from None
    if not 3 <= len(edit.loop) <= _MOST_CORNERS:
        raise UsageError(f"edits: a loop of {len(edit.loop)} corners found, expected 3 to {_MOST_CORNERS}")
    return edit


def _numbers(values: Any, shape: tuple[int, ...]) -> Array:
    found = np.asarray(values, np.float64)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"numbers of shape {found.shape}")
    return found


def _class(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 255:
        raise ValueError(f"class {value!r}")
    return value


def apply(edits: Sequence[Edit], local_m: Array, classes: Classes) -> Classes:
    """Classes after all edits, one after the other."""
    found = classes.copy()
    for edit in edits:
        found[edit.meant(local_m, found)] = edit.to
    return found


def write_edited(
    cloud: Cloud,
    origin_m: Array,
    edits: Sequence[Edit],
    path: Path,
    compressed: bool = True,
    go_on: Callable[[], None] = lambda: None,
) -> int:
    """Write the cloud anew with other classes and nothing else changed; how many points changed.

    Parameters
    ----------
    cloud : Cloud
    origin_m : ndarray, shape (3,)
        Of the scene that the loops were drawn in.
    edits : sequence of Edit
    path : Path
        Written to in place: the caller writes aside.
    compressed : bool
        LAZ; else LAS.
    go_on : callable
        Called every some points; what it raises ends the work.

    Raises
    ------
    CaptureError, SourceError, UsageError
        The cloud is damaged, the file cannot be written, or the cloud cannot hold a class.
    """
    changed = 0
    with Rewriter(cloud, path, compressed) as writer:
        for chunk in chunks(cloud, columns=("classification",)):
            go_on()
            classes = chunk.points["classification"]
            after = apply(edits, chunk.points.xyz_m - origin_m, classes)
            if (after != classes).any():
                most = 31 if chunk.record.point_format.id < _OLD_FORMATS else 255
                if after.max() > most:
                    raise UsageError(f"{cloud.path}: class {after.max()} found, but its points can hold {most} at most")
                chunk.record.classification = after
                changed += int((after != classes).sum())
            writer.write(chunk.record)
    return changed
