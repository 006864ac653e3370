"""Pieces of a path between long blind stretches, each laid as a whole on good positions before the first step."""

from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.observations.moments import poses, spots, within
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import SLICE_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

BLIND: Final = 50
"""Clusters of a slice below which it saw next to nothing."""
LONGEST_BLIND: Final = 10
"""Slices without a view after which the map may have gone astray."""
ROUGH_M: Final = 0.3
"""Positions that are no better do not move pieces."""
FEWEST_OF_PIECE: Final = 5
"""Positions by which a piece of the flight can be laid."""


def laid_by_pieces(path: Path, time_ns: Ints, stated_m: Array, lever_m: Array, sigma_m: float, view: Mask) -> Path:
    """A path whose pieces between long blind stretches are each laid, as a whole, where the positions have them.

    After a blind stretch, the odometry continues from where its inertial sensors had drifted to, beside its own map. A
    metre is too far for the planes of both pieces to be matched correctly, and near enough for a wrong match to
    persist.

    Parameters
    ----------
    path : Path
    time_ns : ndarray of int64, shape (n,)
    stated_m : ndarray, shape (n, 3)
        Positions of a point of the airframe, local.
    lever_m : ndarray, shape (3,)
        From the sensor to the point, sensor frame.
    sigma_m : float
        Of the positions.
    view : ndarray of bool, shape (intervals,)
        Slices with clusters.
    """
    pieces = _pieces(view)
    if len(pieces) < 2 or sigma_m > ROUGH_M:
        return path
    inside = within(time_ns, path)
    _, _, step, share = spots(time_ns[inside], path)
    quat, position = poses(path, step, share)
    stated = stated_m[inside]
    point = position + frames.mat_from_quat(quat) @ lever_m
    grid, turns, moves = [], [], []
    for first, last in pieces:
        mine = (step >= first * STEPS) & (step < last * STEPS)
        if mine.sum() < FEWEST_OF_PIECE:
            continue
        turn, about, shift = _level_fit(point[mine], stated[mine], sigma_m)
        nodes = np.arange(first * STEPS, last * STEPS + 1)
        off = path.position_m[nodes] - about
        moves.append(_level(off, turn) - off + shift)
        grid.append(nodes)
        turns.append(np.full(len(nodes), turn))
    if not grid:
        return path
    nodes, known = np.arange(len(path.quat)), np.concatenate(grid)
    move = np.stack([np.interp(nodes, known, axis) for axis in np.concatenate(moves).T], axis=1)
    about_up = np.zeros((len(nodes), 3))
    about_up[:, 2] = np.interp(nodes, known, np.concatenate(turns))
    quat = frames.quat_multiply(frames.quat_exp(about_up), path.quat)
    return Path(path.start_ns, quat, path.position_m + move, path.step_ns)


def seen_slices(clusters: Clusters, path: Path) -> Mask:
    """Which slices of a path have enough clusters to be a view, shape (intervals,)."""
    slot = (clusters.time_ns - path.start_ns) // SLICE_NS
    return np.asarray(np.bincount(np.clip(slot, 0, path.intervals - 1), minlength=path.intervals) >= BLIND)


def _pieces(view: Mask) -> list[tuple[int, int]]:
    """First and last slice, the last excluded, of the stretches between long blind ones."""
    seen = np.flatnonzero(view)
    if not len(seen):
        return []
    breaks = np.flatnonzero(np.diff(seen) > LONGEST_BLIND)
    return [(int(seen[a]), int(seen[b]) + 1) for a, b in zip([0, *(breaks + 1)], [*breaks, len(seen) - 1], strict=True)]


def _level_fit(point: Array, stated: Array, sigma_m: float) -> tuple[float, Array, Array]:
    """Turn about the vertical [rad], the place that it is about, and shift, that lay points on those stated: tilt is gravity's."""
    about = point.mean(axis=0)
    a, b = point - about, stated - stated.mean(axis=0)
    turn = 0.0
    # a heading only where the points are far enough apart to have one, to a degree
    if np.linalg.norm(a[:, :2], axis=1).max() > 60.0 * sigma_m:
        turn = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum()))
    return turn, about, np.asarray(np.median(stated - about - _level(a, turn), axis=0))


def _level(off: Array, turn: float) -> Array:
    """Vectors, shape (n, 3), turned about the vertical."""
    sine, cosine = np.sin(turn), np.cos(turn)
    return np.asarray(off @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]))
