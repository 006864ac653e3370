"""Shots: what a lidar measured, in its own frame, whatever its model; and which of them are let through.

The sensor frame has x right, y forward and z up. Azimuth is 0 straight ahead and grows clockwise seen from above.
"""

from dataclasses import astuple, dataclass, fields, replace
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SINGLE_RETURN: Final = 0x11
"""Byte of return numbers as LAS 1.4 has it: return 1 (low half) of 1 (high half)."""
FIRST_OF_TWO: Final = 0x21
SECOND_OF_TWO: Final = 0x22


@dataclass(frozen=True, slots=True)
class Gate:
    """Which shots are let through.

    Attributes
    ----------
    fov_start_deg, fov_end_deg : float
        Azimuth window, clockwise from start to end, both included, for example 255 to 105 through straight ahead. Equal modulo
        360: the full circle.
    min_range_m, max_range_m : float
        Inclusive range gate on the range as measured [m].
    """

    fov_start_deg: float = 0.0
    fov_end_deg: float = 360.0
    min_range_m: float = 0.0
    max_range_m: float = 200.0

    def window_deg(self) -> tuple[float, float]:
        """Start of the azimuth window, 0 to 360, and its width, more than 0."""
        width = (self.fov_end_deg - self.fov_start_deg) % 360.0
        return self.fov_start_deg % 360.0, width if width > 0.0 else 360.0


@dataclass(frozen=True, slots=True)
class LaserTable:
    """What is known of the lasers of a sensor, in firing order: where they point, and corrections of their ranges.

    Attributes
    ----------
    elevation_rad : ndarray, shape (lasers,)
    range_offset_m : ndarray, shape (lasers,)
        Added to each range.
    height_m : ndarray, shape (lasers,)
        Where each beam crosses the spin axis, above the sensor's origin.
    """

    elevation_rad: Array
    range_offset_m: Array
    height_m: Array

    @classmethod
    def of_elevations(cls, elevation_deg: npt.ArrayLike, height_m: npt.ArrayLike | None = None) -> "LaserTable":
        """A manual's table, without corrections."""
        elevation_rad = np.deg2rad(np.asarray(elevation_deg, np.float64))
        zero = np.zeros(len(elevation_rad))
        return cls(elevation_rad, zero, zero if height_m is None else np.asarray(height_m, np.float64))

    def __len__(self) -> int:
        return len(self.elevation_rad)

    def kernel_rows(self) -> Array:
        """Cosine and sine of the elevation, range offset and height, shape (4, lasers), as the kernels want them."""
        return np.stack([np.cos(self.elevation_rad), np.sin(self.elevation_rad), self.range_offset_m, self.height_m])


@dataclass(frozen=True, slots=True)
class Gated:
    """Shots that the sensor fired and that give no return, by the reason met first.

    Attributes
    ----------
    outside_fov : int
    no_return : int
    out_of_range : int
        A return outside the range gate.
    """

    outside_fov: int = 0
    no_return: int = 0
    out_of_range: int = 0

    def __add__(self, other: "Gated") -> "Gated":
        return Gated(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


@dataclass(frozen=True, slots=True)
class Shots:
    """Returns of a lidar, in the order they were received.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        On the time scale that the packets' times are on.
    xyz_m : ndarray of float32, shape (n, 3)
        Position in the sensor frame, with the corrections of `lasers`.
    range_m : ndarray of float32, shape (n,)
        As measured.
    intensity, laser : ndarray of uint8, shape (n,)
        The laser is its place in the firing order.
    returns : ndarray of uint8, shape (n,)
        Return number (low half, nearest first) and number of returns (high half).
    lasers : LaserTable
        That the positions were computed with.
    gated : Gated
        What became of the other shots of the same packets.
    """

    time_ns: npt.NDArray[np.int64]
    xyz_m: npt.NDArray[np.float32]
    range_m: npt.NDArray[np.float32]
    intensity: npt.NDArray[np.uint8]
    laser: npt.NDArray[np.uint8]
    returns: npt.NDArray[np.uint8]
    lasers: LaserTable
    gated: Gated

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, chosen: slice | npt.NDArray[np.bool_]) -> "Shots":
        """Some of them; `gated` goes with the first slice only, so that sums stay right: it is empty here."""
        arrays = {name: getattr(self, name)[chosen] for name in _ARRAYS}
        return replace(self, **arrays, gated=Gated())

    @property
    def azimuth_rad(self) -> Array:
        """Azimuth at each shot's own instant, 0 to 2 pi, shape (n,). Computed when asked for: placing needs only `xyz_m`."""
        right, ahead = self.xyz_m[:, 0].astype(np.float64), self.xyz_m[:, 1].astype(np.float64)
        return np.asarray(np.arctan2(right, ahead) % (2.0 * np.pi))

    @property
    def elevation_rad(self) -> Array:
        """Elevation of each shot's laser, shape (n,)."""
        return self.lasers.elevation_rad[self.laser]


_ARRAYS: Final = tuple(field.name for field in fields(Shots) if field.name not in ("lasers", "gated"))


def turns(azimuth_rad: Array, last_rad: float | None) -> npt.NDArray[np.int64]:
    """Where another turn of the scanner begins: the shots, shape (k,), that are first past straight behind.

    Parameters
    ----------
    azimuth_rad : ndarray, shape (n,)
        Of shots in order of time.
    last_rad : float or None
        Azimuth of the shot before them; None where there is none.
    """
    # from behind to behind, 0 to 2 pi; only the rotor's turn takes it back by more than half
    past = np.mod(azimuth_rad + np.float32(np.pi), np.float32(2.0 * np.pi))
    before = past[:1] if last_rad is None else np.float32((last_rad + np.pi) % (2.0 * np.pi))
    return np.flatnonzero(np.diff(past, prepend=before) < -np.pi)
