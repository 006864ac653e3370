"""A solution: positions that another program found, each with what it says of its own quality."""

import dataclasses
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import utc_text
from flightlog.errors import LogError
from groundproc.flight.positions.scales import in_era, stray

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]


class Quality(IntEnum):
    """How a position was found; the numbers are RTKLIB's up to 7."""

    NONE = 0
    FIX = 1
    """Carrier phase with whole-numbered ambiguities: centimetres."""
    FLOAT = 2
    """Carrier phase with real-valued ambiguities: decimetres."""
    SBAS = 3
    DGPS = 4
    SINGLE = 5
    """Code alone, no corrections: metres."""
    PPP = 6
    DEAD_RECKONING = 7
    INERTIAL = 8
    """Blended with an IMU, or a pose of images: its covariance says all."""


ANTENNA: Final = "antenna"
"""A point of the airframe that the user must name."""
INS: Final = "ins"
"""The origin of the ins frame."""
ELLIPSOID: Final = "ellipsoid"
MSL: Final = "msl"
_HIGHEST_M: Final = 20_000.0
_LOWEST_M: Final = -1_000.0
"""A receiver that found itself outside of these found nothing."""


@dataclass(frozen=True, slots=True)
class Solution:
    """Positions of one file in time order; attitudes and velocities where it has them.

    Attributes
    ----------
    source : str
        Name of the file.
    format : str
        What it was recognised as.
    point : str
        What the positions are of: "antenna", or "ins", the origin of the ins frame.
    height_reference : str
        "ellipsoid" or "msl".
    sigma_source : str
        Who states the covariances.
    time_ns : ndarray of int64, shape (n,)
        UTC, strictly increasing.
    latitude_deg, longitude_deg, height_m : ndarray, shape (n,)
        WGS 84, or the datum of the base station.
    covariance_m2 : ndarray, shape (n, 3, 3)
        Of east, north, up; not a number where nobody states it.
    quality : ndarray of uint8, shape (n,)
        Values of `Quality`.
    undulation_m : ndarray, shape (n,), or None
        Geoid above ellipsoid, where the file states it.
    velocity_m_s : ndarray, shape (n, 3), or None
        East, north, up; not a number where it is not stated.
    velocity_covariance_m2_s2 : ndarray, shape (n, 3, 3), or None
    quat_place_ins_wxyz : ndarray, shape (n, 4), or None
        Attitude: "east, north, up at the place" from ins.
    attitude_covariance_rad2 : ndarray, shape (n, 3, 3), or None
        Of roll, pitch, heading.
    cross_covariance_m_rad : ndarray, shape (n, 3, 3), or None
        Of east, north, up (rows) with roll, pitch, heading (columns); not a number where nobody states it.
    satellites, age_s, ratio : ndarray, shape (n,), or None
        Satellites used, age of the base's observations [s], and how much better the best ambiguities are than the second best.
    base_ecef_m : tuple of float, or None
        The base station that the file names.
    left_out : dict
        Rows that were not taken, by reason.
    notes : tuple of str
        Sentences on what the reader had to decide.
    """

    source: str
    format: str
    point: str
    height_reference: str
    sigma_source: str
    time_ns: Times
    latitude_deg: Array
    longitude_deg: Array
    height_m: Array
    covariance_m2: Array
    quality: npt.NDArray[np.uint8]
    undulation_m: Array | None = None
    velocity_m_s: Array | None = None
    velocity_covariance_m2_s2: Array | None = None
    quat_place_ins_wxyz: Array | None = None
    attitude_covariance_rad2: Array | None = None
    cross_covariance_m_rad: Array | None = None
    satellites: Array | None = None
    age_s: Array | None = None
    ratio: Array | None = None
    base_ecef_m: tuple[float, float, float] | None = None
    left_out: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def sigma_m(self) -> Array:
        """Standard deviations east, north, up [m], shape (n, 3)."""
        return np.asarray(np.sqrt(np.einsum("nii->ni", self.covariance_m2)))

    def rows(self, chosen: Any) -> "Solution":
        """The rows of a slice, a mask or an index."""
        named = {name: getattr(self, name) for name in _PER_ROW}
        return dataclasses.replace(self, **{name: value[chosen] for name, value in named.items() if value is not None})

    def shares(self) -> dict[str, float]:
        """Share of each quality among the positions, in the order of `Quality`; those that do not occur are left out."""
        count = np.bincount(self.quality, minlength=len(Quality))
        return {kind.name.lower(): float(count[kind]) / len(self) for kind in Quality if count[kind]}

    def summary(self) -> dict[str, Any]:
        """Plain figures for a report."""
        sigma = self.sigma_m
        stated = np.isfinite(sigma).all(axis=1)
        return {
            "source": self.source,
            "format": self.format,
            "point": self.point,
            "height": self.height_reference,
            "sigma_source": self.sigma_source,
            "positions": len(self),
            "start": utc_text(int(self.time_ns[0])),
            "end": utc_text(int(self.time_ns[-1])),
            "quality": self.shares(),
            "median_sigma_m": [round(float(v), 4) for v in np.median(sigma[stated], axis=0)] if stated.any() else None,
            "left_out": dict(self.left_out),
            "notes": list(self.notes),
        }


