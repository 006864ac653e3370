"""Which panels stand where, and what the data sheet promises: the YAML that `swath verify-sensor --panels` reads."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from flightlog import config
from flightlog.config import option
from flightlog.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Panel:
    """A flat panel that faces the sensor; where it stands to a few decimetres.

    Attributes
    ----------
    reflectance : float
        Diffuse, at the laser's wavelength and normal incidence.
    azimuth_deg, distance_m, up_m : float
        Of its middle in the sensor's frame: clockwise from straight ahead, in plan, and above the sensor.
    size_m : (float, float)
        Width and height.
    name : str
    surveyed : bool
        Whether the distance is measured well enough to judge the sensor's by it.
    """

    reflectance: float = option(0.5, "diffuse, 0 to 1", minimum=0.001, maximum=1)
    azimuth_deg: float = option(0.0, "clockwise from straight ahead [deg]", minimum=-360, maximum=360)
    distance_m: float = option(10.0, "in plan, to its middle [m]", minimum=0.5, maximum=200)
    up_m: float = option(0.0, "middle above the sensor [m]", minimum=-100, maximum=100)
    size_m: tuple[float, float] = option((1.0, 1.0), "width and height [m]", minimum=0.1, maximum=20)
    name: str = option("", "of the panel; empty: reflectance and distance")
    surveyed: bool = option(False, "the distance is known to a centimetre, and the sensor's is judged by it")

    @property
    def title(self) -> str:
        """For people."""
        return self.name or f"{self.reflectance:.1%} at {self.distance_m:g} m"

    @property
    def middle_m(self) -> npt.NDArray[np.float64]:
        """In the sensor's frame, shape (3,)."""
        azimuth = np.deg2rad(self.azimuth_deg)
        return np.array([self.distance_m * np.sin(azimuth), self.distance_m * np.cos(azimuth), self.up_m])


@dataclass(frozen=True, slots=True)
class Sheet:
    """What is promised. The defaults are the HDL-32E's manual (63-9113: 2 cm, one sigma, at 25 m) and the source's findings.

    Attributes
    ----------
    range_sigma_m, to_m : float
    range_off_m : float
    intensity_share : float
    detected, seen_from, seen_to_m : float
    """

    range_sigma_m: float = option(0.02, "scatter of a range, one sigma [m] ...", minimum=0.001, maximum=1)
    to_m: float = option(25.0, "... up to this distance [m]", minimum=1, maximum=200)
    range_off_m: float = option(
        0.02, "a laser's mean off the others', or off a surveyed distance [m]", minimum=0, maximum=1
    )
    intensity_share: float = option(
        0.3, "mean intensity off the panel's reflectance, as a share of it", minimum=0.01, maximum=10
    )
    detected: float = option(0.95, "share of shots with an echo ...", minimum=0, maximum=1)
    seen_from: float = option(0.2, "... of panels of this reflectance and more ...", minimum=0, maximum=1)
    seen_to_m: float = option(50.0, "... up to this distance [m]", minimum=1, maximum=200)


@dataclass(frozen=True, slots=True)
class Panels:
    """The whole file."""

    panels: tuple[Panel, ...] = option((), "all panels")
    sheet: Sheet = option(Sheet, "what the data sheet promises")


def read_panels(path: Path) -> Panels:
    """Read the file.

    Raises
    ------
    ConfigError
        It is no such file, names no panel, or two of one name.
    """
    found = config.load(path, Panels)
    if not found.panels:
        raise ConfigError(
            f"{path}: no panels found, expected such as panels: [{{reflectance: 0.303, azimuth_deg: 12, distance_m: 10}}]"
        )
    titles = [each.title for each in found.panels]
    for title in titles:
        if titles.count(title) > 1:
            raise ConfigError(f"{path}: two panels are called {title!r}; give them names of their own with name:")
    return found
