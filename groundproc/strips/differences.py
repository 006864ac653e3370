"""What overlapping strips differ by: two planes of one voxel, one of each strip, along their normal."""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics import robust
from groundproc.numerics.planes import flattest_of
from groundproc.strips.clusters import Gatherer

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

LEVEL: Final = 0.94
"""Planes with a steeper normal than this upward part (20 deg) tell heights; the others tell plan."""
FEWEST: Final = 8
"""Points of a strip's plane."""
_ALIKE: Final = 0.985
"""Cosine between the normals of two planes that are one surface (10 deg)."""
_MOST: Final = 64
"""Strips that are compared in one voxel, at most."""
_LIMIT: Final = 600_000
"""Voxels of strips that are kept."""


class Patches:
    """Collects the planes of all strips from points; in voxels other than those of the adjustment, by half an edge.

    Parameters
    ----------
    voxel_m : float
    """

    def __init__(self, voxel_m: float) -> None:
        self.voxel_m = voxel_m
        self._cells = Gatherer(voxel_m, _LIMIT, merge=True)

    def add(self, xyz_m: Array, strip: npt.NDArray[np.int32]) -> None:
        """Take points, shape (n, 3); those of strip -1 are left out."""
        chosen = strip >= 0
        xyz, of = xyz_m[chosen] + 0.5 * self.voxel_m, strip[chosen]
        none = np.broadcast_to(np.float64(0.0), (len(of), 4))
        self._cells.add(np.zeros(len(of), np.int64), xyz, none[:, :3], none, of, of.astype(np.int64))

    def cells(self) -> npt.NDArray[np.void]:
        """Points by voxel and strip, as `clusters.CLUSTER`; places are half an edge more than they were given."""
        return self._cells.clusters()

    def differences(self) -> "Differences":
        """Differences of all pairs of strips."""
        cells = self.cells()
        index = np.floor(cells["place"] / self.voxel_m).astype(np.int64)
        order = np.lexsort((cells["strip"], index[:, 2], index[:, 1], index[:, 0]))
        cells, index = cells[order], index[order]
        new = np.ones(len(cells) + 1, np.bool_)
        new[1:-1] = (np.diff(index, axis=0) != 0).any(axis=1)
        planes = _Planes(cells["place"], cells["scatter"], cells["count"], cells["strip"])
        first = np.flatnonzero(new)
        count = _pairs(first, planes, self.voxel_m, np.empty((0, 8)), np.empty((0, 2), np.int32))
        value, strips = np.empty((count, 8)), np.empty((count, 2), np.int32)
        _pairs(first, planes, self.voxel_m, value, strips)
        value[:, 4:7] -= 0.5 * self.voxel_m
        return Differences(value[:, 0], value[:, 1:4], value[:, 4:7], value[:, 7], strips)


class _Planes(NamedTuple):
    """Points of one voxel and strip, those of a voxel after each other.

    Attributes
    ----------
    place_m : ndarray, shape (n, 3)
        Their mean.
    scatter_m2 : ndarray of float32, shape (n, 6)
    points, strip : ndarray of int32, shape (n,)
    """

    place_m: Array
    scatter_m2: npt.NDArray[np.float32]
    points: npt.NDArray[np.int32]
    strip: npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Differences:
    """Differences between strips.

    Attributes
    ----------
    along_m : ndarray, shape (n,)
        Later strip less earlier one, along the normal.
    normal : ndarray, shape (n, 3)
        Up; of walls to the east.
    place_m : ndarray, shape (n, 3)
    sigma_m : ndarray, shape (n,)
        What the scatter of the points lets expect.
    strips : ndarray of int32, shape (n, 2)
    """

    along_m: Array
    normal: Array
    place_m: Array
    sigma_m: Array
    strips: npt.NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.along_m)

    def height_m(self) -> Array:
        """Differences in height, of level planes."""
        level = self.normal[:, 2] > LEVEL
        return np.asarray(self.along_m[level] / self.normal[level, 2])

    def plan_m(self) -> Array:
        """Differences in plan, of slopes and walls: along their steepest line."""
        steep = self.normal[:, 2] <= LEVEL
        return np.asarray(self.along_m[steep] / np.hypot(self.normal[steep, 0], self.normal[steep, 1]))

    def summary(self) -> dict[str, Any]:
        """Figures of all, of heights and of plan."""
        return {"normal": figures(self.along_m), "height": figures(self.height_m()), "plan": figures(self.plan_m())} | {
            "expected_sigma_m": _rounded(np.median(self.sigma_m)) if len(self) else None
        }

    def by_pair(self, most: int = 200) -> list[dict[str, Any]]:
        """Figures of the pairs of strips, those with most patches first."""
        if not len(self):
            return []
        pairs, which, count = np.unique(self.strips, axis=0, return_inverse=True, return_counts=True)
        which = which.ravel()
        chosen = np.argsort(-count, kind="stable")[:most]
        return [
            {"strips": pairs[i].tolist()} | figures(self.along_m[which == i])
            for i in chosen.tolist()
        ]  # fmt: skip


