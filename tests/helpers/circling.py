"""A small flight for the adjustment: a circle of 7 s within four walls."""

import numpy as np
import numpy.typing as npt
from scipy import sparse

from flightlog import frames
from groundproc.estimation.observations.rows import Errors, Factor, Unknowns, prior_factor
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
INTERVALS = 70
SIZE = 6 * (INTERVALS + 3)


def circle() -> Path:
    """A circle of 8 m in 7 s, looking ahead, swaying."""
    seconds = np.arange(INTERVALS * STEPS + 1) * STEP_NS * 1e-9
    turn = 2 * np.pi * seconds / 7.0
    place = np.stack([8 * np.cos(turn), 8 * np.sin(turn), 5.0 + 0.3 * np.cos(3 * seconds)], axis=1)
    sway = np.stack([0.1 * np.sin(3 * seconds), 0.1 * np.cos(4 * seconds), 0.0 * seconds], axis=1)
    heading = np.stack([0 * turn, 0 * turn, turn], axis=1)
    return Path(10**18, frames.quat_multiply(frames.quat_exp(heading), frames.quat_exp(sway)), place)


def room(path: Path) -> Clusters:
    """Ground and four walls about the circle, each place seen from anywhere on it."""
    rng, count = np.random.default_rng(1), 20000
    along, height, kind = rng.uniform(-12, 12, count), rng.uniform(0, 8, count), rng.integers(0, 6, count)
    world = np.stack([along, rng.uniform(-12, 12, count), np.full(count, 0.03)], axis=1)
    for number, (axis, at) in enumerate([(0, 12.3), (0, -12.3), (1, 12.3), (1, -12.3)]):
        wall = np.stack([np.full(count, at), along, height], axis=1)
        world[kind == number] = (wall if axis == 0 else wall[:, [1, 0, 2]])[kind == number]
    step = rng.integers(0, INTERVALS * STEPS, count)
    mats = frames.mat_from_quat(path.quat)[step]
    xyz = np.einsum("nji,nj->ni", mats, world - path.position_m[step] + 0.01 * rng.normal(size=world.shape))
    return Clusters(
        path.start_ns + step * STEP_NS,
        xyz.astype(np.float32),
        np.zeros((count, 6), np.float32),
        np.full(count, 8, np.int32),
    )


def unknowns_of_whole() -> Unknowns:
    """The path, its turn and shift as a whole."""
    unknowns = Unknowns(INTERVALS)
    unknowns.add("world.turn", np.deg2rad([5.0, 5.0, 20.0]))
    unknowns.add("world.shift", np.full(3, 100.0))
    return unknowns


def factors_of(unknowns: Unknowns) -> list[Factor]:
    """Priors, increments of the path's shape as inertial sensors have them, and one position."""
    turns = sparse.lil_matrix((6 * (INTERVALS + 2), unknowns.size))
    for row in range(6 * (INTERVALS + 2)):
        turns[row, row], turns[row, row + 6] = -1.0, 1.0
    size = turns.shape[0]
    sigma = np.tile([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3], size // 6)
    place = sparse.lil_matrix((3, unknowns.size))
    for axis in range(3):
        place[axis, 6 * 30 + 3 + axis] = place[axis, unknowns.names["world.shift"].start + axis] = 1.0
    return [
        Factor("increments", np.zeros(size), turns.tocsr(), sigma),
        Factor("position", np.ones(3), place.tocsr(), np.full(3, 2.0), errors=Errors.ANCHOR),
        prior_factor(unknowns),
    ]
