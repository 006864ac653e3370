"""From packets, inertial samples and the autopilot to poses, slice after slice: the causal odometry, driven as things arrive."""

from collections import deque
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError
from flightlog.mount import Mount
from groundproc.estimation import ins
from groundproc.estimation.odometry.grid import SLICE_NS
from groundproc.estimation.odometry.motion import INS_FORCES, LEAST_BASE_HZ, Motion
from groundproc.estimation.odometry.slices import Slice
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.track import (
    ATTITUDE_EVERY_NS,
    ATTITUDE_FIX_RAD,
    FIX_TAU_S,
    LOST_FIXES,
    LOST_M,
    LOST_SIGMAS,
    Track,
    Tracker,
)
from groundproc.flight.autopilot import Boot
from groundproc.flight.sync import GyroTrack
from groundproc.geodesy import LocalFrame
from groundproc.live.clocks import LidarTimes, Synchroniser, Tie
from groundproc.live.motion import GrowingMotion, MotionBuilder, Samples
from groundproc.live.slicer import Shots, Slicer
from groundproc.live.start import RoughPoses, autopilot_poses, gyro_offset
from groundproc.live.telemetry import Telemetry
from groundproc.sensors.shots import Gate
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

LEAST_SAMPLES_NS: Final = 3 * NS_PER_S
"""Inertial data that must be there before the odometry begins: the gyro's offset comes from them."""
HISTORY: Final = 100
"""Slices over which a late position is carried to now."""
_KEEP: Final = 8
LEAST_POSITION_SIGMA_M: Final = 0.02
_HEADING_TOO: Final = np.deg2rad([1.0, 1.0, 5.0])
"""What the pose that it began from may be off by: as in the causal method."""
_FORGET: Final = 500
"""Slices that the motion grid drops at once; a multiple of what the odometry counts by (50)."""


@dataclass(frozen=True, slots=True)
class Options:
    """What of a survey matters live."""

    mount: Mount
    height: str = "msl"
    gate: Gate = Gate(255.0, 105.0, 1.0, 100.0)  # noqa: RUF009 - it is frozen
    patience_ns: int = 400_000_000
    """How long to wait for lidar or inertial data that the other is ahead of."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where the sensor was at the end of a slice, and what told it.

    Attributes
    ----------
    end_ns : int
        Lidar time.
    utc_ns : int
    position_m : ndarray, shape (3,)
        Of the ins frame, east, north, up.
    quat_local_ins_wxyz : ndarray, shape (4,)
    velocity_m_s : ndarray, shape (3,)
        Of the sensor.
    sigma_m, sigma_rad : ndarray, shape (3,)
    matched, seen : int
        Clusters that found a plane, and all.
    residual_m : float
    shots : Shots
    path : Path
        The sensor's over the slice.
    """

    end_ns: int
    utc_ns: int
    position_m: Array
    quat_local_ins_wxyz: Array
    velocity_m_s: Array
    sigma_m: Array
    sigma_rad: Array
    matched: int
    seen: int
    residual_m: float
    shots: Shots
    path: Path


@dataclass(slots=True)
class Figures:
    """What is counted over the whole session."""

    slices: int = 0
    blind_slices: int = 0
    """Without a return of the lidar."""
    skipped_slices: int = 0
    """Whose returns were dropped because the computer is too slow."""
    thinned_slices: int = 0
    filled_steps: int = 0
    """Steps of 5 ms without inertial data."""
    restarts: int = 0
    clock_jumps: int = 0
    fixes: int = 0
    old_fixes: int = 0
    """Positions too late to be used."""


