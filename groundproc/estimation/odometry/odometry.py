"""Lidar-inertial odometry: slice after slice against the planes of those before, an iterated error-state filter.

The idea is that of Xu, Cai, He, Lin, Zhang, "FAST-LIO2" (2022): inertial propagation, every return moved to the end of
its slice by it, and the state corrected by distances to planes until it no longer changes. The measurements here are
clusters, not returns.

The state, and an error state of 18 components: attitude (in the body), position, velocity, bias of the gyro, bias of
the accelerometer, gravity.
"""

import functools
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.matching import update
from groundproc.estimation.odometry.motion import LIDAR, MotionGrid
from groundproc.estimation.odometry.rotor import Line
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE, Clusterer, Slice
from groundproc.estimation.odometry.state import POSITION, ROTATION, STATES, STEP_S, VELOCITY, State, apply, propagate
from groundproc.estimation.odometry.voxels import COUNT, MEAN, SCATTER, PlaneMap
from groundproc.estimation.odometry.within import Seen, Within
from groundproc.machine.readahead import InOrder
from groundproc.numerics.rotations import mat_of_quat, quat_difference

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Step:
    """What one slice gave.

    Attributes
    ----------
    number : int
        Of the slice.
    quat, position_m : ndarray, shape (4,), (3,)
        At its end, corrected.
    gyro_bias_rad_s : ndarray, shape (3,)
    sigma : ndarray, shape (6,)
        Of attitude [rad] and position [m].
    clusters : ndarray of CLUSTER_DTYPE
        Of one laser each where the slice has them told apart.
    world_m : ndarray, shape (m, 3)
        Where the corrected pose places them.
    seen, matched : int
        Clusters of all lasers, and those that found a plane.
    residual_m : float
        RMS distance from it.
    unheld_m, next_unheld_m : float
        Sigmas of the two directions that they observe least; infinite before there is a map.
    quats : ndarray, shape (STEPS + 1, 4)
        Attitudes on the grid over the slice, corrected, as they are stated: with the turns within it where these are found.
    """

    number: int
    quat: Array
    position_m: Array
    velocity_m_s: Array
    gyro_bias_rad_s: Array
    sigma: Array
    clusters: npt.NDArray[np.void]
    world_m: Array
    seen: int
    matched: int
    residual_m: float
    unheld_m: float
    next_unheld_m: float
    quats: Array


@dataclass(frozen=True, slots=True)
class _Turns:
    """What the turns within a slice are found of: see `Within`; `ground` is the ground's mean normal."""

    seen: Seen
    place_m: Array
    turn: Array
    ground: Array


