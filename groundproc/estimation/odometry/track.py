"""The forward pass: odometry over a run of the lidar, with what the batch needs of each slice kept."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from flightlog.constants import STANDARD_GRAVITY_M_S2
from flightlog.errors import LogError
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.motion import Motion
from groundproc.estimation.odometry.odometry import Odometry, Step
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE, Slice
from groundproc.estimation.odometry.spline import Path, integrated, smooth_path
from groundproc.estimation.odometry.state import State
from groundproc.estimation.odometry.stated import Attitudes, Positions
from groundproc.estimation.odometry.voxels import FLATNESS, NORMAL, MapArrays, PlaneMap, find
from groundproc.numerics.voxelhash import spread, voxel_key
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

VOXELS_M: Final = (0.5, 1.0, 2.0)
"""Edges of the odometry's voxels; rings on the ground lie wider apart the higher one flies, and a voxel must see more than one."""
WIDE_AT_M: Final = (28.0, 60.0)
"""Median range from which on the second and the third are taken."""
KEPT: Final = 1200
"""Clusters of a slice that are kept for the batch."""
LOST_M: Final = 15.0
LOST_SIGMAS: Final = 6.0
LOST_FIXES: Final = 8
"""So many fixes on end that lie farther off than both: the odometry has lost its way, and begins anew."""
FIX_TAU_S: Final = 1.0
"""The filter takes positions as if their errors lasted so long: light beside the lidar, and firm enough to hold it where there is none."""
ATTITUDE_EVERY_NS: Final = 1_000_000_000
ATTITUDE_FIX_RAD: Final = np.deg2rad([3.0, 3.0, 30.0])
"""The autopilot's attitude is taken once a second with these sigmas, about east, north and up; light in the same way."""
FEWEST: Final = 20
"""Slices that make a track."""
START_SIGMA: Final = {
    "attitude_deg": 0.02,
    "velocity_m_s": 1.0,
    "gyro_deg_s": 1.0,
    "accel_m_s2": 0.3,
    "gravity_m_s2": 0.3,
}
"""What is known where the odometry begins. The map takes its axes from the first attitude, so that is exact, and gravity is not."""


@dataclass(slots=True)
class Track:
    """What the forward pass found.

    Attributes
    ----------
    first : int
        Number of the first slice.
    quat, position_m : list of ndarray
        Poses of the sensor at the slice boundaries, one more than there are slices.
    gyro_bias : list of ndarray
        At the end of each slice.
    clusters : list of ndarray of CLUSTER_DTYPE
        Of each slice; empty where the lidar was silent.
    matched, seen : list of int
        Clusters that found a plane, and all.
    residual_m : list of float
    restarts : int
        How often it lost its way.
    voxel_m : float
        Edge of the odometry's voxels at last.
    """

    first: int
    quat: list[Array]
    position_m: list[Array]
    velocity_m_s: list[Array] = field(default_factory=list)
    gyro_bias: list[Array] = field(default_factory=list)
    sigma: list[Array] = field(default_factory=list)
    clusters: list[npt.NDArray[np.void]] = field(default_factory=list)
    matched: list[int] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)
    residual_m: list[float] = field(default_factory=list)
    restarts: int = 0
    voxel_m: float = VOXELS_M[0]

    def __len__(self) -> int:
        return len(self.clusters)

    def path(self, motion: Motion, start: int, end: int) -> Path:
        """Smooth path over slices `start` to `end`, counted from the first."""
        grid = slice((self.first + start) * STEPS, (self.first + end) * STEPS)
        bias = np.repeat(np.array(self.gyro_bias[start:end]), STEPS, axis=0)
        rate = motion.rate_rad_s[grid] - bias.mean(axis=0)
        start_ns = motion.start_ns + (self.first + start) * SLICE_NS
        return smooth_path(
            start_ns, rate, np.array(self.quat[start : end + 1]), np.array(self.position_m[start : end + 1])
        )

    def causal_path(self, motion: Motion) -> Path:
        """The path as known at the end of each slice: nothing of what came later is in it."""
        grid = slice(self.first * STEPS, (self.first + len(self)) * STEPS)
        rate = motion.rate_rad_s[grid] - np.repeat(np.array(self.gyro_bias), STEPS, axis=0)
        quats, places = np.array(self.quat), np.array(self.position_m)
        speeds = np.array([self.velocity_m_s[0], *self.velocity_m_s])
        share = (np.arange(STEPS) / STEPS)[:, None]
        step_s = SLICE_NS * 1e-9
        quat, position = np.empty((len(self) * STEPS + 1, 4)), np.empty((len(self) * STEPS + 1, 3))
        for i in range(len(self)):
            free = integrated(rate[i * STEPS : (i + 1) * STEPS], quats[i])
            off = frames.quat_log(frames.quat_multiply(frames.quat_inverse(free[-1:]), quats[i + 1 : i + 2]))
            part = slice(i * STEPS, (i + 1) * STEPS)
            quat[part] = frames.quat_multiply(free[:-1], frames.quat_exp(share * off))
            rise = places[i + 1] - places[i]
            # a cubic through both ends with the filter's velocities
            position[part] = (
                places[i]
                + share**2 * (3.0 - 2.0 * share) * rise
                + step_s * share * (1.0 - share) * ((1.0 - share) * speeds[i] - share * speeds[i + 1])
            )
        quat[-1], position[-1] = quats[-1], places[-1]
        return Path(motion.start_ns + self.first * SLICE_NS, quat, position)

    def forget(self, before: int) -> None:
        """Drop the clusters of the slices before one."""
        for i in range(before):
            self.clusters[i] = _NONE

    def gathered(self, start: int, end: int, apart: bool = False) -> Clusters:
        """Clusters of slices `start` to `end` as columns; `apart`: with their lasers."""
        parts = self.clusters[start:end]
        return Clusters(
            np.concatenate([p["time_ns"] for p in parts]),
            np.concatenate([p["xyz"] for p in parts]),
            np.concatenate([p["scatter"] for p in parts]),
            np.concatenate([p["count"] for p in parts]),
            np.concatenate([p["laser"] for p in parts]) if apart else None,
        )


