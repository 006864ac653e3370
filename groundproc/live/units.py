"""The inertial units that are heard: the lidar's own and the autopilot's, and which of them carries the motion."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.estimation.odometry.motion import INS_FORCES, LEAST_BASE_HZ, ImuTrack
from groundproc.flight.autopilot import Boot
from groundproc.flight.sync import GyroTrack
from groundproc.live.clocks import Tie
from groundproc.live.motion import Samples
from groundproc.live.start import gyro_offset

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

LEAST_SAMPLES_NS: Final = 3 * NS_PER_S
"""Inertial data that must be there before the odometry begins: the gyro's offset comes from them."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """Who gives rates, who forces, and who fills gaps; the first two with what their newest samples are like."""

    rates: Samples
    forces: Samples
    spare: Samples | None
    rate_track: ImuTrack
    force_track: ImuTrack


class Units:
    """The last minute of both units, in the sensor frame on the lidar's clock.

    Parameters
    ----------
    mat_ins_lidar : ndarray, shape (3, 3)
    """

    def __init__(self, mat_ins_lidar: Array) -> None:
        self._mat, self._axes = mat_ins_lidar, np.eye(3)
        self._own, self._other = Samples("lidar"), Samples("autopilot")

    def take_own(self, time_ns: Times, rate_rad_s: Array, force_m_s2: Array) -> None:
        """Take samples of the lidar's own unit, shape (n,), (n, 3), (n, 3)."""
        self._own.add(time_ns, rate_rad_s @ self._axes.T, force_m_s2)

    def take_autopilots(self, boot: Boot, tie: Tie) -> None:
        """Take the autopilot's newest samples: of the fastest message, one with forces before a slightly faster one without."""
        tracks = [track for track in boot.gyros() if 0.0 < track.rate_hz < 1e3]
        if not tracks:
            return
        felt = {name for name, _ in INS_FORCES}
        best = max(tracks, key=lambda track: track.rate_hz * (2.0 if track.name in felt else 1.0))
        force = np.full_like(best.rate_rad_s, np.nan)
        for name, unit in INS_FORCES:
            if best.name == name:
                frd = np.stack([boot.tables[name][f].astype(np.float64) for f in ("xacc", "yacc", "zacc")], axis=1)
                force = frames.ins_from_frd(frd * unit)
        self._other.add(tie.lidar_ns(best.time_ns), best.rate_rad_s @ self._mat, force @ self._mat)

    def turn_axes(self, axes: Array) -> None:
        """The lidar's gyro axes are others than the manual's: what was taken with those is void."""
        self._axes = axes @ self._axes
        self._own = Samples("lidar")

    @property
    def own_last_ns(self) -> int | None:
        """Lidar time of the newest sample of the lidar's own unit."""
        return self._own.last_ns

    @property
    def needs_autopilot(self) -> bool:
        """Whether the motion between revolutions is the autopilot's, for want of the lidar's own unit."""
        return self._own.span_ns < LEAST_SAMPLES_NS

    def own_gyro(self) -> GyroTrack | None:
        """The lidar's gyro, for the synchronisation; None where it has not been heard."""
        if self._own.span_ns <= 0:
            return None
        time, rate, _ = self._own.all()
        return GyroTrack("the lidar", time, rate)

    def chosen(self) -> Chosen | None:
        """The units to make the motion of; None until there is enough of them."""
        own, other = self._own.track(), self._other.track()
        both = ((self._own, own), (self._other, other))
        rates = next(
            (
                (samples, track)
                for samples, track in both
                if track is not None and track.rate_hz >= LEAST_BASE_HZ and samples.span_ns >= LEAST_SAMPLES_NS
            ),
            None,
        )
        forces = next(
            ((samples, track) for samples, track in both if track is not None and np.isfinite(track.sigma_force_m_s2)),
            None,
        )
        if rates is None or forces is None:
            return None
        spare = self._other if rates[0] is self._own and other is not None else None
        return Chosen(rates[0], forces[0], spare, rates[1], forces[1])

    def bias(self, source: str, boot: Boot | None, tie: Tie | None) -> Array | None:
        """Where the bias of a unit's gyro begins [rad/s], shape (3,): its offset from the autopilot's; None where that is not known yet."""
        if source != self._own.name:
            return np.zeros(3)
        return None if boot is None or tie is None else gyro_offset(self._own, boot, tie, self._mat)

    def newest_ns(self, source: str) -> int:
        """Lidar time of the newest sample of a unit [ns]; 0 before the first."""
        return (self._own if source == self._own.name else self._other).last_ns or 0
