"""Points around the stations of axes, profile by profile, in squares of ground that fit into memory."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from groundproc.analysis.banks.axes import Axis
from groundproc.cloud.tiles import Tiles, side_for

Array = npt.NDArray[np.float64]

_COARSE_M: Final = 2.0
"""Cells that tell which points are near to a station."""
_HALF_M: Final = 0.5
"""Half the length of bank that a profile is of, at least."""


def around(
    axes: Sequence[Axis], reach_m: Sequence[float], pieces: Iterable[Array], folder: Path, step_m: float
) -> Iterator[tuple[int, int, Array, Array]]:
    """Axis, station, ways downhill and heights of the points of each profile that has any.

    Parameters
    ----------
    axes : sequence of Axis
    reach_m : sequence of float
        To both sides of each axis.
    pieces : iterable of ndarray, shape (n, 3)
        All points.
    folder : Path
        For a temporary file.
    step_m : float
        Between stations.
    """
    if not axes:
        return
    places = np.concatenate([axis.places_m for axis in axes])
    number = np.concatenate([np.full(len(axis.places_m), n) for n, axis in enumerate(axes)])
    station = np.concatenate([np.arange(len(axis.places_m)) for axis in axes])
    reach = np.asarray(reach_m)[number]
    half = max(_HALF_M, step_m / 2.0)
    halo = float(np.hypot(reach.max(), half))
    near = _near(places, halo)
    span = np.ptp(places, axis=0)
    count = max(len(places), 1) * 2000
    side = side_for(count, (0.0, 0.0), (float(span[0]) + 1.0, float(span[1]) + 1.0), halo)
    tiles = Tiles(folder, {}, side, halo)
    for xyz in pieces:
        tiles.add(xyz[near(xyz)])
    square = np.floor(places / side).astype(np.int64)
    for tile in tiles:
        own = np.floor(tile.xyz_m[int(np.argmax(tile.core)), :2] / side).astype(np.int64)
        tree = cKDTree(tile.xyz_m[:, :2])
        for n in np.flatnonzero((square == own).all(axis=1)):
            axis = axes[number[n]]
            rows = np.sort(np.array(tree.query_ball_point(places[n], float(np.hypot(reach[n], half))), np.int64))
            off = tile.xyz_m[rows, :2] - places[n]
            downhill = axis.downhill[station[n]]
            s, along = off @ downhill, off @ np.array([-downhill[1], downhill[0]])
            some = (np.abs(along) <= half) & (np.abs(s) <= reach[n])
            if some.any():
                yield int(number[n]), int(station[n]), s[some], tile.xyz_m[rows[some], 2]


def _near(places: Array, within_m: float) -> Callable[[Array], npt.NDArray[np.bool_]]:
    """Whether points may be so near to a place."""
    reach = int(np.ceil(within_m / _COARSE_M))
    cell = np.unique(np.floor(places / _COARSE_M).astype(np.int64), axis=0)
    step = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    keys = np.empty(0, np.int64)
    for some in np.array_split(cell, max(len(cell) // 256, 1)):
        wide = (some[:, None] + step).reshape(-1, 2)
        keys = np.union1d(keys, (wide[:, 0] << 32) + (wide[:, 1] & 0xFFFFFFFF))

    def near(xyz: Array) -> npt.NDArray[np.bool_]:
        of = np.floor(xyz[:, :2] / _COARSE_M).astype(np.int64)
        return np.isin((of[:, 0] << 32) + (of[:, 1] & 0xFFFFFFFF), keys)

    return near
