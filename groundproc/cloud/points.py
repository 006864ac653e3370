"""Points: returns placed in the world, and what became of the shots that made none."""

from dataclasses import astuple, dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Points:
    """Returns placed in the world, in the order they were received.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        On the trajectory's scale, UTC.
    xyz_m : ndarray, shape (n, 3)
        Local (east, north, up), or easting, northing, height after `project`.
    range_m : ndarray of float32, shape (n,)
        Range as measured.
    intensity, laser, returns : ndarray of uint8, shape (n,)
        As in `Shots`.
    dropped : Dropped
    """

    time_ns: npt.NDArray[np.int64]
    xyz_m: Array
    range_m: npt.NDArray[np.float32]
    intensity: npt.NDArray[np.uint8]
    laser: npt.NDArray[np.uint8]
    returns: npt.NDArray[np.uint8]
    dropped: "Dropped"

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True, slots=True)
class Dropped:
    """Shots that made no point, by the reason met first.

    Attributes
    ----------
    no_pose : int
        Returns within field of view and range gate that the trajectory does not cover.
    outside_fov : int
    no_return : int
    out_of_range : int
        A return outside the range gate.
    """

    no_pose: int = 0
    outside_fov: int = 0
    no_return: int = 0
    out_of_range: int = 0

    def __add__(self, other: "Dropped") -> "Dropped":
        return Dropped(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))
