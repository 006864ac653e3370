"""THE table of point attributes. `Points`, the LAS writer, the reader and docs/dimensions.md are made from it.

A new attribute is one entry here, and the stage that fills it with `points.with_columns(name=values)`. Whatever columns points have
are written; the entry says how.

A column holds values in the unit of its entry, the one that files and people see: angles of points are degrees. An entry without a scale
is a whole number, or a float, as stored. With a scale the column is floating and the file holds `round(value / scale)`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

_DESCRIPTION_BYTES: Final = 32
"""LAS 1.4 R15, table 24: the description of an extra byte."""


@dataclass(frozen=True, slots=True)
class Dimension:
    """One attribute of a point.

    Attributes
    ----------
    name : str
        Of the column, and in the file.
    dtype : str
        Of the stored number, as numpy writes it: u1, i2, f4.
    brief : str
        A few words; with the unit at most 32 bytes: the description in the file.
    about : str
        What it means, in a sentence.
    source : str
        Which stage fills it.
    unit : str
        Of the column's values; empty: a plain number.
    scale : float or None
        One stored step in `unit`.
    field : str
        Of LAS 1.4 that holds it; empty: extra bytes of the same name.
    no_data : int or None
        Stored where the column is not a number.
    """

    name: str
    dtype: str
    brief: str
    about: str
    source: str
    unit: str = ""
    scale: float | None = None
    field: str = ""
    no_data: int | None = None

    def __post_init__(self) -> None:
        assert len(self.description.encode()) <= _DESCRIPTION_BYTES, self.name
        assert self.no_data is None or self.scale is not None, self.name

    @property
    def description(self) -> str:
        """What the file says of extra bytes."""
        return f"{self.brief} [{self.unit}]" if self.unit else self.brief

    @property
    def stored(self) -> np.dtype[Any]:
        """Type of the number in the file."""
        return np.dtype(self.dtype)

    @property
    def column(self) -> np.dtype[Any]:
        """Type of the column: float32 holds every step of two bytes, float64 those of four."""
        if self.scale is None:
            return self.stored
        return np.dtype(np.float32 if self.stored.itemsize <= 2 else np.float64)

    def limits(self) -> tuple[float, float]:
        """Least and largest value that the file can hold, the one for no data left out."""
        if self.stored.kind == "f":
            most = float(np.finfo(self.stored).max)
            return -most, most
        low, high = self.steps()
        step = self.scale or 1.0
        return low * step, high * step

    def steps(self) -> tuple[int, int]:
        """Least and largest stored whole number."""
        bounds = np.iinfo(self.stored)
        low, high = int(bounds.min), int(bounds.max)
        if self.field in BIT_FIELDS:
            low, high = 0, 15
        return low + (self.no_data == low), high - (self.no_data == high)

    def holds(self, values: npt.NDArray[Any]) -> bool:
        """Whether an array is of a type that this column may have."""
        if self.scale is not None:
            return values.dtype.kind == "f"
        return np.can_cast(values.dtype, self.stored, "safe")


BIT_FIELDS: Final = ("return_number", "number_of_returns")
"""Fields of four bits each that share a byte, the first in its low half (LAS 1.4 R15, table 16)."""

PLACED: Final = (
    Dimension(
        "x", "i4", "easting", "Easting in the CRS of the file; right of the sensor in its own frame.", "placing", "m", 0.001, "X",
    ),
    Dimension(
        "y", "i4", "northing", "Northing in the CRS of the file; ahead of the sensor in its own frame.", "placing", "m", 0.001, "Y",
    ),
    Dimension(
        "z", "i4", "height", "Height as the survey chose it; up from the sensor in its own frame.", "placing", "m", 0.001, "Z",
    ),
    Dimension(
        "gps_time", "f8", "GPS time",
        "When the laser was fired: adjusted standard GPS time (GPS time less 10^9 s), or where the lidar's clock is tied to nothing, "
        "seconds of it past the hour of the first packet. Inside it is `time_ns`, UTC.", "sensor", "s", None, "gps_time",
    ),
)  # fmt: skip
"""What every point has: `Points.xyz_m` and `Points.time_ns`."""

TABLE: Final = (
    Dimension(
        "intensity", "u2", "intensity", "Strength of the echo on the sensor's own scale; the HDL-32E's goes from 0 to 255.", "sensor",
        field="intensity",
    ),
    Dimension(
        "return_number", "u1", "return number", "Rank of the echo among those of its shot, the nearest is 1.", "sensor",
        field="return_number",
    ),
    Dimension(
        "number_of_returns", "u1", "number of returns", "How many echoes of the shot there are.", "sensor", field="number_of_returns",
    ),
    Dimension(
        "classification", "u1", "class", "ASPRS class; from 64 on see docs/attributes.md.", "attributes",
        field="classification",
    ),
    Dimension(
        "scan_angle", "i2", "scan angle",
        "Angle of the beam off the vertical across the line of flight, right positive; where the aircraft stands, across the way that "
        "the sensor looks.", "attributes", "deg", 0.006, "scan_angle",
    ),
    Dimension("user_data", "u1", "user data", "What another program used it for.", "other programs", field="user_data"),
    Dimension(
        "point_source_id", "u2", "point source", "The flight line that the point is from, counted from 1; or the file.", "attributes",
        field="point_source_id",
    ),
    Dimension("red", "u2", "red", "Colour, 0 to 65535.", "`swath colour`", field="red"),
    Dimension("green", "u2", "green", "Colour, 0 to 65535.", "`swath colour`", field="green"),
    Dimension("blue", "u2", "blue", "Colour, 0 to 65535.", "`swath colour`", field="blue"),
    Dimension("nir", "u2", "near infrared", "Near infrared, 0 to 65535.", "`swath colour`", field="nir"),
    Dimension("laser", "u1", "laser in firing order", "Number of the laser in the sensor's firing order, from 0.", "sensor"),
    Dimension(
        "azimuth", "u2", "azimuth", "Azimuth of the beam in the sensor frame at the laser's own instant, clockwise from straight ahead.",
        "decoding", "deg", 0.01,
    ),
    Dimension("range", "u2", "range", "Distance from the sensor as measured, before corrections of the laser.", "sensor", "m", 0.002),
    Dimension(
        "incidence", "u1", "incidence", "Angle between the beam and the normal of the surface around the point; none where there is none.",
        "attributes", "deg", 1.0, no_data=255,
    ),
    Dimension(
        "mixed", "u1", "mixed echo", "1: the echo is of two surfaces, and lies between them.", "attributes",
    ),
    Dimension(
        "sigma_h", "u2", "sigma horizontal", "How well its place is known, one sigma of each horizontal axis; the GNSS is in it.",
        "attributes", "m", 0.001, no_data=65535,
    ),
    Dimension(
        "sigma_v", "u2", "sigma vertical", "How well its height is known, one sigma; the GNSS is in it.", "attributes", "m", 0.001,
        no_data=65535,
    ),
    Dimension(
        "smoothed", "u1", "1 moved onto its surface", "1: moved onto the surface that the points around tell; 0: as it was measured.",
        "`swath smooth`",
    ),
    Dimension(
        "smoothing", "i2", "moved by smoothing", "How far it was moved, along the normal of its surface.", "`swath smooth`", "m", 0.0001,
        no_data=-32768,
    ),
    Dimension(
        "smoothing_sigma", "u2", "sigma of surface", "How well that surface is known there, one sigma, beside what all its points share.",
        "`swath smooth`", "m", 0.0001, no_data=65535,
    ),
    Dimension(
        "reflectance", "f4", "diffuse reflectance",
        "Share of the light that a surface throws back, as a white Lambertian one throws back all; not a number where the echo is of a "
        "retro-reflector or beyond what the sensor can tell.", "`swath reflectance`",
    ),
    Dimension(
        "reflectance_sigma", "f4", "sigma of reflectance", "One standard deviation of the reflectance.", "`swath reflectance`",
    ),
    Dimension("red_edge", "u2", "red edge", "Light between red and near infrared, 0 to 65535.", "`swath colour`"),
    Dimension(
        "temperature", "f4", "temperature", "Of the surface, as a thermal camera has it.", "`swath colour`", "deg C",
    ),
    Dimension(
        "ndvi", "f4", "vegetation index", "Difference of near infrared and red over their sum, -1 to 1.", "`swath ndvi`",
    ),
    Dimension(
        "views", "u1", "views", "Images that see the point, 255 at most; 0: it has no colour.", "`swath colour`",
    ),
    Dimension(
        "spectral_class", "u1", "material by its spectrum", "Number in the library of spectra, from 1; 0 is none.",
        "`swath drape`",
    ),
    Dimension(
        "spectral_angle", "f4", "angle of spectra", "Angle between the spectrum and that of the nearest material.", "`swath drape`", "deg",
    ),
    Dimension("hag", "f4", "height above ground", "Height above the terrain model.", "ground", "m"),
    Dimension("clearance", "f4", "to the nearest wire", "Distance to the nearest wire.", "wires", "m"),
    Dimension("object", "u2", "number of object", "Number of the object that was detected; 0 is none.", "detect"),
    Dimension(
        "epoch", "u1", "which cloud", "The cloud that the point is from, from 0 in the order given.", "`swath change`, `swath fuse`",
    ),
    Dimension("along", "f8", "along the section", "Way along the line of a section.", "`swath section`", "m"),
    Dimension(
        "change", "u1", "0 same 1 new 2 gone 3 unseen",
        "0 unchanged, 1 appeared, 2 vanished, 3 not looked into by the other epoch, 4 noise or moving and not compared.", "`swath change`",
    ),
    Dimension(
        "change_distance", "f4", "from the other epoch", "Signed distance from the surface of the other epoch, above it positive; not a "
        "number where it has none nearby.", "`swath change`", "m",
    ),
    Dimension(
        "change_sigma", "f4", "sigma of change", "Of that distance: both epochs' roughness and the registration.", "`swath change`", "m",
    ),
    Dimension(
        "change_lod", "f4", "detectable at 95 %", "A smaller distance may be none: 1.96 sigmas of it.", "`swath change --surface`", "m",
    ),
)  # fmt: skip
"""All columns that points may have, in the order of the file and of the documentation."""


def dimension(name: str) -> Dimension:
    """The entry of a column.

    Raises
    ------
    KeyError
        There is none of that name: a mistake of ours.
    """
    for entry in TABLE:
        if entry.name == name:
            return entry
    raise KeyError(f"{name}: is no point attribute of cloud/dimensions.py")


def in_order(names: Iterable[str]) -> list[Dimension]:
    """Entries of some columns, in the order of the table."""
    wanted = {dimension(name).name for name in names}
    return [entry for entry in TABLE if entry.name in wanted]
