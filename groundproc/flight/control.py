"""Control points and planes: what is known of the surface from elsewhere, read from a table."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from flightlog.words import clean
from groundproc.text import decimal_comma, open_text, table_of

Array = npt.NDArray[np.float64]

COLUMNS: Final = ("x", "y", "z", "sigma")
NORMAL: Final = ("nx", "ny", "nz")
USES: Final = {"": False, "control": False, "check": True}
_FARTHEST_M: Final = 1e8
_LARGEST_M: Final = 1e6
RIM: Final = 4
"""A plane is held at its middle and at so many places around."""


@dataclass(frozen=True, slots=True)
class ControlPoint:
    """A place on a surface, or a flat part of one.

    Attributes
    ----------
    name : str
    place_m : ndarray, shape (3,)
        In map coordinates as read, or local.
    sigma_m : float
        Of the survey, across the surface.
    check : bool
        Only measured, not used.
    normal : ndarray, shape (3,), or None
        Unit vector across a plane; of a point the surface's own serves.
    radius_m : float
        How far the plane reaches from its middle; 0 for a point.
    """

    name: str
    place_m: Array
    sigma_m: float
    check: bool = False
    normal: Array | None = None
    radius_m: float = 0.0

    def spots(self) -> Array:
        """The places by which it is held [m], shape (1, 3), or (1 + RIM, 3) for a plane."""
        if self.normal is None or self.radius_m == 0.0:
            return self.place_m[None]
        aside = np.cross(self.normal, np.eye(3)[int(np.argmin(np.abs(self.normal)))])
        aside /= np.linalg.norm(aside)
        angle = 2.0 * np.pi * np.arange(RIM)[:, None] / RIM
        rim = np.cos(angle) * aside + np.sin(angle) * np.cross(self.normal, aside)
        return np.concatenate([self.place_m[None], self.place_m + self.radius_m * rim])

    def spot_sigma_m(self) -> float:
        """Sigma of each of them were they measured alone: together they know the plane's offset as well as it is stated."""
        return float(self.sigma_m * np.sqrt(len(self.spots())))


def read_control(path: Path) -> tuple[ControlPoint, ...]:
    """Points and planes in map coordinates.

    The first line names the columns: x, y, z, sigma [m]; and where they are wanted name, use (control or check), and for planes nx, ny, nz,
    radius [m]. Others are passed over.

    Raises
    ------
    CaptureError
        It cannot be read, or a line is not what the columns say.
    """
    found: list[ControlPoint] = []
    try:
        with open_text(path) as file:
            rows = table_of(file, str(path), "x", CaptureError, f"control has {', '.join(COLUMNS)}")
            names = [name.lower() for name in rows.names]
            if not set(COLUMNS) <= set(names):
                missing = ", ".join(name for name in COLUMNS if name not in names)
                raise CaptureError(f"{path}: the first line has no column {missing}")
            for number, line in rows.rows(short=True):
                words = dict(zip(names, (word.strip() for word in line), strict=False))
                comma = decimal_comma(line)
                place = f"{path}: line {number}: " + (comma or f"{clean(','.join(line))!r} found")
                found.append(_point(words, place, len(found) + 1))
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not found:
        raise CaptureError(f"{path}: holds no points")
    return tuple(found)


def _point(words: dict[str, str], place: str, number: int) -> ControlPoint:
    """What one line says; `place` begins the sentence where it says nothing."""
    try:
        x, y, z, sigma = (float(words[name]) for name in COLUMNS)
    except (KeyError, ValueError):
        x = y = z = sigma = np.nan
    if not (all(abs(value) <= _FARTHEST_M for value in (x, y, z)) and 0.0 < sigma <= _LARGEST_M):
        raise CaptureError(f"{place}, expected x, y, z and a sigma above 0")
    use = words.get("use", "").lower()
    if use not in USES:
        raise CaptureError(f"{place}, expected control or check as its use")
    point = ControlPoint(words.get("name") or str(number), np.array([x, y, z]), sigma, USES[use])
    if not any(words.get(name) for name in NORMAL):
        return point
    try:
        normal = np.array([float(words[name]) for name in NORMAL])
        radius = float(words.get("radius") or 0.0)
    except (KeyError, ValueError):
        normal, radius = np.zeros(3), -1.0
    length = float(np.linalg.norm(normal))
    if not 1e-6 < length < np.inf or not 0.0 <= radius <= _LARGEST_M:
        raise CaptureError(f"{place}, expected nx, ny, nz across the plane and a radius of 0 or more")
    return replace(point, normal=normal / length, radius_m=radius)


def table(points: tuple[ControlPoint, ...]) -> Array:
    """The places by which those that are used are held, with the sigma of each [m], shape (n, 4)."""
    rows = [
        np.column_stack([spots := point.spots(), np.full(len(spots), point.spot_sigma_m())])
        for point in points
        if not point.check
    ]
    return np.concatenate(rows) if rows else np.empty((0, 4))