class Odometry:
    """The filter and its map.

    Parameters
    ----------
    state : State
        At the start of slice `number`.
    motion : MotionGrid
    number : int
    voxel_m : float
        Edge of the map's voxels.
    line : Line, optional
        The line of the spin, where it is to be found in time and taken off the lidar's own gyro.
    turns : bool
        Whether the turns within slices are found (`within`). They are for who uses the attitudes of a step: neither the filter nor its
        map goes by them.
    beside : bool
        Whether what the filter does not wait for is done by a thread beside it: the turns within a slice, and its way into the map, while
        the next one's clusters are made. The attitudes of a step are then stated when `settle` comes back.

    Attributes
    ----------
    state, number, voxel_m, line, turns
        As they are by now.
    planes : PlaneMap
        The map, with all slices so far.
    """

    MOST: Final = 4000.0
    """Returns that a voxel of the map remembers."""
    REACH_M: Final = 250.0
    """The map forgets what lies farther away than this."""

    def __init__(
        self, state: State, motion: MotionGrid, number: int, voxel_m: float, line: Line | None = None, turns: bool = True,
        beside: bool = False,
    ) -> None:  # fmt: skip
        self.state, self.number, self.voxel_m, self.turns = state, number, voxel_m, turns
        self._motion = motion
        self._map, self._mapped = PlaneMap(voxel_m), _done()
        self._beside = InOrder() if beside else None
        self._cluster = Clusterer(voxel_m)
        self._ground = np.zeros(3)
        self.line = line if motion.source == LIDAR else None
        self._within = Within(max(motion.rate_density, 1e-6))
        density = 2.0 * max(motion.rate_density, 1e-6), 3.0 * max(motion.force_density, 1e-4)
        step = STEP_S
        self._noise = np.concatenate(
            [
                np.full(3, density[0] ** 2 * step), np.full(3, 1e-12), np.full(3, density[1] ** 2 * step),
                np.full(3, np.deg2rad(0.005) ** 2 * step), np.full(3, 0.002**2 * step), np.full(3, 1e-14),
            ]
        )  # fmt: skip

    @property
    def planes(self) -> PlaneMap:
        """The map of all slices so far; waited for where they are put in beside."""
        self._mapped.result()
        return self._map

    @planes.setter
    def planes(self, planes: PlaneMap) -> None:
        self.settle()
        self._map = planes

    def settle(self) -> None:
        """Wait for what is done beside."""
        if self._beside is not None:
            self._beside.wait()

    def afterwards(self, work: Callable[[PlaneMap], None]) -> None:
        """Do a work with the map as it is after the last slice, and before the next; beside, where that is wanted."""
        planes = self._map
        self._do(lambda: work(planes))

    def _do(self, work: Callable[[], None]) -> "Future[None]":
        """Do a work, beside the filter where that is wanted."""
        begun = None if self._beside is None else self._beside.do(work)
        if self._beside is None:
            work()
        return begun or _done()

    def change_voxels(self, voxel_m: float) -> None:
        """Go on with voxels of another edge; the moments of the old ones go into the new."""
        before, self.voxel_m = self.planes, voxel_m
        rows = before.voxels[: before.count]
        clusters = np.zeros(before.count, CLUSTER_DTYPE)
        clusters["count"], clusters["scatter"] = rows[:, COUNT], rows[:, SCATTER : SCATTER + 6]
        self.planes, self._cluster = PlaneMap(voxel_m), Clusterer(voxel_m)
        for first in range(0, before.count, 10_000):
            part = slice(first, first + 10_000)
            self.planes.insert(rows[part, MEAN : MEAN + 3].copy(), clusters[part], self.MOST)

    def propagate(self, to: int) -> None:
        """Carry the state on to the end of slice `to`."""
        while self.number <= to:
            self._carry(*self._inertial(self.number))
            self.settle()
            self._within.forget()

    def _inertial(self, number: int) -> tuple[Array, Array]:
        """Rates and forces over a slice."""
        part = slice(number * STEPS, number * STEPS + STEPS)
        rate, force = self._motion.rate_rad_s[part], self._motion.force_m_s2[part]
        if len(rate) < STEPS:
            raise IndexError(f"slice {number} lies beyond the inertial data")
        return rate, force

    def _carry(self, rate: Array, force: Array) -> tuple[Array, Array]:
        """Carry the state on over a slice; poses on the grid over it, shape (STEPS + 1, 4) and (STEPS + 1, 3)."""
        quats, positions = np.empty((STEPS + 1, 4)), np.empty((STEPS + 1, 3))
        s = self.state
        s.covariance = propagate(rate, force, s.arrays, s.covariance, self._noise, (quats, positions))
        self.number += 1
        return quats, positions

    def step(self, piece: Slice) -> Step:
        """Take the next slice: propagate, match, correct, and add it to the map."""
        self.propagate(piece.number - 1)
        rate, force = self._inertial(piece.number)
        if self.line is not None:
            rate = rate - self.line.read(self._motion, piece)
        quats, positions = self._carry(rate, force)
        start_ns = self._motion.start_ns + piece.number * STEPS * STEP_NS
        clusters, world = self._cluster(piece, start_ns, quats, positions)
        s = self.state
        matched, residual, unheld = 0, float("nan"), (float("inf"), float("inf"))
        # a column of a table is another type of array than one of one row, and what takes it compiles for half a minute
        returns, turns = np.ascontiguousarray(clusters["count"]), None
        if self.planes.count:
            # in the body at the slice's end, where the prediction between the instants stands
            before, end_m = _mat(s.quat), s.position_m.copy()
            body = (world - end_m) @ before
            matched, residual, unheld, s.covariance = update(
                self.planes.arrays, body, returns, s.arrays, s.covariance, self._ground
            )
            # the slice is corrected as one rigid piece
            turn = _mat(s.quat) @ before.T
            positions, world = (s.position_m + (each - end_m) @ turn.T for each in (positions, world))
            quats = frames.quat_multiply(frames.quat_from_mat(turn[None]), quats)
            if self.turns or piece.laser is not None:
                seen = Seen(clusters["time_ns"] - start_ns, world, returns)
                turns = _Turns(seen, positions, turn, self._ground.copy())
        far_m = s.position_m.copy() if piece.number % 50 == 0 else None
        self._mapped = self._do(functools.partial(self._take_in, turns, quats, (world, clusters), far_m))
        count = len(clusters)
        if piece.laser is not None:
            self._mapped.result()
            # these would weigh more in the filter, for each has a surface's roughness of its own
            clusters, world = self._cluster(piece, start_ns, quats, positions, apart=True)
        return Step(
            piece.number, s.quat.copy(), s.position_m.copy(), s.velocity_m_s.copy(), s.gyro_bias_rad_s.copy(),
            np.sqrt(np.diag(s.covariance)[:6]), clusters, world, count, matched, residual, *unheld, quats,
        )  # fmt: skip

    def _take_in(
        self, turns: "_Turns | None", quats: Array, seen: tuple[Array, npt.NDArray[np.void]], far_m: Array | None
    ) -> None:
        """Turn a slice's attitudes `quats` by the turns within it, and put it into the map; `far_m`: forget what is far from there."""
        world, clusters = seen
        if turns is not None:
            within = self._within(turns.seen, turns.place_m, turns.turn, (self._map.arrays, turns.ground))
            quats[:] = frames.quat_multiply(frames.quat_exp(within), quats)
        self._map.insert(world, clusters, self.MOST)
        if far_m is not None:
            self._map.forget_beyond(far_m, self.REACH_M)

    def position_fix(self, position_m: Array, sigma_m: Array) -> None:
        """Take a position of the sensor, shape (3,), with its sigmas."""
        self._fix(POSITION, position_m - self.state.position_m, sigma_m)

    def velocity_fix(self, velocity_m_s: Array, sigma_m_s: Array) -> None:
        """Take a velocity of the sensor, shape (3,), with its sigmas."""
        self._fix(VELOCITY, velocity_m_s - self.state.velocity_m_s, sigma_m_s)

    def _fix(self, part: slice, off: Array, sigma: Array) -> None:
        """Take an observation of three states that is off by so much, shape (3,)."""
        s = self.state
        observed = np.zeros((3, STATES))
        observed[:, part] = np.eye(3)
        innovation = observed @ s.covariance @ observed.T + np.diag(sigma**2)
        gain = np.linalg.solve(innovation, observed @ s.covariance).T
        self._correct(gain @ off)
        keep = np.eye(STATES) - gain @ observed
        s.covariance = keep @ s.covariance @ keep.T + gain @ np.diag(sigma**2) @ gain.T

    def attitude_fix(self, quat: Array, sigma_rad: Array) -> None:
        """Take an attitude of the sensor, shape (4,), with its sigmas about the map's axes."""
        s = self.state
        mat = _mat(s.quat)
        off = np.empty(3)
        quat_difference(s.quat, quat, off)  # in the body
        observed = np.zeros((3, STATES))
        observed[:, ROTATION] = mat
        innovation = observed @ s.covariance @ observed.T + np.diag(sigma_rad**2)
        gain = np.linalg.solve(innovation, observed @ s.covariance).T
        self._correct(gain @ (mat @ off))
        keep = np.eye(STATES) - gain @ observed
        s.covariance = keep @ s.covariance @ keep.T + gain @ np.diag(sigma_rad**2) @ gain.T

    def _correct(self, error: Array) -> None:
        apply(error, self.state.arrays)


def _done() -> "Future[None]":
    """A work that has been done."""
    done: Future[None] = Future()
    done.set_result(None)
    return done


def _mat(quat: Array) -> Array:
    """Column matrix of a quaternion."""
    mat = np.empty((3, 3))
    mat_of_quat(quat, mat)
    return mat
