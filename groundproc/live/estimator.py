"""From packets, inertial samples and the autopilot to places, slice after slice: the causal odometry, driven as things arrive."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from flightlog.mount import Mount
from groundproc.estimation import ownsolution
from groundproc.estimation.odometry.grid import SLICE_NS
from groundproc.estimation.odometry.odometry import Step
from groundproc.estimation.odometry.slices import Slice
from groundproc.estimation.odometry.track import Track
from groundproc.estimation.odometry.tracker import Tracker
from groundproc.geodesy import LocalFrame
from groundproc.live.clocks import LidarTimes, Synchroniser, Tie
from groundproc.live.heard import Heard
from groundproc.live.motion import GrowingMotion, MotionBuilder
from groundproc.live.place import Figures, Place
from groundproc.live.slicer import Shots, Slicer
from groundproc.live.start import CarriedPoses
from groundproc.live.telemetry import Telemetry
from groundproc.live.units import Chosen, Units
from groundproc.sensors.shots import Gate
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

_KEEP: Final = 8
"""Slices of the track that are kept."""
_HEADING_TOO: Final = np.deg2rad([1.0, 1.0, 5.0])
"""What the pose that it began from may be off by: as in the causal method."""
_FORGET: Final = 500
"""Slices that the motion grid drops at once; a multiple of what the odometry counts by (50)."""
_LOOK_S: Final = 5.0
"""Of so many seconds the autopilot's poses are made to begin from."""


