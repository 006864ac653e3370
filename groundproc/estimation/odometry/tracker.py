"""Drives the odometry over a recording or during a flight: start, silent slices, fixes, loss of the path."""

from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.errors import LogError
from groundproc.estimation.odometry.bearing import Bearing
from groundproc.estimation.odometry.grid import SLICE_NS, STEPS
from groundproc.estimation.odometry.growing import Growing
from groundproc.estimation.odometry.history import History
from groundproc.estimation.odometry.matching import TELLS_M
from groundproc.estimation.odometry.motion import MotionGrid
from groundproc.estimation.odometry.odometry import Odometry, Step
from groundproc.estimation.odometry.rejoining import Rejoining
from groundproc.estimation.odometry.rotor import Line
from groundproc.estimation.odometry.slices import Slice
from groundproc.estimation.odometry.start import RoughPoses, state_at
from groundproc.estimation.odometry.state import State
from groundproc.estimation.odometry.stated import Fix, Stated
from groundproc.estimation.odometry.track import KEPT, NO_CLUSTERS, Track, thinned
from groundproc.estimation.odometry.voxels import PlaneMap

Array = npt.NDArray[np.float64]

VOXELS_M: Final = (0.5, 1.0, 2.0)
"""Edges of the odometry's voxels; rings on the ground lie wider apart the higher one flies, and a voxel must see more than one."""
WIDE_AT_M: Final = (28.0, 60.0)
"""Median range from which on the second and the third are taken."""
LOST_M: Final = 15.0
LOST_SIGMAS: Final = 6.0
LOST_FIXES: Final = 8
"""So many consecutive fixes farther off than both limits mean that the odometry has lost the path: it begins anew,
unless the lidar holds it."""
CHECKED: Final = 10
"""Slices over which the path is compared with a guide's: a second."""
ASTRAY_M: Final = 1.5
"""What it may differ by; a smoother's velocity is right to 0.1 to 0.3 m/s."""
GUIDED_M_S: Final = 1.0
"""Sigma of a guide's velocity as it is taken slice by slice: right to 0.3 m/s, and its error lasts for a second at least."""
SURE_HELD_M: Final = 0.03
"""A path that slices observe better than this is left to the lidar."""
HELD_SHARE: Final = 0.98
"""Share of the slices that have to observe the path that well, for it to be held."""
FIX_TAU_S: Final = 1.0
"""The filter takes positions as if their errors lasted so long: light beside the lidar, and firm enough to hold it where there is none."""
RECENT_S: Final = 0.5
"""A position not older than this is carried on to now by the velocity; an older one is compared with where the path was."""
RECENT_ATTITUDE_S: Final = 0.2
ATTITUDE_EVERY_NS: Final = 1_000_000_000
ATTITUDE_FIX_RAD: Final = np.deg2rad([3.0, 3.0, 30.0])
"""The autopilot's attitude is taken once a second with these sigmas, about east, north and up; light in the same way."""
FEWEST: Final = 20
"""Slices that make a track."""