BEARING_SIGMA: Final = 0.15
"""How well the first heading is known [rad]: compasses are off by five to ten degrees."""
LARGEST_BEARING: Final = 0.35
"""What a compass may be off by at most [rad]; a path that turns farther away from the fixes is lost, not turned."""


@dataclass(slots=True)
class Bearing:
    """The heading of the odometry's map against the earth's, by the way flown and the fixes.

    The map takes its axes from the first attitude. With a compass that is 6 deg off a straight street of 200 m ends 20 m beside the
    fixes, and nothing is wrong with the way.

    Attributes
    ----------
    begin_m : ndarray, shape (3,)
        Where the way began.
    product : complex
        Of where the fixes are from there with where the way is, conjugate; its angle is the turn.
    count : int
    """

    begin_m: Array
    product: complex = 0j
    count: int = 0

    def on_map(self, way_m: Array, fix_m: Array, sigma_m: float) -> Array:
        """A fix turned into the map's axes, shape (3,), and taken into account.

        Of a turn little is believed until the way is several times as wide as the error of a fix, which may last.
        """
        way, fix = way_m - self.begin_m, fix_m - self.begin_m
        self.product += complex(fix[0], fix[1]) * complex(way[0], -way[1])
        self.count += 1
        turn = float(np.angle(self.product + self.count * (sigma_m / BEARING_SIGMA) ** 2))
        turn = min(max(turn, -LARGEST_BEARING), LARGEST_BEARING)
        level = complex(fix[0], fix[1]) * np.exp(-1j * turn)
        return np.asarray(self.begin_m + np.array([level.real, level.imag, fix[2]]))