class Estimator:
    """One run of the lidar's clock.

    Parameters
    ----------
    options : Options
    telemetry : Telemetry
    figures : Figures
    frame : LocalFrame or None
        Of the run before; else the first position gives it.
    """

    def __init__(self, options: Options, telemetry: Telemetry, figures: Figures, frame: LocalFrame | None) -> None:
        self.options, self.frame, self.figures = options, frame, figures
        self.slicer = Slicer(options.gate)
        self.times = LidarTimes()
        self.own, self.other = Samples("lidar"), Samples("autopilot")
        self.state = "waiting for the autopilot"
        self.sync = Synchroniser(options.mount.mat_ins_lidar())
        self.thinning = 1
        self.skipping = False
        self._telemetry = telemetry
        self._mat, self._lever = options.mount.mat_ins_lidar(), options.mount.lidar_position_m()
        antenna = np.zeros(3) if options.mount.gps_position_m is None else np.array(options.mount.gps_position_m)
        self._antenna = self._mat.T @ (antenna - self._lever)
        self._axes = np.eye(3)
        self._tracker: Tracker | None = None
        self._builder: MotionBuilder | None = None
        self._reboots = telemetry.reboots
        self._utc_offset_ns = 0
        self._utc_settled = False
        self._start_sigma = np.zeros(3)
        self._history: deque[tuple[int, Array, Array]] = deque(maxlen=HISTORY)
        self._next_attitude_ns = 0
        self._last_fix_ns = -(1 << 62)
        self._far = 0
        self._next_try_s = self._next_poll_s = 0.0

    # What comes -----------------------------------------------------------------------------------------------------

    def inertial(self, time_ns: Times, rate_rad_s: Array, force_m_s2: Array) -> None:
        """Take samples of the lidar's own unit on its clock, shape (n,), (n, 3), (n, 3)."""
        self.own.add(time_ns, rate_rad_s @ self._axes.T, force_m_s2)

    @property
    def tie(self) -> Tie | None:
        """The clocks' tie as known."""
        return self.sync.tie

    @property
    def uses_autopilot(self) -> bool:
        """Whether the motion between revolutions is the autopilot's, for want of the lidar's own unit."""
        return self.own.span_ns < LEAST_SAMPLES_NS

    def advance(self) -> list[Place]:
        """Go on as far as the data allow."""
        heard = [each for each in (self.slicer.last_ns, self.own.last_ns) if each is not None]
        if not heard:
            return []
        # the flight's own clock: a log that is read faster than it was flown is treated alike
        now_s = max(heard) / NS_PER_S
        if self._telemetry.reboots != self._reboots:
            self._reboots = self._telemetry.reboots
            self.sync.forget()
            self._last_fix_ns = -(1 << 62)
        self._tie(now_s)
        self._poll(now_s)
        if self._builder is None:
            self._try_start(now_s)
        if self._builder is None:
            return []
        found: list[Place] = []
        while (place := self._next()) is not None:
            found += place
        return found

    def _tie(self, now_s: float) -> None:
        if self.sync.is_due(now_s):
            gyro = None
            if self.own.span_ns > 0:
                time, rate, _ = self.own.all()
                gyro = GyroTrack("the lidar", time, rate)
            self.sync.begin(now_s, self.times, gyro, self._telemetry.latest(60.0))
        if self.sync.collect(now_s) and self.tie is not None:
            if self._utc_offset_ns and self.tie.method == "gyro" and not self._utc_settled:
                # once: receive times were late by the link's delay
                self._utc_offset_ns, self._utc_settled = self.tie.utc_offset_ns, True
            axes = self.tie.axes
            if axes is not None and not np.array_equal(axes, np.eye(3)):
                # the unit's axes are others than the manual's: all that was made with them is void
                self._axes = axes @ self._axes
                self.own = Samples("lidar")
                self._tracker = self._builder = None
                self.figures.restarts += 1

    def _poll(self, now_s: float) -> None:
        """New positions of the autopilot, and its inertial samples where the lidar has none."""
        if now_s < self._next_poll_s or self.tie is None:
            return
        self._next_poll_s = now_s + (0.1 if self.uses_autopilot else 0.3)
        boot = self._telemetry.boot(3.0)
        if boot is None:
            return
        self._take_inertial(boot, self.tie)
        if self._tracker is not None and self._tracker.odometry is not None:
            self._take_attitude(boot, self.tie)
            self._take_fixes(boot, self.tie)

    def _take_inertial(self, boot: Boot, tie: Tie) -> None:
        tracks = [track for track in boot.gyros() if 0.0 < track.rate_hz < 1e3]
        if not tracks:
            return
        # a series with forces before a slightly faster one without
        felt = {name for name, _ in INS_FORCES}
        best = max(tracks, key=lambda track: track.rate_hz * (2.0 if track.name in felt else 1.0))
        force = np.full_like(best.rate_rad_s, np.nan)
        for name, unit in INS_FORCES:
            if best.name == name:
                frd = np.stack([boot.tables[name][f].astype(np.float64) for f in ("xacc", "yacc", "zacc")], axis=1)
                force = frames.ins_from_frd(frd * unit)
        self.other.add(tie.lidar_ns(best.time_ns), best.rate_rad_s @ self._mat, force @ self._mat)

    # Start ----------------------------------------------------------------------------------------------------------

    def _try_start(self, now_s: float) -> None:
        if now_s < self._next_try_s:
            return
        self._next_try_s = now_s + 0.25
        reason = self._start()
        self.state = reason or "starting"

    def _start(self) -> str:
        """Make tracker and motion; else say what is missing."""
        if not self._telemetry.is_there:
            return "waiting for the autopilot's heartbeat"
        tie = self.tie
        if tie is None:
            return f"tying the clocks{': ' + self.sync.trouble if self.sync.trouble else ''}"
        boot = self._telemetry.boot(60.0)
        if boot is None or not ins.has_position(boot):
            return "waiting for a position of the autopilot"
        if ins.attitude_source(boot) is None:
            return "waiting for attitudes of the autopilot (ATTITUDE)"
        units = self._units()
        if units is None:
            return "waiting for 3 s of a gyro of 20 Hz and an accelerometer, the lidar's (port 8308) or the autopilot's (RAW_IMU)"
        rates, forces, spare = units
        bias = gyro_offset(self.own, boot, tie, self._mat) if rates is self.own else np.zeros(3)
        if bias is None:
            return "waiting for rates of the autopilot, to know the offset of the lidar's gyros"
        known = self._autopilot_poses(boot, tie)
        if known is None or self.slicer.last_ns is None:
            return "waiting for positions and attitudes of the autopilot"
        self._begin(rates, forces, spare, bias, known)
        return ""

    def _units(self) -> tuple[Samples, Samples, Samples | None] | None:
        """Who gives rates, who forces, and who fills gaps."""
        own, other = self.own.track(), self.other.track()
        rates = next(
            (
                samples
                for samples, track in ((self.own, own), (self.other, other))
                if track is not None and track.rate_hz >= LEAST_BASE_HZ and samples.span_ns >= LEAST_SAMPLES_NS
            ),
            None,
        )
        forces = next(
            (
                samples
                for samples, track in ((self.own, own), (self.other, other))
                if track is not None and np.isfinite(track.sigma_force_m_s2)
            ),
            None,
        )
        if rates is None or forces is None:
            return None
        return rates, forces, self.other if rates is self.own and other is not None else None

    def _autopilot_poses(self, boot: Boot, tie: Tie) -> Trajectory | None:
        if self.frame is None:
            try:
                fixes = ins.position_fixes(boot, self.options.height)
            except LogError:
                return None
            self.frame = LocalFrame(
                float(fixes.latitude_deg[0]), float(fixes.longitude_deg[0]), float(fixes.height_m[0])
            )
        return autopilot_poses(boot, self.options.height, self.frame, tie, self.options.mount)

    def _begin(self, rates: Samples, forces: Samples, spare: Samples | None, bias: Array, known: Trajectory) -> None:
        """Motion from where the autopilot's poses end, so that they can be carried on; slices follow as they come."""
        assert self.slicer.last_ns is not None
        assert self.tie is not None
        rate, force = rates.track(), forces.track()
        assert rate is not None
        assert force is not None
        begin_ns = min(self.slicer.last_ns, int(known.time_ns[-1])) // SLICE_NS * SLICE_NS
        motion = GrowingMotion(begin_ns, rate.rate_density(), force.force_density(), rates.name)
        self._builder = MotionBuilder(motion, rates, forces, spare)
        self._utc_offset_ns = self._utc_offset_ns or self.tie.utc_offset_ns
        self._start_sigma = known.sigma_position_m[-1].copy()
        self._number = begin_ns // SLICE_NS
        self._make_tracker(known, motion, bias)

    def _make_tracker(self, known: Trajectory, motion: GrowingMotion, bias: Array) -> None:
        start = RoughPoses(known, motion, bias, self._mat)
        # both have what the tracker uses of a Motion and of a Trajectory, and grow
        self._tracker = Tracker(
            cast(Motion, motion), cast(Trajectory, start), self._mat, self._lever, bias, None, keep=False
        )
        self._history.clear()
        self._far = 0

    # Slices ---------------------------------------------------------------------------------------------------------

    def _next(self) -> list[Place] | None:
        """Do the next slice; None where it is not due, an empty list where it gives no pose."""
        builder, slicer, patience_ns = self._builder, self.slicer, self.options.patience_ns
        if builder is None or self._tracker is None or slicer.last_ns is None:
            return None
        motion, end_ns = builder.motion, (self._number + 1) * SLICE_NS
        lidar_ns, inertial_ns = slicer.last_ns, builder_ns(self.own, self.other, builder)
        # a packet spans 0.6 ms and may come after the next
        if lidar_ns < end_ns + 2_000_000 and inertial_ns < end_ns + patience_ns:
            return None
        if motion.end_ns < end_ns:
            builder.advance(end_ns if lidar_ns > end_ns + patience_ns else 0)
        if motion.end_ns < end_ns:
            return None
        shots = slicer.take(self._number).thinned(self.thinning)
        if self.skipping:
            shots = shots.thinned(1 << 30)
        self._number += 1
        self._count(shots)
        if motion.is_full:
            self._forget(motion)
        number = end_ns // SLICE_NS - 1 - motion.start_ns // SLICE_NS
        step = self._tracker.feed(Slice(number, shots.time_ns, np.ascontiguousarray(shots.xyz_m)))
        if step is None:
            self.state = "waiting for a pose to begin from"
            self._refresh_start()
            return []
        self.state = "tracking" if len(shots.time_ns) else "the lidar is silent, inertial data only"
        return [self._place(end_ns, step.matched, step.seen, step.residual_m, shots)]

    def _count(self, shots: Shots) -> None:
        figures = self.figures
        figures.slices += 1
        figures.blind_slices += not len(shots.time_ns)
        figures.skipped_slices += self.skipping
        figures.thinned_slices += self.thinning > 1 and not self.skipping
        if self._builder is not None:
            figures.filled_steps += self._builder.filled
            self._builder.filled = 0

    def _refresh_start(self) -> None:
        """Until the first pose is found, begin from the newest the autopilot has."""
        tracker, builder, tie = self._tracker, self._builder, self.tie
        boot = self._telemetry.boot(5.0)
        if tracker is None or tracker.odometry is not None or builder is None or tie is None or boot is None:
            return
        known = self._autopilot_poses(boot, tie)
        if known is not None:
            self._make_tracker(known, builder.motion, self._bias())

    def _bias(self) -> Array:
        tracker = self._tracker
        if tracker is not None and tracker.odometry is not None:
            return tracker.odometry.state.gyro_bias_rad_s.copy()
        boot, tie = self._telemetry.boot(60.0), self.tie
        found = None
        if (
            boot is not None
            and tie is not None
            and self._builder is not None
            and self._builder.motion.source == "lidar"
        ):
            found = gyro_offset(self.own, boot, tie, self._mat)
        return np.zeros(3) if found is None else found

    def _place(self, end_ns: int, matched: int, seen: int, residual_m: float, shots: Shots) -> Place:
        assert self._tracker is not None
        assert self._tracker.track is not None
        assert self._tracker.odometry is not None
        track, state = self._tracker.track, self._tracker.odometry.state
        path = self._last_path(track)
        quat = path.quat[-1]
        mat = frames.mat_from_quat(quat[None])[0] @ self._mat.T
        self._history.append((end_ns, self._antenna_m(), quat.copy()))
        sigma = track.sigma[-1]
        return Place(
            end_ns, end_ns + self._utc_offset_ns, state.position_m - mat @ self._lever, frames.quat_from_mat(mat[None])[0],
            state.velocity_m_s.copy(), np.hypot(sigma[3:], self._start_sigma), np.hypot(sigma[:3], _HEADING_TOO),
            matched, seen, residual_m, shots, path,
        )  # fmt: skip

    def _last_path(self, track: Track) -> Path:
        """The path over the last slice; and forget what was before, for a flight has no end here."""
        count = len(track)
        last = Track(
            track.first + count - 1, track.quat[-2:], track.position_m[-2:], track.velocity_m_s[-1:], track.gyro_bias[-1:],
            clusters=track.clusters[-1:],
        )  # fmt: skip
        assert self._tracker is not None
        path = last.causal_path(self._tracker.motion)
        if count > 2 * _KEEP:
            gone = count - _KEEP
            track.first += gone
            for table in (
                track.quat, track.position_m, track.velocity_m_s, track.gyro_bias, track.sigma, track.clusters,
                track.matched, track.seen, track.residual_m,
            ):  # fmt: skip
                del table[:gone]
        return path

    def _forget(self, motion: GrowingMotion) -> None:
        """Let the grid begin later; all numbers of slices count from there."""
        motion.forget(_FORGET)
        tracker = self._tracker
        if tracker is not None and tracker.odometry is not None and tracker.track is not None:
            tracker.odometry.number -= _FORGET
            tracker.track.first -= _FORGET

    # Positions ------------------------------------------------------------------------------------------------------

    def _antenna_m(self) -> Array:
        assert self._tracker is not None
        assert self._tracker.odometry is not None
        state = self._tracker.odometry.state
        return np.asarray(state.position_m + frames.mat_from_quat(state.quat[None])[0] @ self._antenna)

    def _take_fixes(self, boot: Boot, tie: Tie) -> None:
        """Positions since the last look: soft, for their errors last; each compared with the pose of its own time."""
        try:
            fixes = ins.position_fixes(boot, self.options.height)
        except LogError:
            return
        new = np.flatnonzero(fixes.time_ns > self._last_fix_ns)
        if not len(new) or not self._history or self.frame is None:
            return
        self._last_fix_ns = int(fixes.time_ns[-1])
        place = self.frame.from_geodetic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)
        times = tie.lidar_ns(fixes.time_ns)
        rate_hz = 1e9 / max(float(np.median(np.diff(fixes.time_ns))), 1e7)
        for i in new.tolist():
            sigma = np.maximum(fixes.sigma_m[i], LEAST_POSITION_SIGMA_M)
            self._take_fix(int(times[i]), place[i], np.asarray(sigma), rate_hz)

    def _take_fix(self, time_ns: int, place: Array, sigma_m: Array, rate_hz: float) -> None:
        tracker = self._tracker
        if tracker is None or tracker.odometry is None or not self._history:
            return
        stamps = np.array([t for t, _, _ in self._history], np.int64)
        if time_ns < stamps[0] - SLICE_NS:
            self.figures.old_fixes += 1
            return
        then = np.array([p for _, p, _ in self._history])
        state = tracker.odometry.state
        was = np.array([np.interp(time_ns, stamps, axis) for axis in then.T])
        if time_ns > stamps[-1]:
            was = was + (time_ns - stamps[-1]) * 1e-9 * state.velocity_m_s
        off = place - was
        self.figures.fixes += 1
        self._far = self._far + 1 if (np.abs(off) > np.maximum(LOST_M, LOST_SIGMAS * sigma_m)).any() else 0
        tracker.odometry.position_fix(
            state.position_m + off, sigma_m * float(np.sqrt(max(2.0 * FIX_TAU_S * rate_hz, 1.0)))
        )
        if self._far >= LOST_FIXES:
            self._restart()

    def _take_attitude(self, boot: Boot, tie: Tie) -> None:
        """The autopilot's newest attitude, once a second, turned on by what the path has turned since its time."""
        tracker = self._tracker
        if tracker is None or tracker.odometry is None or not self._history or ins.attitude_source(boot) is None:
            return
        _, boot_ns, quat, _ = ins.attitudes(boot)
        time_ns = int(tie.lidar_ns(boot_ns[-1:])[0])
        stamps = np.array([t for t, _, _ in self._history], np.int64)
        if time_ns < max(self._next_attitude_ns, int(stamps[0])):
            return
        self._next_attitude_ns = time_ns + ATTITUDE_EVERY_NS
        # between two slices on a straight line: what is off is small beside the 3 deg that it is taken with
        last = int(np.clip(np.searchsorted(stamps, time_ns), 1, len(stamps) - 1)) if len(stamps) > 1 else 0
        before, after = (frames.mat_from_quat(self._history[i][2][None])[0] for i in (max(last - 1, 0), last))
        share = np.clip((time_ns - stamps[max(last - 1, 0)]) / SLICE_NS, 0.0, 1.0)
        turn = frames.quat_log(frames.quat_from_mat((before.T @ after)[None]))
        then = before @ frames.mat_from_quat(frames.quat_exp(share * turn))[0]
        now = frames.mat_from_quat(tracker.odometry.state.quat[None])[0]
        measured = frames.mat_from_quat(quat[-1:])[0] @ self._mat @ then.T @ now
        tracker.odometry.attitude_fix(frames.quat_from_mat(measured[None])[0], ATTITUDE_FIX_RAD)

    def _restart(self) -> None:
        """The odometry has lost its way: begin anew from the autopilot's pose, with a new map."""
        boot, tie, builder = self._telemetry.boot(5.0), self.tie, self._builder
        known = self._autopilot_poses(boot, tie) if boot is not None and tie is not None else None
        if known is None or builder is None:
            return
        self.figures.restarts += 1
        self._make_tracker(known, builder.motion, self._bias())


def builder_ns(own: Samples, other: Samples, builder: MotionBuilder) -> int:
    """Lidar time of the newest inertial sample of the unit in use [ns]."""
    samples = own if builder.motion.source == own.name else other
    return samples.last_ns or 0
