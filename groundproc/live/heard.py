"""What the autopilot states while the flight goes on: positions, attitudes and poses on the lidar's clock, some of them late."""

from collections import deque
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import LogError
from flightlog.mount import Mount
from groundproc.estimation import ins, ownsolution
from groundproc.estimation.odometry.stated import Fix
from groundproc.flight.autopilot import Boot
from groundproc.geodesy import LocalFrame
from groundproc.live.clocks import Tie
from groundproc.live.telemetry import Telemetry
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

LEAST_POSITION_SIGMA_M: Final = 0.02
_NEVER: Final = -(1 << 62)
_MOST: Final = 500
"""Positions that wait for the lidar; there are more only before the odometry begins."""


class Heard:
    """The autopilot as the odometry asks for it: a `Stated`, and poses to begin from.

    Parameters
    ----------
    telemetry : Telemetry
    mount : Mount
    height : str
        What the heights of positions refer to, as in a survey.
    frame : LocalFrame or None
        Else the first position gives it.

    Attributes
    ----------
    tie : Tie or None
        The clocks' tie as known.
    frame : LocalFrame or None
    """

    def __init__(self, telemetry: Telemetry, mount: Mount, height: str, frame: LocalFrame | None) -> None:
        self.tie: Tie | None = None
        self.frame = frame
        self._telemetry, self._mount, self._height = telemetry, mount, height
        antenna = np.zeros(3) if mount.gps_position_m is None else np.array(mount.gps_position_m)
        self._lever = mount.mat_ins_lidar().T @ (antenna - mount.lidar_position_m())
        self._waiting: deque[Fix] = deque(maxlen=_MOST)
        self._last_fix_boot_ns = _NEVER
        self._attitudes: tuple[Times, Array] = (np.empty(0, np.int64), np.empty((0, 4)))
        self._last_attitude_ns = _NEVER

    def listen(self, boot: Boot, tie: Tie) -> None:
        """Take what is new in the autopilot's last seconds."""
        if ownsolution.attitude_source(boot) is not None:
            _, boot_ns, quat, _ = ownsolution.attitudes(boot)
            self._attitudes = tie.lidar_ns(boot_ns), quat
        try:
            fixes = ownsolution.position_fixes(boot, self._height)
        except LogError:
            return
        new = fixes.time_ns > self._last_fix_boot_ns
        if self.frame is None or not new.any():
            return
        self._last_fix_boot_ns = int(fixes.time_ns[-1])
        place = self.frame.from_geodetic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)
        sigma = np.maximum(fixes.sigma_m, LEAST_POSITION_SIGMA_M)
        times = tie.lidar_ns(fixes.time_ns)
        rate_hz = 1e9 / max(float(np.median(np.diff(fixes.time_ns))), 1e7)
        self._waiting.extend(Fix(int(times[i]), place[i], sigma[i], rate_hz) for i in np.flatnonzero(new).tolist())

    def forget(self) -> None:
        """The autopilot's clock has begun anew."""
        self._last_fix_boot_ns = _NEVER
        self._attitudes = np.empty(0, np.int64), np.empty((0, 4))

    # As a Stated ----------------------------------------------------------------------------------------------------

    @property
    def lever_m(self) -> Array:
        """From the sensor to the GNSS antenna, sensor frame, shape (3,)."""
        return self._lever

    def fixes(self, now_ns: int) -> list[Fix]:
        """Positions of times up to now [lidar time] that were not given before."""
        found = [fix for fix in self._waiting if fix.time_ns <= now_ns]
        if found:
            self._waiting = deque((fix for fix in self._waiting if fix.time_ns > now_ns), maxlen=_MOST)
        return found

    def attitude(self, now_ns: int) -> tuple[int, Array] | None:
        """The newest attitude up to now [lidar time], where it is another than the last given."""
        times, quats = self._attitudes
        i = int(np.searchsorted(times, now_ns, side="right")) - 1
        if i < 0 or times[i] <= self._last_attitude_ns:
            return None
        self._last_attitude_ns = int(times[i])
        return self._last_attitude_ns, quats[i]

    # To begin from --------------------------------------------------------------------------------------------------

    def poses(self, seconds: float) -> Trajectory | None:
        """The autopilot's own trajectory over its last seconds, on lidar time; None where it cannot be made yet."""
        boot, tie = self._telemetry.boot(seconds), self.tie
        if boot is None or tie is None:
            return None
        try:
            fixes = ownsolution.position_fixes(boot, self._height)
            if self.frame is None:
                self.frame = LocalFrame(
                    float(fixes.latitude_deg[0]), float(fixes.longitude_deg[0]), float(fixes.height_m[0])
                )
            return ins.ins_trajectory(boot, fixes, self.frame, tie.lidar_ns, self._mount)
        except LogError:
            return None