class Tracker:
    """Drives the odometry slice by slice: start, silent slices, fixes, loss of way.

    Parameters
    ----------
    motion : Motion
    start : Trajectory
        Rough poses of the ins frame, to begin from.
    mat_ins_lidar, lever_m : ndarray
        Nominal mount.
    gyro_bias : ndarray, shape (3,)
        Where to begin [rad/s].
    fixes : Positions or None
    keep : bool
        Whether clusters are kept for the batch.
    attitudes : Attitudes, optional
    """

    def __init__(
        self, motion: Motion, start: Trajectory, mat_ins_lidar: Array, lever_m: Array, gyro_bias: Array,
        fixes: Positions | None, keep: bool = True, attitudes: Attitudes | None = None,
    ) -> None:  # fmt: skip
        self.motion, self._start, self._mat, self._lever = motion, start, mat_ins_lidar, lever_m
        self._bias, self._fixes, self._keep, self._attitudes = gyro_bias, fixes, keep, attitudes
        self.odometry: Odometry | None = None
        self.track: Track | None = None
        self._next_fix, self._far, self._next_attitude_ns = 0, 0, 0
        self._range_m = 0.0
        self._bearing = Bearing(np.zeros(3))

    def feed(self, piece: Slice) -> Step | None:
        """Take the next slice; None before the start, and where the inertial data have ended."""
        if self.odometry is None:
            state = self._state_at(piece.number)
            if state is None:
                return None
            self._range_m = _median_range(piece)
            voxel_m = _edge(self._range_m)
            self.odometry = Odometry(state, self.motion, piece.number, voxel_m)
            self._bearing = Bearing(state.position_m.copy())
            self.track = Track(piece.number, [state.quat.copy()], [state.position_m.copy()], voxel_m=voxel_m)
        assert self.track is not None
        if piece.number < self.odometry.number or (piece.number + 1) * STEPS > len(self.motion):
            return None
        while self.odometry.number < piece.number:  # nothing was seen
            self.odometry.propagate(self.odometry.number)
            self._take_attitude()
            self._take_fixes()
            self._note(None)
        self._follow_range(piece)
        step = self.odometry.step(piece)
        self._take_attitude()
        self._take_fixes()
        self._note(step)
        return step

    def _follow_range(self, piece: Slice) -> None:
        """Wider voxels as the ranges grow, and narrower ones again; what the map holds is taken along."""
        assert self.odometry is not None
        assert self.track is not None
        self._range_m += 0.05 * (_median_range(piece) - self._range_m)
        voxel_m = _edge(self._range_m, self.odometry.voxel_m)
        if voxel_m != self.odometry.voxel_m:
            self.odometry.change_voxels(voxel_m)
            self.track.voxel_m = voxel_m

    def _note(self, step: Step | None) -> None:
        track, odometry = self.track, self.odometry
        assert track is not None
        assert odometry is not None
        state = odometry.state
        track.quat.append(state.quat.copy())
        track.position_m.append(state.position_m.copy())
        track.velocity_m_s.append(state.velocity_m_s.copy())
        track.gyro_bias.append(state.gyro_bias_rad_s.copy())
        track.sigma.append(np.sqrt(np.diag(state.covariance)[:6]))
        track.matched.append(0 if step is None else step.matched)
        track.seen.append(0 if step is None else step.seen)
        track.residual_m.append(float("nan") if step is None else step.residual_m)
        if step is None or not self._keep:
            track.clusters.append(_NONE)
        else:
            track.clusters.append(thinned(step.clusters, step.world_m, odometry.map, KEPT))

    def _take_attitude(self) -> None:
        """The autopilot's attitude of now, once a second."""
        given, odometry = self._attitudes, self.odometry
        if given is None or odometry is None:
            return
        now_ns = self.motion.start_ns + odometry.number * SLICE_NS
        i = int(np.searchsorted(given.time_ns, now_ns)) - 1
        if now_ns < self._next_attitude_ns or i < 0:
            return
        age_s = (now_ns - int(given.time_ns[i])) * 1e-9
        if age_s > 0.2:
            return
        rate = self.motion.rate_rad_s[max(odometry.number * STEPS - STEPS, 0) : odometry.number * STEPS].mean(axis=0)
        turn = age_s * (rate - odometry.state.gyro_bias_rad_s)
        mat = (
            frames.mat_from_quat(given.quat[i][None])[0]
            @ self._mat
            @ frames.mat_from_quat(frames.quat_exp(turn[None]))[0]
        )
        odometry.attitude_fix(frames.quat_from_mat(mat[None])[0], ATTITUDE_FIX_RAD)
        self._next_attitude_ns = now_ns + ATTITUDE_EVERY_NS

    def _take_fixes(self) -> None:
        """Fixes up to now; their errors last, so each counts for little, and only where the lidar cannot tell."""
        fixes, odometry = self._fixes, self.odometry
        if fixes is None or odometry is None:
            return
        now_ns = self.motion.start_ns + odometry.number * SLICE_NS
        while self._next_fix < len(fixes.time_ns) and fixes.time_ns[self._next_fix] <= now_ns:
            i = self._next_fix
            self._next_fix += 1
            age_s = (now_ns - int(fixes.time_ns[i])) * 1e-9
            if age_s > 0.5:
                continue
            rate_hz = 1e9 / max(float(np.median(np.diff(fixes.time_ns[max(i - 5, 0) : i + 6]))), 1e7)
            state = odometry.state
            mat = frames.mat_from_quat(state.quat[None])[0]
            place = fixes.position_m[i] + age_s * state.velocity_m_s - mat @ fixes.lever_m
            place = self._bearing.on_map(state.position_m, place, float(fixes.sigma_m[i, :2].mean()))
            sigma = fixes.sigma_m[i] * np.sqrt(max(2.0 * FIX_TAU_S * rate_hz, 1.0))
            off = np.abs(place - state.position_m)
            self._far = self._far + 1 if (off > np.maximum(LOST_M, LOST_SIGMAS * fixes.sigma_m[i])).any() else 0
            odometry.position_fix(place, sigma)
            if self._far >= LOST_FIXES:
                self._restart()

    def _restart(self) -> None:
        assert self.odometry is not None
        assert self.track is not None
        state = self._state_at(self.odometry.number)
        if state is not None:
            self.odometry.state, self.odometry.map = state, PlaneMap(self.odometry.voxel_m)
            self.track.restarts += 1
            self._far = 0
            self._bearing = Bearing(state.position_m.copy())

    def _state_at(self, number: int) -> State | None:
        """The rough trajectory's state of the sensor at the start of a slice."""
        time_ns = self.motion.start_ns + number * SLICE_NS
        if number * STEPS >= len(self.motion) or not self.motion.known[number * STEPS]:
            return None
        around = np.array([time_ns, time_ns - 250_000_000, time_ns + 250_000_000])
        poses, covered = self._start.where_covered(around)
        if not covered[0]:
            return None
        mats = frames.mat_from_quat(poses.quat_local_ins_wxyz)
        places = poses.position_m + mats @ self._lever
        if covered.all():
            velocity = (places[2] - places[1]) / 0.5
        else:
            near = 2 if covered[2] else 1
            velocity = (places[near] - places[0]) / (0.25 if near == 2 else -0.25) if covered[near] else np.zeros(3)
        s = START_SIGMA
        sigma = np.concatenate(
            [
                np.full(3, np.deg2rad(s["attitude_deg"])), np.full(3, 1e-3), np.full(3, s["velocity_m_s"]),
                np.full(3, np.deg2rad(s["gyro_deg_s"])), np.full(3, s["accel_m_s2"]),
                np.array([s["gravity_m_s2"], s["gravity_m_s2"], 1e-4]),
            ]
        )  # fmt: skip
        bias = self._bias if self.track is None or not self.track.gyro_bias else self.track.gyro_bias[-1]
        quat = frames.quat_from_mat((mats[0] @ self._mat)[None])[0]
        gravity = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
        return State(quat, places[0].copy(), velocity, bias.copy(), np.zeros(3), gravity, np.diag(sigma**2))


