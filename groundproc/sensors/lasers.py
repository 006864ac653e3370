"""lasers.yaml: corrections of the lasers of one sensor, to be added to the manual's table.

A calibration measures these offsets on the flights it is given; they belong to the sensor and stay with it when the mount changes.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from flightlog import config
from flightlog.config import option
from flightlog.errors import ConfigError
from groundproc.files import written_aside
from groundproc.sensors.shots import LaserTable

ESTIMATE: Final = "estimate"
"""In place of a file: the flight itself is to tell."""


@dataclass(frozen=True, slots=True)
class LaserCorrections:
    """What is to be added to the manual's table, in firing order: a number for each laser, or none at all for no correction."""

    range_m: tuple[float, ...] = option((), "to the range of each laser [m]", minimum=-0.5, maximum=0.5)
    elevation_deg: tuple[float, ...] = option((), "to the elevation of each laser [deg]", minimum=-1, maximum=1)
    sigma_range_m: tuple[float, ...] = option((), "one sigma of that [m]; 0: left as it was", minimum=0)
    sigma_elevation_deg: tuple[float, ...] = option((), "one sigma of that [deg]; 0: left as it was", minimum=0)

    def table(self, nominal: LaserTable, place: str = "lasers") -> LaserTable:
        """The manual's table with the corrections.

        Raises
        ------
        ConfigError
            The corrections are of a sensor with another number of lasers.
        """
        many = len(nominal)
        for name in ("range_m", "elevation_deg", "sigma_range_m", "sigma_elevation_deg"):
            given = len(getattr(self, name))
            if given not in (0, many):
                raise ConfigError(f"{place}: {name} has {given} numbers, expected {many}: one for each laser")
        elevation = np.deg2rad(np.array(self.elevation_deg or (0.0,) * many))
        range_m = np.array(self.range_m or (0.0,) * many)
        return replace(
            nominal,
            elevation_rad=nominal.elevation_rad + elevation,
            range_offset_m=nominal.range_offset_m + range_m,
        )


def write_lasers(path: Path, corrections: LaserCorrections, head: str = "") -> None:
    """Write lasers.yaml; `head` stands above the values."""
    with written_aside(path) as aside:
        aside.write_text(head + config.dump(corrections), encoding="utf-8")


def read_lasers(path: Path) -> LaserCorrections:
    """Read lasers.yaml; ConfigError where it is not one."""
    return config.load(path, LaserCorrections)