def figures(value: Array) -> dict[str, Any]:
    """Count, median, sigmaMAD (`numerics.robust`), the median magnitude, and RMS."""
    if not len(value):
        return {"count": 0, "median_m": None, "sigma_mad_m": None, "median_abs_m": None, "rms_m": None}
    median = float(np.median(value))
    return {
        "count": len(value),
        "median_m": _rounded(median),
        "sigma_mad_m": _rounded(robust.sigma(value, median)),
        "median_abs_m": _rounded(np.median(np.abs(value))),
        "rms_m": _rounded(np.sqrt(np.mean(np.square(value)))),
    }


def _rounded(value: Any) -> float:
    return round(float(value), 5)


@njit(cache=True, nogil=True)
def _pairs(first: Ints, planes: _Planes, voxel_m: float, value: Array, strips: npt.NDArray[np.int32]) -> int:
    """Count pairs of planes of one voxel, and fill them in where there is room: difference, normal, place, sigma."""
    place, scatter, count, strip = planes.place_m, planes.scatter_m2, planes.points, planes.strip
    found, fill = 0, len(value) > 0
    normals, low = np.empty((_MOST, 3)), np.empty(_MOST)
    for v in range(len(first) - 1):
        start, end = first[v], min(first[v + 1], first[v] + _MOST)
        if end - start < 2:
            continue
        for i in range(start, end):
            low[i - start] = _thickness(scatter[i], count[i], voxel_m, normals[i - start])
        for i in range(start, end):
            for j in range(i + 1, end):
                a, b = i - start, j - start
                dot = normals[a, 0] * normals[b, 0] + normals[a, 1] * normals[b, 1] + normals[a, 2] * normals[b, 2]
                if low[a] < 0.0 or low[b] < 0.0 or abs(dot) < _ALIKE:
                    continue
                if fill:
                    _difference(normals[a], normals[b], 1.0 if dot > 0.0 else -1.0, place[i], place[j], value[found])
                    value[found, 7] = np.sqrt(low[a] / count[i] + low[b] / count[j])
                    strips[found, 0], strips[found, 1] = strip[i], strip[j]
                found += 1
    return found


@njit(cache=True, nogil=True)
def _thickness(scatter: npt.NDArray[np.float32], count: int, voxel_m: float, normal: Array) -> Any:
    """Variance across the plane of some points; negative where they are too few or no plane. `normal` takes its direction."""
    if count < FEWEST:
        normal[:] = 0.0
        return -1.0
    n = 1.0 / count
    least, middle = flattest_of(scatter, n, normal)
    if least < (0.04 + 0.02 * voxel_m) ** 2 and middle > (0.15 * voxel_m) ** 2 and least < 0.15 * middle:
        return max(least, 1e-8)
    return -1.0


@njit(cache=True, nogil=True)
def _difference(normal: Array, other: Array, sign: float, place: Array, later: Array, out: Array) -> None:
    """Way from a plane to a later one along their mean normal, which points up or, of walls, east; and the middle between them."""
    x, y, z = normal[0] + sign * other[0], normal[1] + sign * other[1], normal[2] + sign * other[2]
    length = np.sqrt(x * x + y * y + z * z)
    wall = abs(z) <= 0.1 * length
    if (not wall and z < 0.0) or (wall and x < 0.0):
        length = -length
    out[1], out[2], out[3] = x / length, y / length, z / length
    out[0] = 0.0
    for axis in range(3):
        out[0] += out[1 + axis] * (later[axis] - place[axis])
        out[4 + axis] = 0.5 * (place[axis] + later[axis])
