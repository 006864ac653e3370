"""The odometry alone as an estimate.

Nothing of the future is used, with one exception: the first seconds are stated only once there is a map.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt

from flightlog.mount import Mount
from groundproc.estimation.adjustment.sensorpath import lost, of_ins
from groundproc.estimation.method import Given, Progress
from groundproc.estimation.observations.attitudes import ATTITUDE_SIGMA_RAD, attitude_track
from groundproc.estimation.observations.fixes import position_track
from groundproc.estimation.observations.rows import H
from groundproc.estimation.odometry.beginning import redo_beginning
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.motion import Motion, base_motion, gyro_offset
from groundproc.estimation.odometry.slices import Slice, slices
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Recorded
from groundproc.estimation.odometry.track import Track
from groundproc.estimation.odometry.tracker import Tracker, tracked
from groundproc.flight.timeline import Leg
from groundproc.sensors.lasers import LaserCorrections
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

SETTLING: Final = (60, 150)
"""Slices that are run again, against the map of their second half, for at the beginning there was none, and so are
stated late: six seconds where the lidar holds the path well, and up to fifteen where it does not."""
HELD_M: Final = 0.05
"""Sigma of the least observed direction of a slice, in the last second, from which on it holds the path well."""


@dataclass(slots=True)
class CausalRun:
    """The odometry alone: what was known at each moment, a tenth of a second late."""

    SIGMA_SOURCE: ClassVar = (
        "the filter's covariance; position and heading as uncertain as the fix, the compass and the level "
        "that it began from"
    )

    path: Path
    track: Track
    motion: Motion
    start_sigma_m: Array

    def mount(self, nominal: Mount) -> Mount:
        """The nominal mount: nothing else is known in time."""
        return nominal

    def trajectory(self, given: Given, mount: Mount) -> Trajectory:
        """The path as that of the ins frame."""
        sigma = np.array([self.track.sigma[0], *self.track.sigma])
        grid, knots = np.arange(len(self.path.quat)), np.arange(len(sigma)) * STEPS
        attitude, position = (
            np.stack([np.interp(grid, knots, axis) for axis in part.T], axis=1) for part in (sigma[:, :3], sigma[:, 3:])
        )
        whole = ATTITUDE_SIGMA_RAD * np.array([1.0, 1.0, 2.5])
        # the map has the first heading and tilt: what they are off moves what lies far from the start
        away = self.path.position_m - self.path.position_m[0]
        level = np.hypot(away[:, 0], away[:, 1])[:, None]
        swung = level * np.array([whole[2], whole[2], whole[0]])
        position = np.sqrt(position**2 + self.start_sigma_m**2 + swung**2)
        return of_ins(self.path, self.motion, given.frame, mount, position, np.hypot(attitude, whole))

    def bridged(self, made: Trajectory, begun: Trajectory) -> Trajectory:
        """As it is: what it began from knows of no more."""
        del begun
        return made

    def corrections(self) -> None:
        """The lasers are taken as they are given."""

    def lasers(self, nominal: LaserCorrections, count: int) -> LaserCorrections:
        """As they were given."""
        del count
        return nominal

    def mount_source(self, nominal: str) -> str:
        """The nominal mount's."""
        return nominal

    def mount_sigma(self, nominal: Mount) -> None:
        """Nothing is said of it."""

    def is_worse(self) -> bool:
        """It is what it is."""
        return False

    def warnings(self) -> list[str]:
        """What the self-check found."""
        return lost(self.track)

    def report(self, nominal: Mount) -> dict[str, Any]:
        """What stands in quality.json."""
        del nominal
        return {
            "causal": True,
            "seconds": len(self.track) * H,
            "restarts": self.track.restarts,
            "rejoined": self.track.rejoined,
            "apart": self.track.apart,
            "median_matched": float(np.median(self.track.matched)),
            "median_residual_m": float(np.nanmedian(self.track.residual_m)),
        }


def causal_run(given: Given, legs: Sequence[Leg], number: int, start: Trajectory, progress: Progress) -> CausalRun:
    """Odometry over one run of the lidar's clock, nothing of the future used but the gyro's offset."""
    motion, own, other = base_motion(given, legs[0], given.flight.runs[number], quieter=True)
    positions = position_track(given, legs[0])
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    stated = Recorded(positions, attitude_track(legs[0]))
    tracker = Tracker(motion, start, mat, lever, gyro_offset(motion, own, other), stated)
    early: list[Slice] = []
    for piece in slices(given, motion.start_ns, progress):
        tracker.feed(piece)
        if tracker.keep and tracker.track is not None and tracker.odometry is not None:
            early.append(piece)
            if _is_settled(tracker.track):
                whole = len(tracker.track)
                redo_beginning(tracker.track, motion, early, tracker.odometry, whole, mapped=whole // 2)
                tracker.keep = False
                tracker.track.forget(len(tracker.track))
                early.clear()
    track = tracked(tracker)
    return CausalRun(track.causal_path(motion), track, motion, positions.sigma_m[0])


def _is_settled(track: Track) -> bool:
    """Whether there is a map that the beginning can be run again against."""
    fewest, most = SETTLING
    return len(track) >= most or (len(track) >= fewest and float(np.median(track.unheld_m[-10:])) < HELD_M)