def _median_range(piece: Slice) -> float:
    """Median range of a slice's returns [m]; a sixteenth of them will do."""
    return float(np.median(np.linalg.norm(piece.xyz_m[::16], axis=1))) if len(piece.xyz_m) else 0.0


def _edge(range_m: float, now_m: float = 0.0) -> float:
    """Edge of the voxels for a median range; one in use is kept until the range is 15 % past the border."""
    for edge, border in zip(VOXELS_M, (*WIDE_AT_M, np.inf), strict=True):
        if range_m < border * (1.0 if now_m == 0.0 else (1.15 if now_m <= edge else 0.85)):
            return edge
    return VOXELS_M[-1]


def tracked(tracker: Tracker) -> Track:
    """The track, when all slices are fed.

    Raises
    ------
    LogError
        Not enough of them could be placed.
    """
    track = tracker.track
    if track is None or len(track) < FEWEST:
        raise LogError(
            f"adjusted: {0 if track is None else len(track)} tenths of a second with lidar, inertial data and position together, "
            f"expected {FEWEST} or more"
        )
    return track


_NONE: Final = np.empty(0, CLUSTER_DTYPE)


def thinned(clusters: npt.NDArray[np.void], world_m: Array, planes: PlaneMap, most: int) -> npt.NDArray[np.void]:
    """At most about `most` clusters, by voxels and not one by one, so that those kept are seen by many slices.

    Ground, other planes, and what is no plane yet share evenly.
    """
    if len(clusters) <= most:
        return clusters
    kind, draw = np.empty(len(clusters), np.int64), np.empty(len(clusters))
    _sort_out(world_m, planes.arrays, kind, draw)
    counts = np.bincount(kind, minlength=3)
    share = even_shares(counts, most)
    return clusters[draw < share[kind]]


def even_shares(counts: Sequence[int] | npt.NDArray[np.int64], most: int) -> Array:
    """Part of each kind to keep: even numbers, and what one kind does not use goes to the others."""
    share, left = np.ones(len(counts)), float(most)
    for rank, i in enumerate(np.argsort(counts)):
        level = left / (len(counts) - rank)
        share[i] = min(1.0, level / max(int(counts[i]), 1))
        left -= min(level, float(counts[i]))
    return share


@njit(cache=True, nogil=True)
def _sort_out(world: Array, planes: MapArrays, kind: Ints, draw: Array) -> None:
    table, keys, voxels, voxel_m = planes
    for n in range(len(world)):
        key = voxel_key(world[n, 0], world[n, 1], world[n, 2], 1.0 / voxel_m)
        row = find(table, keys, key)
        kind[n] = 2
        if row >= 0 and voxels[row, FLATNESS] >= 0.0:
            kind[n] = 0 if abs(voxels[row, NORMAL + 2]) > 0.9 else 1
        draw[n] = (spread(key * 7919) & 0xFFFFF) / 1048576.0


def boundaries_ns(track: Track, motion: Motion) -> Ints:
    """UTC of the slice boundaries."""
    return motion.start_ns + (track.first + np.arange(len(track) + 1)) * SLICE_NS


def grid_ns(path: Path) -> Ints:
    """UTC of the grid."""
    return path.start_ns + np.arange(len(path.quat)) * STEP_NS
