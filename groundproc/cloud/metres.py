"""Clouds in metres, whatever unit their CRS has: feet at the door become metres, and results go back into the unit of the CRS."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import GeodesyError
from groundproc.cloud.reader import Cloud

Array = npt.NDArray[np.float64]


class Stating(Protocol):
    """A file that may state a CRS."""

    @property
    def path(self) -> Path:
        """Where it is."""
        ...

    @property
    def horizontal(self) -> pyproj.CRS | None:
        """Horizontal part of what it states."""
        ...


@dataclass(frozen=True, slots=True)
class Raster:
    """A raster that may state one."""

    path: Path
    horizontal: pyproj.CRS | None


@dataclass(frozen=True, slots=True)
class Metres:
    """Metres in one unit of a CRS.

    Attributes
    ----------
    across, up : float
        Of its coordinates, and of its heights.
    name : str
        Of the unit of both, as the CRS has it.
    """

    across: float = 1.0
    up: float = 1.0
    name: str = "metre"

    @property
    def plain(self) -> bool:
        """The CRS is in metres."""
        return self.across == self.up == 1.0

    @property
    def height_word(self) -> str:
        """The unit of heights as names of columns and tables have it."""
        if self.up == 1.0:
            return "m"
        return "ft" if abs(self.up - 0.3048) < 1e-6 else f"{self.up:.9g}m"

    def of(self, xyz: Array) -> Array:
        """Coordinates of the CRS in metres, shape (n, 3) or (3,)."""
        return xyz if self.plain else xyz * (self.across, self.across, self.up)

    def back(self, xyz_m: Array) -> Array:
        """Metres in units of the CRS, shape (n, 3) or (3,)."""
        return xyz_m if self.plain else xyz_m / (self.across, self.across, self.up)

    def matrix(self, moving_m: Array) -> Array:
        """A matrix that moves metres as one that moves units of the CRS, shape (4, 4)."""
        unit = np.diag([self.across, self.across, self.up, 1.0])
        return moving_m if self.plain else np.asarray(np.linalg.solve(unit, moving_m @ unit), np.float64)


METRES = Metres()


def unstated(*files: Stating) -> list[str]:
    """What the user is told of files that state no CRS."""
    stated = next((each for each in files if each.horizontal is not None), None)
    if stated is None:
        why = "states no CRS: its coordinates are taken for metres, and what is made of it states none"
    else:
        why = f"states no CRS, and is taken to be in that of {stated.path}"
    return [f"{path} {why}" for path in dict.fromkeys(each.path for each in files if each.horizontal is None)]


def flat(path: Path, crs: pyproj.CRS | None) -> None:
    """Refuse coordinates that are no map's: angles, and those from the middle of the earth.

    Raises
    ------
    GeodesyError
    """
    if crs is None or not (crs.is_geographic or crs.is_geocentric):
        return
    why = "degrees" if crs.is_geographic else "metres from the middle of the earth"
    raise GeodesyError(
        f"{path}: is in {crs.name}, whose coordinates are {why}; expected a projected CRS, such as a UTM zone"
    )


def metres_in(crs: pyproj.CRS | None) -> Metres:
    """The unit of a CRS of maps, with its heights or without; of none it is the metre."""
    if crs is None:
        return METRES
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    across = float(parts[0].axis_info[0].unit_conversion_factor) if parts[0].axis_info else 1.0
    up = across
    if len(parts) > 1:
        up = float(parts[1].axis_info[0].unit_conversion_factor)
    elif len(crs.axis_info) > 2:
        up = float(crs.axis_info[2].unit_conversion_factor)
    name = str(parts[0].axis_info[0].unit_name) if parts[0].axis_info else "metre"
    return Metres(across, up, name if up == across else f"{name}, heights of {up:.9g} m")


def metres_of(cloud: Cloud) -> Metres:
    """The unit of a cloud; one that states no CRS is in metres.

    Raises
    ------
    GeodesyError
        Its coordinates are angles, or geocentric.
    """
    flat(cloud.path, cloud.horizontal)
    return metres_in(cloud.crs)


def agreed_metres(clouds: Sequence[Cloud]) -> Metres:
    """The unit of clouds of one CRS; those that state none are in that of the others.

    Raises
    ------
    GeodesyError
        Coordinates are angles, or geocentric.
    """
    units = [metres_of(cloud) for cloud in clouds if cloud.horizontal is not None]
    return units[0] if units else METRES
