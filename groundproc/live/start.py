"""Where the odometry begins in flight: the autopilot's poses carried on over the delay of its link, and the offset of the lidar's gyros."""

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.odometry.grid import STEP_NS
from groundproc.estimation.odometry.motion import MotionGrid
from groundproc.estimation.odometry.spline import integrated
from groundproc.flight.autopilot import Boot
from groundproc.live.clocks import Tie
from groundproc.live.motion import Samples
from groundproc.trajectory.trajectory import Poses, Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

LONGEST_LINK_DELAY_NS: Final = 3_000_000_000
_LARGEST_GAP_S: Final = 0.5


class CarriedPoses:
    """The autopilot's poses up to what has been heard, and beyond that carried on by the gyros and the last velocity.

    Parameters
    ----------
    known : Trajectory
        On lidar time.
    newest : callable
        Gives what is known by now, or None; it is asked whenever poses are.
    motion : MotionGrid
    gyro_bias : callable
        Gives the bias as known by now [rad/s], shape (3,).
    mat_ins_lidar : ndarray, shape (3, 3)
    """

    def __init__(
        self, known: Trajectory, newest: Callable[[], Trajectory | None], motion: MotionGrid,
        gyro_bias: Callable[[], Array], mat_ins_lidar: Array,
    ) -> None:  # fmt: skip
        self._known, self._newest, self._motion = known, newest, motion
        self._bias, self._mat = gyro_bias, mat_ins_lidar

    def where_covered(self, time_ns: Times) -> tuple[Poses, npt.NDArray[np.bool_]]:
        """Poses at times, shape (n,), and which of them are covered."""
        newest = self._newest()
        self._known = self._known if newest is None else newest
        poses, covered = self._known.where_covered(time_ns)
        for i in np.flatnonzero(~covered & (time_ns >= self._known.time_ns[-1])).tolist():
            covered[i] = self._carry_on(int(time_ns[i]), poses, i)
        return poses, covered

    def _carry_on(self, time_ns: int, poses: Poses, row: int) -> bool:
        last_ns, motion = int(self._known.time_ns[-1]), self._motion
        since_ns = time_ns - last_ns
        first, last = (last_ns - motion.start_ns) // STEP_NS, (time_ns - motion.start_ns) // STEP_NS
        if since_ns > LONGEST_LINK_DELAY_NS or first < 0 or last > len(motion):
            return False
        rate = (motion.rate_rad_s[first:last] - self._bias()) @ self._mat.T
        quat = integrated(np.ascontiguousarray(rate), self._known.quat_local_ins_wxyz[-1])
        poses.quat_local_ins_wxyz[row] = quat[-1]
        poses.position_m[row] = self._known.position_m[-1] + since_ns * 1e-9 * self._known.velocity_m_s[-1]
        return True


def gyro_offset(own: Samples, boot: Boot, tie: Tie, mat_ins_lidar: Array) -> Array | None:
    """Mean difference of the lidar's gyro from the autopilot's [rad/s], shape (3,); None where they have too little in common."""
    time, rate, _ = own.all()
    tracks = boot.gyros()
    if len(time) < 100 or not tracks:
        return None
    track = max(tracks, key=lambda track: len(track.time_ns))
    at = tie.lidar_ns(track.time_ns)
    place = np.searchsorted(at, time)
    inside = (place > 0) & (place < len(at))
    place = np.clip(place, 1, len(at) - 1)
    inside &= (at[place] - at[place - 1]) * 1e-9 < _LARGEST_GAP_S
    if inside.sum() < 200:
        return None
    other = np.stack([np.interp(time[inside], at, axis) for axis in (track.rate_rad_s @ mat_ins_lidar).T], axis=1)
    return np.asarray((rate[inside] - other).mean(axis=0))
