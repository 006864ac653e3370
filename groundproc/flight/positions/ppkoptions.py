"""What RTKLIB is told, and where the base station stands."""

from dataclasses import dataclass
from typing import Final

from flightlog.config import option
from flightlog.errors import SwathError, UsageError

_SYSTEMS: Final = {"G": 1, "S": 2, "R": 4, "E": 8, "J": 16, "C": 32}
_FREQUENCIES: Final = {1: "l1", 2: "l1+l2", 3: "l1+l2+l5"}


class PpkError(SwathError):
    """Observations from which no solution can be made."""


@dataclass(frozen=True, slots=True)
class PpkOptions:
    """What RTKLIB is told; the defaults are for a single-frequency u-blox receiver on a multirotor, some kilometres from its base."""

    frequencies: int = option(1, "1: L1; 2: L1 and L2; 3: L5 as well", minimum=1, maximum=3)
    systems: str = option("GREJC", "GPS, R GLONASS, E Galileo, J QZSS, C BeiDou, S SBAS")
    direction: str = option(
        "combined", "in which the filter runs over the flight", choices=("combined", "forward", "backward")
    )
    ambiguities: str = option(
        "continuous", "how they are resolved", choices=("continuous", "fix-and-hold", "instantaneous", "off")
    )
    ratio: float = option(
        3.0, "a fix must be this much better than the second best ambiguities", minimum=1.0, maximum=100.0
    )
    shortest_fix_s: float = option(
        10.0, "a fix that only one direction finds must last this long [s]", minimum=0.0, maximum=3600.0
    )
    elevation_mask_deg: float = option(15.0, "satellites below are not used [deg]", minimum=0.0, maximum=60.0)
    phase_sigma_m: float = option(
        0.003,
        "carrier phase: its variance is the square of this times 1 + 1/sin(elevation)^2 [m]",
        minimum=0.0005,
        maximum=0.1,
    )
    code_to_phase: float = option(300.0, "sigma of the code over that of the phase", minimum=10.0, maximum=10_000.0)
    longest_age_s: float = option(30.0, "oldest observation of the base that is used [s]", minimum=0.1, maximum=300.0)

    def __post_init__(self) -> None:
        if not self.systems or set(self.systems) - set(_SYSTEMS):
            raise ValueError(f"systems: {self.systems!r} found, expected letters of {''.join(_SYSTEMS)}")

    def lines(self, base: "Base") -> list[str]:
        """RTKLIB's configuration, without the direction.

        Dynamics are off: RTKLIB's model of constant acceleration between epochs biased fixes by centimetres to decimetres on a
        circling rover, with sigmas of millimetres.
        """
        settings = {
            "pos1-posmode": "kinematic",
            "pos1-frequency": _FREQUENCIES[self.frequencies],
            "pos1-elmask": f"{self.elevation_mask_deg:g}",
            "pos1-dynamics": "off",
            "pos1-tidecorr": "off",
            "pos1-ionoopt": "brdc",
            "pos1-tropopt": "saas",
            "pos1-sateph": "brdc",
            "pos1-posopt5": "on",
            "pos1-navsys": str(sum(_SYSTEMS[letter] for letter in set(self.systems))),
            "pos2-armode": self.ambiguities,
            "pos2-gloarmode": "off",
            "pos2-bdsarmode": "on",
            "pos2-arthres": f"{self.ratio:g}",
            "pos2-maxage": f"{self.longest_age_s:g}",
            "stats-eratio1": f"{self.code_to_phase:g}",
            "stats-eratio2": f"{self.code_to_phase:g}",
            "stats-errphase": f"{self.phase_sigma_m:g}",
            "stats-errphaseel": f"{self.phase_sigma_m:g}",
            "out-solformat": "llh",
            "out-outhead": "on",
            "out-outopt": "on",
            "out-outvel": "on",
            "out-outsingle": "on",
            "out-timesys": "gpst",
            "out-timeform": "hms",
            "out-timendec": "6",
            "out-degform": "deg",
            "out-height": "ellipsoidal",
        } | base.settings()
        return [f"{name:<18}={value}" for name, value in settings.items()]


@dataclass(frozen=True, slots=True)
class Base:
    """Where the base station's antenna is.

    Attributes
    ----------
    position : tuple of float, or None
        Latitude, longitude [deg], ellipsoidal height [m].
    averaged : bool
        Without a position: the mean of its own code positions, instead of what its RINEX header says.
    """

    position: tuple[float, float, float] | None = None
    averaged: bool = False

    def settings(self) -> dict[str, str]:
        """RTKLIB's options for it."""
        if self.position is not None:
            values = dict(zip(("ant2-pos1", "ant2-pos2", "ant2-pos3"), map(repr, self.position), strict=True))
            return {"ant2-postype": "llh"} | values
        return {"ant2-postype": "single" if self.averaged else "rinexhead"}

    def source(self) -> str:
        """Who says so."""
        if self.position is not None:
            return "given"
        return "average of its own code positions (metres)" if self.averaged else "header of its RINEX file"


def base_position(text: str) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and ellipsoidal height [m] of a text such as 58.39,15.62,80.5.

    Raises
    ------
    UsageError
        It is none.
    """
    try:
        latitude, longitude, height = (float(word) for word in text.split(","))
    except ValueError:
        latitude = longitude = height = float("nan")
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and -1000 <= height <= 9000):
        raise UsageError(
            f"--base-position {text!r}: expected latitude, longitude in degrees and ellipsoidal height in metres: 58.39,15.62,80.5"
        )
    return latitude, longitude, height
