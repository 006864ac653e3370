"""lasers.yaml: corrections of the 32 lasers of one sensor, to be added to the manual's table.

A calibration measures these offsets on the flights it is given; they belong to the sensor and stay with it when the mount changes.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from flightlog import config
from flightlog.config import option
from flightlog.hdl32e import ELEVATION_DEG, LASERS
from groundproc.files import written_aside
from groundproc.sensors.hdl32e import LaserTable

ESTIMATE: Final = "estimate"
"""In place of a file: the flight itself is to tell."""
NONE: Final = (0.0,) * LASERS


@dataclass(frozen=True, slots=True)
class LaserCorrections:
    """What is to be added to the manual's table, in firing order."""

    range_m: tuple[float, ...] = option(NONE, "to the range of each laser [m]", minimum=-0.5, maximum=0.5)
    elevation_deg: tuple[float, ...] = option(NONE, "to the elevation of each laser [deg]", minimum=-1, maximum=1)
    sigma_range_m: tuple[float, ...] = option(NONE, "one sigma of that [m]; 0: left as it was", minimum=0)
    sigma_elevation_deg: tuple[float, ...] = option(NONE, "one sigma of that [deg]; 0: left as it was", minimum=0)

    def __post_init__(self) -> None:
        for name in ("range_m", "elevation_deg", "sigma_range_m", "sigma_elevation_deg"):
            if len(getattr(self, name)) != LASERS:
                raise ValueError(
                    f"{name} has {len(getattr(self, name))} numbers, expected {LASERS}: one for each laser"
                )

    def table(self) -> LaserTable:
        """The manual's table with the corrections."""
        return LaserTable(np.deg2rad(np.array(ELEVATION_DEG) + self.elevation_deg), np.array(self.range_m))


def write_lasers(path: Path, corrections: LaserCorrections, head: str = "") -> None:
    """Write lasers.yaml; `head` stands above the values."""
    with written_aside(path) as aside:
        aside.write_text(head + config.dump(corrections), encoding="utf-8")


def read_lasers(path: Path) -> LaserCorrections:
    """Read lasers.yaml; ConfigError where it is not one."""
    return config.load(path, LaserCorrections)