class Tracker:
    """The odometry with what keeps it going: start, silent slices, what the autopilot states, loss of the path.

    The causal method and the live view drive the same object; what differs between them is behind `MotionGrid`,
    `RoughPoses` and `Stated`.

    Parameters
    ----------
    motion : MotionGrid
    rough : RoughPoses
        To begin from.
    mat_ins_lidar, lever_m : ndarray, shape (3, 3), (3,)
        Nominal mount.
    gyro_bias : ndarray, shape (3,)
        Where to begin [rad/s].
    stated : Stated
    keep : bool
        Whether clusters are kept for the batch.
    guide : RoughPoses, optional
        Poses whose motion within a second is right to a few decimetres, as a smoother's is: an odometry that goes elsewhere, and is
        held by little, has lost its way.
    in_time : bool
        Whether poses are stated as they come: then the line of the spin is taken off in time. A batch finds it by surfaces.
    """

    def __init__(
        self, motion: MotionGrid, rough: RoughPoses, mat_ins_lidar: Array, lever_m: Array, gyro_bias: Array,
        stated: Stated, keep: bool = True, guide: RoughPoses | None = None, in_time: bool = True,
    ) -> None:  # fmt: skip
        self._in_time = in_time
        self.motion, self._rough, self._mat, self._lever = motion, rough, mat_ins_lidar, lever_m
        self._bias, self._stated, self.keep = gyro_bias, stated, keep
        self.odometry: Odometry | None = None
        self.track: Track | None = None
        self._far, self._near, self._next_attitude_ns = 0, 0, 0
        self._range_m, self._guide, self._checked = 0.0, guide, 0
        self._bearing = Bearing(np.zeros(3))
        self._history, self._begin_ns = History(), 0
        self._rejoining = Rejoining(in_time)

    def feed(self, piece: Slice) -> Step | None:
        """Take the next slice; None before the start, and where the inertial data have ended."""
        if self.odometry is None and not self._begin(piece):
            return None
        odometry, track = self.odometry, self.track
        assert odometry is not None
        assert track is not None
        if piece.number < odometry.number or (piece.number + 1) * STEPS > len(self.motion):
            return None
        while odometry.number < piece.number:  # nothing was seen
            odometry.propagate(odometry.number)
            self._take_stated(odometry)
            self._note(odometry, None)
        if len(piece.xyz_m):
            self._follow_range(odometry, piece)
        step = odometry.step(piece)
        if step.next_unheld_m <= TELLS_M < step.unheld_m:
            self._be_guided(odometry)
        self._take_stated(odometry)
        self._note(odometry, step)
        if self._rejoining.after(odometry, track) is not None:
            self._history.clear()
        if self._is_astray(odometry):
            self._restart(odometry, astray=True)
        return step

    def settle(self) -> None:
        """Wait for what is done beside the odometry: the track's clusters and attitudes are complete then."""
        if self.odometry is not None:
            self.odometry.settle()

    def gyro_bias(self) -> Array:
        """The bias as known by now [rad/s], shape (3,)."""
        return self._bias if self.track is None or not len(self.track.gyro_bias) else self.track.gyro_bias[-1]

    def forget(self, slices: int) -> None:
        """The grid of motion begins that many slices later: the numbers of slices count from there."""
        if self.odometry is not None and self.track is not None:
            self.odometry.number -= slices
            self.track.first -= slices
            self._near -= slices

    def _begin(self, piece: Slice) -> bool:
        state = self._state_at(piece.number)
        if state is None:
            return False
        self._range_m = _median_range(piece)
        voxel_m = _edge(self._range_m)
        line = Line() if self._in_time else None
        # who is told each pose as it comes would only wait for what is done beside
        self.odometry = Odometry(state, self.motion, piece.number, voxel_m, line, beside=not self._in_time)
        self.track = Track(piece.number, Growing(4, [state.quat]), Growing(3, [state.position_m]), voxel_m=voxel_m)
        self._set_out(state, piece.number)
        return True

    def _set_out(self, state: State, number: int) -> None:
        """A new map begins here, with the bearing of its first attitude."""
        self._begin_ns = self.motion.start_ns + number * SLICE_NS
        self._bearing = Bearing(state.position_m.copy())
        self._history.clear()
        self._history.add(self._begin_ns, state.position_m.copy(), state.quat.copy())
        self._far, self._near = 0, number

    def _follow_range(self, odometry: Odometry, piece: Slice) -> None:
        """Wider voxels as the ranges grow, and narrower ones again; what the map holds is taken along."""
        assert self.track is not None
        self._range_m += 0.05 * (_median_range(piece) - self._range_m)
        voxel_m = _edge(self._range_m, odometry.voxel_m)
        if voxel_m != odometry.voxel_m:
            odometry.change_voxels(voxel_m)
            self.track.voxel_m = voxel_m

    def _note(self, odometry: Odometry, step: Step | None) -> None:
        track, state = self.track, odometry.state
        assert track is not None
        track.quat.append(state.quat)
        track.position_m.append(state.position_m)
        track.velocity_m_s.append(state.velocity_m_s)
        track.gyro_bias.append(state.gyro_bias_rad_s)
        track.sigma.append(np.hypot(np.sqrt(np.diag(state.covariance)[:6]), self._rejoining.sigma()))
        track.matched.append(0 if step is None else step.matched)
        track.seen.append(0 if step is None else step.seen)
        track.residual_m.append(float("nan") if step is None else step.residual_m)
        # where turns are not found nobody asks for these, and a batch would keep them for the whole flight
        track.quats.append(None if step is None or not odometry.turns else step.quats)
        track.unheld_m.append(float("inf") if step is None else step.unheld_m)
        track.next_unheld_m.append(float("inf") if step is None else step.next_unheld_m)
        if step is None or not self.keep:
            track.clusters.append(NO_CLUSTERS)
        else:
            self._keep(step, odometry, len(track.clusters))
        self._rejoining.note(odometry, track.matched[-1], track.next_unheld_m[-1])
        track.apart = self._rejoining.left + len(self._rejoining.lost)
        now_ns = self._now_ns(odometry)
        if now_ns > self._begin_ns:
            self._history.add(now_ns, track.position_m[-1], track.quat[-1])

    def _keep(self, step: Step, odometry: Odometry, number: int) -> None:
        """Keep a slice's clusters for the batch: those of the last slice, by its number in the track."""
        assert self.track is not None
        kept = self.track.clusters
        kept.append(NO_CLUSTERS)

        def thin(planes: PlaneMap) -> None:
            kept[number] = thinned(step.clusters, step.world_m, planes, KEPT)

        odometry.afterwards(thin)

    # What the autopilot states --------------------------------------------------------------------------------------

    def _now_ns(self, odometry: Odometry) -> int:
        return self.motion.start_ns + odometry.number * SLICE_NS

    def _take_stated(self, odometry: Odometry) -> None:
        now_ns = self._now_ns(odometry)
        if now_ns >= self._next_attitude_ns:
            found = self._stated.attitude(now_ns)
            if found is not None:
                self._take_attitude(odometry, now_ns, *found)
        for fix in self._stated.fixes(now_ns):
            self._take_fix(odometry, now_ns, fix)

    def _take_attitude(self, odometry: Odometry, now_ns: int, time_ns: int, quat_local_ins_wxyz: Array) -> None:
        """An attitude, turned on by what the sensor has turned since its time."""
        age_s = (now_ns - time_ns) * 1e-9
        if age_s <= RECENT_ATTITUDE_S:
            last = slice(max(odometry.number * STEPS - STEPS, 0), odometry.number * STEPS)
            turn = age_s * (self.motion.rate_rad_s[last].mean(axis=0) - odometry.state.gyro_bias_rad_s)
            since = frames.mat_from_quat(frames.quat_exp(turn[None]))[0]
        else:
            was = self._history.at(time_ns)
            if was is None:
                return
            since = was.mat_map_sensor.T @ frames.mat_from_quat(odometry.state.quat[None])[0]
        mat = frames.mat_from_quat(quat_local_ins_wxyz[None])[0] @ self._mat @ since
        odometry.attitude_fix(frames.quat_from_mat(mat[None])[0], ATTITUDE_FIX_RAD)
        self._next_attitude_ns = now_ns + ATTITUDE_EVERY_NS

    def _take_fix(self, odometry: Odometry, now_ns: int, fix: Fix) -> None:
        """A position: what it is off by at its time is taken now.

        Its error lasts, so each counts for little, and only where the lidar cannot tell.
        """
        assert self.track is not None
        state, age_s = odometry.state, (now_ns - fix.time_ns) * 1e-9
        if age_s <= RECENT_S:
            way = state.position_m
            mat = frames.mat_from_quat(state.quat[None])[0]
            place = fix.position_m + age_s * state.velocity_m_s - mat @ self._stated.lever_m
        else:
            was = self._history.at(fix.time_ns)
            if was is None:
                self.track.late_fixes += fix.time_ns >= self._begin_ns
                return
            way, place = was.position_m, fix.position_m - was.mat_map_sensor @ self._stated.lever_m
        off = self._bearing.on_map(way, place, float(fix.sigma_m[:2].mean())) - way
        self.track.fixes += 1
        if not (np.abs(off) > np.maximum(LOST_M, LOST_SIGMAS * fix.sigma_m)).any():
            self._far, self._near = 0, odometry.number
        else:
            self._far += 1
        sigma_m = fix.sigma_m * np.sqrt(max(2.0 * FIX_TAU_S * fix.rate_hz, 1.0))
        before = state.position_m.copy()
        odometry.position_fix(before + off, sigma_m)
        self._history.shift(state.position_m - before)
        if self._far >= LOST_FIXES and not self._is_held(odometry):
            self._restart(odometry)

    def _is_held(self, odometry: Odometry) -> bool:
        """Whether the lidar has held the path firmly since the last fix that lay near it: then it is the fixes that went away."""
        assert self.track is not None
        since = np.array(self.track.unheld_m[-max(odometry.number - self._near, 1) :])
        return len(since) > 0 and float((since <= SURE_HELD_M).mean()) >= HELD_SHARE

    def _restart(self, odometry: Odometry, astray: bool = False) -> None:
        """The odometry has lost its way: begin anew from a rough pose, with a new map; `astray`: a guide told."""
        assert self.track is not None
        state = self._state_at(odometry.number)
        if state is not None:
            odometry.state, odometry.planes = state, PlaneMap(odometry.voxel_m)
            self.track.restarts += 1
            self.track.astray += astray
            self._rejoining.forget()
            self._set_out(state, odometry.number)

    def _be_guided(self, odometry: Odometry) -> None:
        """Take the guide's velocity where a slice leaves one direction open: what the lidar tells of the others is far firmer."""
        if self._guide is None:
            return
        now_ns = self._now_ns(odometry)
        poses, covered = self._guide.where_covered(np.array([now_ns - SLICE_NS, now_ns, now_ns + SLICE_NS]))
        if not covered.all():
            return
        mats = frames.mat_from_quat(poses.quat_local_ins_wxyz)
        places = poses.position_m + mats @ self._lever
        turned = frames.mat_from_quat(odometry.state.quat[None])[0] @ (mats[1] @ self._mat).T
        odometry.velocity_fix(turned @ (places[2] - places[0]) / (2e-9 * SLICE_NS), np.full(3, GUIDED_M_S))

    def _is_astray(self, odometry: Odometry) -> bool:
        """Whether the last second's way is not the guide's, though the lidar tells it, and not well: what is no surface holds it."""
        track = self.track
        assert track is not None
        first = len(track) - CHECKED
        if self._guide is None or first < self._checked:
            return False
        if not SURE_HELD_M < float(np.median(track.unheld_m[first:])) <= TELLS_M:
            return False
        self._checked = len(track)
        now_ns = self._now_ns(odometry)
        poses, covered = self._guide.where_covered(np.array([now_ns - CHECKED * SLICE_NS, now_ns]))
        if not covered.all():
            return False
        mats = frames.mat_from_quat(poses.quat_local_ins_wxyz)
        places = poses.position_m + mats @ self._lever
        turned = frames.mat_from_quat(odometry.state.quat[None])[0] @ (mats[1] @ self._mat).T
        way = track.position_m[-1] - track.position_m[first]
        return float(np.linalg.norm(way - turned @ (places[1] - places[0]))) > ASTRAY_M

    def _state_at(self, number: int) -> State | None:
        return state_at(number, self.motion, self._rough, self._mat, self._lever, self.gyro_bias())


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
    tracker.settle()
    track = tracker.track
    if track is None or len(track) < FEWEST:
        raise LogError(
            f"adjusted: {0 if track is None else len(track)} tenths of a second with lidar, inertial data and position together, "
            f"expected {FEWEST} or more"
        )
    return track