@dataclass(frozen=True, slots=True)
class Options:
    """What of a survey matters live."""

    mount: Mount
    height: str = "msl"
    gate: Gate = Gate(255.0, 105.0, 1.0, 100.0)  # noqa: RUF009 - it is frozen
    patience_ns: int = 400_000_000
    """How long to wait for lidar or inertial data that the other is ahead of."""
    gyro_delay_ns: int = 0
    """How late the readings of the lidar's own unit are against its returns."""


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
        self.options, self.figures = options, figures
        self.slicer = Slicer(options.gate)
        self.times = LidarTimes()
        self.state = "waiting for the autopilot"
        self.sync = Synchroniser(options.mount.mat_ins_lidar())
        self.thinning = 1
        self.skipping = False
        self._telemetry = telemetry
        self._mat, self._lever = options.mount.mat_ins_lidar(), options.mount.lidar_position_m()
        self._units = Units(self._mat)
        self._heard = Heard(telemetry, options.mount, options.height, frame)
        self._tracker: Tracker | None = None
        self._builder: MotionBuilder | None = None
        self._reboots = telemetry.reboots
        self._utc_offset_ns = 0
        self._utc_settled = False
        self._start_sigma = np.zeros(3)
        self._number = 0
        self._next_try_s = self._next_poll_s = 0.0

    # What comes -----------------------------------------------------------------------------------------------------

    def inertial(self, time_ns: Times, rate_rad_s: Array, force_m_s2: Array) -> None:
        """Take samples of the lidar's own unit as stamped on its clock, shape (n,), (n, 3), (n, 3)."""
        self._units.take_own(time_ns - self.options.gyro_delay_ns, rate_rad_s, force_m_s2)

    @property
    def tie(self) -> Tie | None:
        """The clocks' tie as known."""
        return self.sync.tie

    @property
    def frame(self) -> LocalFrame | None:
        """The local frame, once there was a position."""
        return self._heard.frame

    def advance(self) -> list[Place]:
        """Go on as far as the data allow."""
        heard = [each for each in (self.slicer.last_ns, self._units.own_last_ns) if each is not None]
        if not heard:
            return []
        # the flight's own clock: a log that is read faster than it was flown is treated alike
        now_s = max(heard) / NS_PER_S
        if self._telemetry.reboots != self._reboots:
            self._reboots = self._telemetry.reboots
            self.sync.forget()
            self._heard.forget()
        self._tie(now_s)
        self._poll(now_s)
        if self._builder is None:
            self._try_start(now_s)
        found: list[Place] = []
        while (place := self._next()) is not None:
            found += place
        return found

    def _tie(self, now_s: float) -> None:
        if self.sync.is_due(now_s):
            self.sync.begin(now_s, self.times, self._units.own_gyro(), self._telemetry.latest(60.0))
        if self.sync.collect(now_s) and self.tie is not None:
            if self._utc_offset_ns and self.tie.method == "gyro" and not self._utc_settled:
                # once: receive times were late by the link's delay
                self._utc_offset_ns, self._utc_settled = self.tie.utc_offset_ns, True
            axes = self.tie.axes
            if axes is not None and not np.array_equal(axes, np.eye(3)):
                self._units.turn_axes(axes)
                self._tracker = self._builder = None
                self.figures.restarts += 1
        self._heard.tie = self.tie

    def _poll(self, now_s: float) -> None:
        """What the autopilot states, and its inertial samples."""
        if now_s < self._next_poll_s or self.tie is None:
            return
        self._next_poll_s = now_s + (0.1 if self._units.needs_autopilot else 0.3)
        boot = self._telemetry.boot(3.0)
        if boot is None:
            return
        self._units.take_autopilots(boot, self.tie)
        self._heard.listen(boot, self.tie)

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
        if self.tie is None:
            return f"tying the clocks{': ' + self.sync.trouble if self.sync.trouble else ''}"
        boot = self._telemetry.boot(60.0)
        if boot is None or not ownsolution.has_position(boot):
            return "waiting for a position of the autopilot"
        if ownsolution.attitude_source(boot) is None:
            return "waiting for attitudes of the autopilot (ATTITUDE)"
        chosen = self._units.chosen()
        if chosen is None:
            return "waiting for 3 s of a gyro of 20 Hz and an accelerometer, the lidar's (port 8308) or the autopilot's (RAW_IMU)"
        bias = self._units.bias(chosen.rates.name, boot, self.tie)
        if bias is None:
            return "waiting for rates of the autopilot, to know the offset of the lidar's gyros"
        known = self._heard.poses(60.0)
        if known is None or self.slicer.last_ns is None:
            return "waiting for positions and attitudes of the autopilot"
        self._begin(chosen, bias, known, self.slicer.last_ns)
        return ""

    def _begin(self, chosen: Chosen, bias: Array, known: Trajectory, lidar_ns: int) -> None:
        """Motion from where the autopilot's poses end, so that they can be carried on; slices follow as they come."""
        assert self.tie is not None
        begin_ns = min(lidar_ns, int(known.time_ns[-1])) // SLICE_NS * SLICE_NS
        motion = GrowingMotion(
            begin_ns, chosen.rate_track.rate_density(), chosen.force_track.force_density(), chosen.rates.name
        )
        self._builder = MotionBuilder(motion, chosen.rates, chosen.forces, chosen.spare)
        self._utc_offset_ns = self._utc_offset_ns or self.tie.utc_offset_ns
        self._start_sigma = known.sigma_position_m[-1].copy()
        self._number = begin_ns // SLICE_NS
        self._make_tracker(known, motion, bias)

    def _make_tracker(self, known: Trajectory, motion: GrowingMotion, bias: Array) -> None:
        def newest() -> Trajectory | None:
            return self._heard.poses(_LOOK_S)

        def bias_now() -> Array:
            return tracker.gyro_bias()

        rough = CarriedPoses(known, newest, motion, bias_now, self._mat)
        tracker = Tracker(motion, rough, self._mat, self._lever, bias, self._heard, keep=False)
        self._tracker = tracker

    def _refresh_start(self, motion: GrowingMotion) -> None:
        """Until the first pose is found, begin from the newest the autopilot has, and with the newest bias."""
        known = self._heard.poses(_LOOK_S)
        if known is not None:
            bias = self._units.bias(motion.source, self._telemetry.boot(60.0), self.tie)
            self._make_tracker(known, motion, np.zeros(3) if bias is None else bias)

    # Slices ---------------------------------------------------------------------------------------------------------

    def _next(self) -> list[Place] | None:
        """Do the next slice; None where it is not due, an empty list where it gives no pose."""
        builder, tracker, lidar_ns = self._builder, self._tracker, self.slicer.last_ns
        if builder is None or tracker is None or lidar_ns is None:
            return None
        motion, end_ns = builder.motion, (self._number + 1) * SLICE_NS
        if not self._is_due(builder, lidar_ns, end_ns):
            return None
        shots = self.slicer.take(self._number).thinned(self.thinning)
        if self.skipping:
            shots = shots.thinned(1 << 30)
        self._number += 1
        self._count(builder, shots)
        if motion.is_full:
            motion.forget(_FORGET)
            tracker.forget(_FORGET)
        number = end_ns // SLICE_NS - 1 - motion.start_ns // SLICE_NS
        step = tracker.feed(Slice(number, shots.time_ns, np.ascontiguousarray(shots.xyz_m)))
        track = tracker.track
        if step is None or track is None:
            self.state = "waiting for a pose to begin from"
            if track is None:
                self._refresh_start(motion)
            return []
        self.state = "tracking" if len(shots.time_ns) else "the lidar is silent, inertial data only"
        return [self._place(end_ns, track, motion, step, shots)]

    def _is_due(self, builder: MotionBuilder, lidar_ns: int, end_ns: int) -> bool:
        """Whether all of a slice has come, lidar and motion, or enough time to go on without the one or the other."""
        motion, patience_ns = builder.motion, self.options.patience_ns
        inertial_ns = self._units.newest_ns(motion.source)
        # a packet spans 0.6 ms and may come after the next
        if lidar_ns < end_ns + 2_000_000 and inertial_ns < end_ns + patience_ns:
            return False
        if motion.end_ns < end_ns:
            builder.advance(end_ns if lidar_ns > end_ns + patience_ns else 0)
        return motion.end_ns >= end_ns

    def _count(self, builder: MotionBuilder, shots: Shots) -> None:
        figures = self.figures
        figures.slices += 1
        figures.blind_slices += not len(shots.time_ns)
        figures.skipped_slices += self.skipping
        figures.thinned_slices += self.thinning > 1 and not self.skipping
        figures.filled_steps += builder.filled
        builder.filled = 0

    def _place(self, end_ns: int, track: Track, motion: GrowingMotion, step: Step, shots: Shots) -> Place:
        figures = self.figures
        figures.restarts, track.restarts = figures.restarts + track.restarts, 0
        figures.fixes, track.fixes = figures.fixes + track.fixes, 0
        figures.old_fixes, track.late_fixes = figures.old_fixes + track.late_fixes, 0
        path = track.causal_path(motion, len(track) - 1)
        # a flight has no end here: what was before is not needed
        if len(track) > 2 * _KEEP:
            track.drop(len(track) - _KEEP)
        mat = frames.mat_from_quat(path.quat[-1:])[0] @ self._mat.T
        sigma = track.sigma[-1]
        return Place(
            end_ns, end_ns + self._utc_offset_ns, track.position_m[-1] - mat @ self._lever, frames.quat_from_mat(mat[None])[0],
            track.velocity_m_s[-1], np.hypot(sigma[3:], self._start_sigma), np.hypot(sigma[:3], _HEADING_TOO),
            step.matched, step.seen, step.residual_m, shots, path,
        )  # fmt: skip
