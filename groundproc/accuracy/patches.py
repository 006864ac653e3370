"""Thickness of facades: how far points of one flat piece of wall, seen from all passes, lie off their own best plane.

Pieces are chosen by the true echoes alone (a piece of one vertical plane, seen well enough), so that they are the same for every
trajectory; the plane is fitted to the estimated points, so that a wall in a wrong place counts as thin as long as it is one wall.
Nothing but sums is kept.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Keys = npt.NDArray[np.int64]

PATCH_M: Final = 2.0
LEAST_POINTS: Final = 100
LEAST_EXTENT_M: Final = 0.25
"""RMS extent of a patch in its narrow direction; a whole one has 0.58 m."""
LARGEST_RELIEF_M: Final = 0.005
"""RMS distance of the true echoes from their plane: what is not flat has a thickness of its own."""
STEEPEST: Final = 0.1
"""Vertical component of a facade's normal, at most."""
NOT_FACADE: Final = ("glass", "indoors", "reveals", "leaves")
"""Words in the names of surfaces that are no wall: windows, what is seen through them, and leaves."""
STEEPEST_LEAN: Final = np.tan(np.deg2rad(30.0))
"""Slope of a fitted plane against the true wall up to which its lean makes the wall no thicker."""
TRIMMED: Final = 0.1
"""Share of patches left out at either end of the mean."""

_ANGLE_BIN: Final = np.deg2rad(5.0)
_OFFSET_BIN_M: Final = 0.113
_SUMS: Final = 10


def facade_surfaces(names: Sequence[str]) -> npt.NDArray[np.bool_]:
    """Which surfaces may hold facade patches, shape (surfaces,)."""
    return np.array([not any(word in name.split() for word in NOT_FACADE) for name in names], np.bool_)


def patch_keys(hits_m: Array, normals: Array, surface: npt.NDArray[np.integer[Any]]) -> Keys:
    """A number for each patch of a vertical plane: surface, direction, distance, and a cell of `PATCH_M` in the plane; shape (n,)."""
    angle = np.arctan2(normals[:, 1], normals[:, 0])
    length = np.hypot(normals[:, 0], normals[:, 1])
    away = (hits_m[:, 0] * normals[:, 0] + hits_m[:, 1] * normals[:, 1]) / length
    along = (hits_m[:, 1] * normals[:, 0] - hits_m[:, 0] * normals[:, 1]) / length
    keys = np.zeros(len(hits_m), np.int64)
    for value, bins in (
        (surface, 1 << 16),
        (np.rint(angle / _ANGLE_BIN), 1 << 7),
        (np.rint(away / _OFFSET_BIN_M), 1 << 16),
        (np.floor(along / PATCH_M), 1 << 13),
        (np.floor(hits_m[:, 2] / PATCH_M), 1 << 10),
    ):
        keys = keys * bins + np.asarray(value).astype(np.int64) % bins
    return keys


