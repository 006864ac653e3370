"""Clouds in metres, whatever unit their CRS has: feet at the door become metres, and results go back into the unit of the CRS."""

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

    def of(self, xyz: Array) -> Array:
        """Coordinates of the CRS in metres, shape (n, 3) or (3,)."""
        return xyz if self.plain else xyz * (self.across, self.across, self.up)

    def back(self, xyz_m: Array) -> Array:
        """Metres in units of the CRS, shape (n, 3) or (3,)."""
        return xyz_m if self.plain else xyz_m / (self.across, self.across, self.up)


METRES = Metres()


def unstated(*files: Stating) -> list[str]:
    """What the user is told of files that state no CRS."""
    stated = next((each for each in files if each.horizontal is not None), None)
    if stated is None:
        why = "states no CRS: its coordinates are taken for metres, and what is made of it states none"
    else:
        why = f"states no CRS, and is taken to be in that of {stated.path}"
    return [f"{path} {why}" for path in dict.fromkeys(each.path for each in files if each.horizontal is None)]


def metres_of(cloud: Cloud) -> Metres:
    """The unit of a cloud; one that states no CRS is in metres.

    Raises
    ------
    GeodesyError
        Its coordinates are angles.
    """
    crs = cloud.horizontal
    if crs is None:
        return Metres()
    if crs.is_geographic:
        raise GeodesyError(
            f"{cloud.path}: is in {crs.name}, whose coordinates are degrees; expected a projected CRS, such as a UTM zone"
        )
    across = float(crs.axis_info[0].unit_conversion_factor) if crs.axis_info else 1.0
    whole = cloud.crs
    up = across
    if whole is not None and whole.is_compound:
        up = float(whole.sub_crs_list[1].axis_info[0].unit_conversion_factor)
    elif whole is not None and len(whole.axis_info) > 2:
        up = float(whole.axis_info[2].unit_conversion_factor)
    name = str(crs.axis_info[0].unit_name) if crs.axis_info else "metre"
    return Metres(across, up, name if up == across else f"{name}, heights of {up:.9g} m")
