"""What the intensity of a file is, and the linear strength of an echo that it tells."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.stats import spearmanr

from flightlog.errors import CaptureError, UsageError
from groundproc.cloud.reader import Cloud, opened

Array = npt.NDArray[np.float64]

COMPENSATED: Final = "compensated"
AMPLITUDE: Final = "amplitude"
AMPLITUDE_DB: Final = "amplitude-db"
DECIBEL: Final = "decibel"
KINDS: Final = {
    COMPENSATED: "percent of a white surface, made independent of the range by the sensor (Velodyne)",
    AMPLITUDE: "linear amplitude",
    AMPLITUDE_DB: "amplitude in dB",
    DECIBEL: "reflectance in dB against a white surface that faces the beam at the same range (RIEGL)",
}
RETRO: Final = 101
"""First count of a retro-reflector in compensated intensities (HDL-32E manual)."""
NOMINAL: Final = 0.01
"""c_cal of compensated intensities by the manual: counts are percent."""
_POWERS: Final = 11
"""Laser powers of firmware 1 (HDL-32E Software Version 2.0 Description, 2012)."""
_FEWEST: Final = 1000
_RISES: Final = 0.4
"""Rank correlation with the range from which counts rise with it: those of a diffuse surface stay, or fall as incidence grows."""
_PILED: Final = 20
_PILE_RATIO: Final = 10.0
_LONGEST_DB: Final = 150.0
"""No sensor has such a dynamic range: larger numbers are hundredths of a decibel."""


@dataclass(frozen=True, slots=True)
class Signal:
    """Where the strength of echoes stands in files, and how it is to be read.

    Attributes
    ----------
    kind : str
        Of `KINDS`.
    field : str
        Of the file.
    unit_db : float
        Decibels of one step, for kinds in dB.
    why : str
        How the kind was recognised.
    """

    kind: str
    field: str
    unit_db: float
    why: str

    @property
    def by_range(self) -> bool:
        """Whether the strength falls with the square of the range."""
        return self.kind in (AMPLITUDE, AMPLITUDE_DB)

    def raw(self, record: Any) -> Array:
        """As stored, in the file's unit, shape (n,)."""
        return np.asarray(record[self.field], np.float64)

    def linear(self, raw: Array) -> Array:
        """Linear strength, shape (n,)."""
        return np.asarray(10.0 ** (raw * self.unit_db / 10.0)) if self.kind in (AMPLITUDE_DB, DECIBEL) else raw


def recognise(cloud: Cloud, asked: str | None, largest: int) -> Signal:
    """What the strengths of a cloud are.

    Parameters
    ----------
    cloud : Cloud
    asked : str or None
        What the user says it is.
    largest : int
        Largest intensity of all clouds.

    Raises
    ------
    CaptureError
        There is none.
    """
    with opened(cloud.path) as reader:
        extra = {
            each.name.lower(): (each.name, "db" in each.description.lower())
            for each in reader.header.point_format.extra_dimensions
        }
        system = f"{reader.header.system_identifier} {reader.header.generating_software}".lower()
    if asked in (None, DECIBEL) and extra.get("reflectance", ("", False))[1]:
        return Signal(DECIBEL, extra["reflectance"][0], 1.0, "extra bytes reflectance in dB")
    if asked in (None, AMPLITUDE_DB) and "amplitude" in extra and (asked or extra["amplitude"][1]):
        return Signal(AMPLITUDE_DB, extra["amplitude"][0], 1.0, "extra bytes amplitude in dB")
    if "intensity" not in cloud.columns or largest == 0:
        raise CaptureError(f"{cloud.path}: its points have no intensity, expected the strength of each echo")
    if asked is not None:
        unit = 0.01 if largest > _LONGEST_DB else 1.0
        return Signal(asked, "intensity", unit, "as asked for")
    velodyne = any(word in system for word in ("velodyne", "hdl-32", "vlp-16"))
    if largest <= 255 and (velodyne or "laser" in cloud.columns):
        return Signal(COMPENSATED, "intensity", 1.0, "intensities up to 255 of a multi-laser sensor")
    return Signal(AMPLITUDE, "intensity", 1.0, "plain intensities, of no sensor known to compensate for the range")


def check_kind(kind: str | None) -> None:
    """See that a kind is known.

    Raises
    ------
    UsageError
    """
    if kind is not None and kind not in KINDS:
        raise UsageError(f"--intensity {kind}: expected {', '.join(KINDS)}")


def saturation(counts: npt.NDArray[np.int64]) -> int:
    """The intensity from which echoes are saturated, of a histogram over whole numbers; one beyond the last where none are.

    A sensor that is saturated says its largest number again and again: far more often than the numbers just below.
    """
    used = np.flatnonzero(counts)
    if not len(used):
        return len(counts)
    top = int(used[-1])
    if top < 200:
        return top + 1
    below = counts[max(top - max(top // 20, 10), 0) : top]
    piled = counts[top] >= _PILED and counts[top] > _PILE_RATIO * max(float(below.max(initial=0)), 1.0)
    full = top == 65_535
    return top if piled or full else top + 1


def is_power_index(intensity: Array, range_m: Array, counts: npt.NDArray[np.int64]) -> bool:
    """Whether compensated intensities are the laser powers of firmware 1: few values, which rise with the range.

    A sensor of that firmware sends the power that it chose, more of it the weaker the echo was. Such numbers can be turned
    into no reflectance.

    Parameters
    ----------
    intensity, range_m : ndarray, shape (n,)
        Of a sample.
    counts : ndarray of int64
        How often each intensity is among all points.
    """
    used = np.flatnonzero(counts > 1e-4 * counts.sum())
    if len(intensity) < _FEWEST or len(used) > _POWERS or len(used) < 3:
        return False
    if np.ptp(range_m) == 0.0:
        return False
    return float(spearmanr(intensity, range_m).statistic) > _RISES