class Moments:
    """Sums of points, group by group: number, and first and second moments about a point of each group."""

    def __init__(self, sets: int) -> None:
        self._sets, self._rows = sets, dict[int, int]()
        self._sums, self._centres = np.zeros((0, sets, _SUMS)), np.zeros((0, 3))

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def keys(self) -> Keys:
        """Of each group, shape (groups,)."""
        return np.fromiter(self._rows, np.int64, len(self._rows))

    def add(self, keys: Keys, reference_m: Array, *sets: Array) -> None:
        """Add points to their groups.

        Parameters
        ----------
        keys : ndarray of int64, shape (n,)
        reference_m : ndarray, shape (n, 3)
            The first of a group becomes the point that its moments are about.
        *sets : ndarray, shape (n, 3) each
        """
        found, first, group = np.unique(keys, return_index=True, return_inverse=True)
        rows = np.array([self._rows.setdefault(key, len(self._rows)) for key in found.tolist()], np.int64)
        if len(self._rows) > len(self._centres):
            more = max(len(self._rows) - len(self._centres), len(self._centres))
            self._sums = np.concatenate([self._sums, np.zeros((more, self._sets, _SUMS))])
            self._centres = np.concatenate([self._centres, np.zeros((more, 3))])
        new = self._sums[rows, 0, 0] == 0.0
        self._centres[rows[new]] = reference_m[first[new]]
        for number, points in enumerate(sets):
            _add(rows[group], points, self._centres, self._sums, number)

    def counts(self) -> npt.NDArray[np.int64]:
        """Points in each group, shape (groups,)."""
        return np.asarray(self._sums[: len(self), 0, 0].astype(np.int64))

    def covariances(self, number: int) -> Array:
        """Covariance of the points of a set in each group [m^2], shape (groups, 3, 3)."""
        sums = self._sums[: len(self), number]
        count = np.maximum(sums[:, 0], 1.0)
        mean = sums[:, 1:4] / count[:, None]
        xx, xy, xz, yy, yz, zz = (sums[:, 4:] / count[:, None]).T
        second = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
        # a plane takes three degrees of freedom
        scale = (count / np.maximum(count - 3.0, 1.0))[:, None, None]
        return np.asarray(scale * (second - mean[:, :, None] * mean[:, None, :]))


@njit(cache=True, nogil=True)
def _add(rows: Any, points: Any, centres: Any, sums: Any, number: int) -> None:
    for i in range(len(rows)):
        row = rows[i]
        x, y, z = (points[i, 0] - centres[row, 0], points[i, 1] - centres[row, 1], points[i, 2] - centres[row, 2])
        s = sums[row, number]
        s[0] += 1.0
        s[1] += x
        s[2] += y
        s[3] += z
        s[4] += x * x
        s[5] += x * y
        s[6] += x * z
        s[7] += y * y
        s[8] += y * z
        s[9] += z * z


HITS, ESTIMATED, FLOOR = range(3)
"""The sets of points of `flat_patches`."""


def _walls(moments: Moments) -> tuple[npt.NDArray[np.bool_], Array]:
    """Which groups are patches of a flat wall, by their true echoes, and axes of each group as columns: out of the wall, and in it."""
    spread, axes = np.linalg.eigh(moments.covariances(HITS))
    extents = np.sqrt(np.maximum(spread, 0.0))
    flat = (moments.counts() >= LEAST_POINTS) & (extents[:, 0] <= LARGEST_RELIEF_M) & (extents[:, 1] >= LEAST_EXTENT_M)
    return flat, axes


def flat_patches(moments: Moments) -> npt.NDArray[np.bool_]:
    """Which groups are patches of a flat wall, shape (groups,)."""
    return _walls(moments)[0] if len(moments) else np.zeros(0, np.bool_)


def thickness_m(moments: Moments, number: int) -> Array:
    """Thickness of each flat patch in a set, shape (patches,): standard deviation about the plane fitted to its points.

    The plane is that of the least squares of distances out of the true wall over places in it, and so always a wall's. The thinnest
    direction of the points would not do: of a patch that is smeared over metres it lies in the wall, and says half a metre for ever.
    """
    if not len(moments):
        return np.zeros(0)
    flat, axes = _walls(moments)
    axes = axes[flat]
    covariance = np.swapaxes(axes, 1, 2) @ moments.covariances(number)[flat] @ axes
    across, inside = covariance[:, 1:, :1], covariance[:, 1:, 1:]
    slope = np.linalg.solve(inside, across) if len(inside) else across
    left = covariance[:, 0, 0] - (slope * across).sum(axis=(1, 2))
    lean = np.minimum(np.square(slope).sum(axis=(1, 2)), STEEPEST_LEAN**2)
    return np.asarray(np.sqrt(np.maximum(left / (1.0 + lean), 0.0)))


def trimmed_mean(values: Array) -> float:
    """Mean without the largest and smallest tenth; not a number where there are none."""
    if not len(values):
        return float("nan")
    cut = int(TRIMMED * len(values))
    return float(np.sort(values)[cut : len(values) - cut].mean())
