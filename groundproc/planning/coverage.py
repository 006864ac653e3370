"""What one line of a level flight over level ground leaves behind: points a square metre, across the line.

Every laser fires at its rate, evenly in azimuth. A beam meets the ground where its direction says; its rate over the width of a strip of
ground and the speed of the aircraft is the density there.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import UsageError
from flightlog.mount import Mount
from groundproc.sensors.model import Lidar
from groundproc.sensors.shots import Gate

Array = npt.NDArray[np.float64]

_BIN_M: Final = 0.25
_AZIMUTHS: Final = 7200


@dataclass(frozen=True, slots=True)
class Swath:
    """One line.

    Attributes
    ----------
    across_m : ndarray, shape (n,)
        Middles of strips of ground, right positive.
    density : ndarray, shape (n,)
        Points a square metre.
    """

    across_m: Array
    density: Array

    def of_lines(self, spacing_m: float) -> Array:
        """Density between parallel lines so far apart, over one spacing, all lines that reach there together."""
        steps = max(1, round(spacing_m / _BIN_M))
        place = np.round(self.across_m / _BIN_M - 0.5).astype(int) % steps
        return np.asarray(np.bincount(place, self.density, steps), np.float64)

    def width_m(self) -> float:
        """Of the strip that holds 95 % of the points."""
        order = np.argsort(np.abs(self.across_m))
        share = np.cumsum(self.density[order]) / self.density.sum()
        return 2.0 * float(np.abs(self.across_m[order])[np.searchsorted(share, 0.95)])


def swath(lidar: Lidar, mount: Mount, gate: Gate, height_m: float, speed_m_s: float) -> Swath:
    """The strip of ground of one line.

    Parameters
    ----------
    lidar : Lidar
    mount : Mount
    gate : Gate
        Field of view and ranges that are kept.
    height_m : float
        Of the sensor above the ground.
    speed_m_s : float

    Raises
    ------
    UsageError
        No beam meets the ground within the range gate.
    """
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * (2.0 * np.pi / _AZIMUTHS)
    start, width = np.deg2rad(gate.window_deg())
    azimuth = azimuth[(azimuth - start) % (2.0 * np.pi) <= width]
    elevation = lidar.lasers.elevation_rad[:, None]
    beams = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation) + 0.0 * azimuth],
        axis=-1,
    )
    beams = beams.reshape(-1, 3) @ mount.mat_ins_lidar().T
    with np.errstate(divide="ignore"):
        range_m = np.where(beams[:, 2] < 0.0, -height_m / beams[:, 2], np.inf)
    met = (range_m >= gate.min_range_m) & (range_m <= gate.max_range_m)
    if not met.any():
        raise UsageError(
            f"from {height_m:g} m no beam meets the ground within {gate.min_range_m:g} to {gate.max_range_m:g} m; fly lower"
        )
    across = beams[met, 0] * range_m[met]
    rate = 1e9 / lidar.firing_ns / _AZIMUTHS
    reach = int(np.ceil(np.abs(across).max() / _BIN_M))
    place = np.floor(across / _BIN_M).astype(int) + reach
    count = np.bincount(place, minlength=2 * reach) * rate
    middle = np.asarray((np.arange(2 * reach) - reach + 0.5) * _BIN_M, np.float64)
    return Swath(middle, np.asarray(count[: 2 * reach] / (_BIN_M * speed_m_s), np.float64))


def spacing_for(swath: Swath, density: float) -> float:
    """The widest spacing of lines that leaves nowhere fewer points than asked for.

    Raises
    ------
    UsageError
        Not even lines side by side are enough.
    """
    widest = float(np.abs(swath.across_m).max()) * 2.0
    good = [s for s in np.arange(1.0, widest, 0.5) if swath.of_lines(float(s)).min() >= density]
    if not good:
        most = swath.of_lines(1.0).min()
        raise UsageError(
            f"--density {density:g}: lines 1 m apart give {most:.0f} points a square metre; fly slower or lower"
        )
    return float(max(good))