_PER_ROW: Final = (
    "time_ns", "latitude_deg", "longitude_deg", "height_m", "covariance_m2", "quality", "undulation_m", "velocity_m_s",
    "velocity_covariance_m2_s2", "quat_place_ins_wxyz", "attitude_covariance_rad2", "cross_covariance_m_rad", "satellites", "age_s",
    "ratio",
)  # fmt: skip


def tidied(solution: Solution, place: str) -> Solution:
    """Rows that can be, in time order; what cannot be is counted.

    Left out are `without_fix` (quality 0), `impossible` (no number, no place on Earth, outside -1 to 20 km of height), `stray_time`
    (a few of another day than the rest) and `repeated` (a time that an earlier row has already).

    Raises
    ------
    LogError
        Nothing is left.
    """
    left_out = dict(solution.left_out)
    fixed = solution.quality != Quality.NONE
    with np.errstate(invalid="ignore"):
        possible = (
            (np.abs(solution.latitude_deg) <= 90.0)
            & (np.abs(solution.longitude_deg) <= 360.0)
            & (solution.height_m > _LOWEST_M)
            & (solution.height_m < _HIGHEST_M)
        )
    possible &= _within(solution)
    _count(left_out, "without_fix", int((~fixed).sum()))
    _count(left_out, "impossible", int((fixed & ~possible).sum()))
    kept = solution.rows(fixed & possible)
    apart = stray(kept.time_ns)
    _count(left_out, "stray_time", int(apart.sum()))
    kept = kept.rows(~apart)
    kept = kept.rows(np.argsort(kept.time_ns, kind="stable"))
    if len(kept):
        new = np.concatenate([[True], np.diff(kept.time_ns) > 0])
        _count(left_out, "repeated", int((~new).sum()))
        kept = kept.rows(new)
    if not len(kept):
        reasons = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in left_out.items()) or "it has no rows"
        raise LogError(f"{place}: holds no position ({reasons})")
    return dataclasses.replace(kept, left_out=left_out)


def dated(solution: Solution, near_utc_ns: int | None) -> Solution:
    """A solution without rollovers of the GPS week: dates that are whole eras of 1024 weeks from the flight's are mended, and that is said.

    Parameters
    ----------
    solution : Solution
    near_utc_ns : int, optional
        A time of the flight [ns]; without it nothing is changed.
    """
    if near_utc_ns is None:
        return solution
    time_ns, wrong = in_era(solution.time_ns, near_utc_ns)
    if not wrong:
        return solution
    stated = utc_text(int(solution.time_ns[0]))
    note = f"{wrong} of its dates are whole eras of 1024 GPS weeks off, from {stated} on; mended to {utc_text(int(time_ns[0]))}"
    order = np.argsort(time_ns, kind="stable")
    return dataclasses.replace(solution, time_ns=time_ns, notes=(*solution.notes, note)).rows(order)


_LARGEST: Final = {
    "covariance_m2": 1e12, "undulation_m": 200.0, "velocity_m_s": 1e4, "velocity_covariance_m2_s2": 1e8, "attitude_covariance_rad2": 1e6,
}  # fmt: skip
"""Magnitudes that cannot be exceeded by what a row says beside its place; not a number: it does not say."""


def _within(solution: Solution) -> npt.NDArray[np.bool_]:
    """Which rows say nothing that cannot be, shape (n,)."""
    good = np.ones(len(solution), np.bool_)
    for name, most in _LARGEST.items():
        values = getattr(solution, name)
        if values is not None:
            good &= (~(np.abs(values) > most)).reshape(len(good), -1).all(axis=1)
        if values is not None and values.ndim == 3:  # a variance below 0 is none
            good &= ~(np.einsum("nii->ni", values) < 0.0).any(axis=1)
    return good


def _count(left_out: dict[str, int], reason: str, number: int) -> None:
    if number:
        left_out[reason] = left_out.get(reason, 0) + number


def symmetric(diagonal: Array, xy: Array, yz: Array, zx: Array) -> Array:
    """Covariance matrices, shape (n, 3, 3), of variances (n, 3) and three covariances (n,) each."""
    found = np.zeros((len(diagonal), 3, 3))
    for i in range(3):
        found[:, i, i] = diagonal[:, i]
    for (i, j), value in (((0, 1), xy), ((1, 2), yz), ((2, 0), zx)):
        found[:, i, j] = found[:, j, i] = value
    return found


def diagonal_covariance(sigma: Array) -> Array:
    """Covariance matrices, shape (n, 3, 3), of standard deviations, shape (n, 3), without correlation."""
    zero = np.zeros(len(sigma))
    return symmetric(np.square(sigma), zero, zero, zero)
