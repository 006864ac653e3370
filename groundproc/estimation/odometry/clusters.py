"""Clusters of many slices, as columns."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groundproc.machine.aside import aside

Ints = npt.NDArray[np.int64]


@dataclass(slots=True)
class Clusters:
    """Clusters of all slices: columns of slices.CLUSTER_DTYPE.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
    xyz_m : ndarray of float32, shape (n, 3)
    scatter_m2 : ndarray of float32, shape (n, 6)
    count : ndarray of int32, shape (n,)
    laser : ndarray of int32, shape (n,), optional
        Given where the corrections of the single lasers are unknowns too.
    """

    time_ns: Ints
    xyz_m: npt.NDArray[np.float32]
    scatter_m2: npt.NDArray[np.float32]
    count: npt.NDArray[np.int32]
    laser: npt.NDArray[np.int32] | None = None

    def set_aside(self) -> None:
        """Have all columns in a file, of which is in memory what is read: a window has a hundred megabytes."""
        lasers = () if self.laser is None else (self.laser,)
        self.time_ns, self.xyz_m, self.scatter_m2, self.count, *lasers_aside = aside(
            self.time_ns, self.xyz_m, self.scatter_m2, self.count, *lasers
        )
        if lasers_aside:
            (self.laser,) = lasers_aside

    @classmethod
    def none(cls) -> "Clusters":
        """Columns without rows, of no laser."""
        return cls(
            np.empty(0, np.int64), np.empty((0, 3), np.float32), np.empty((0, 6), np.float32), np.empty(0, np.int32)
        )

    def __len__(self) -> int:
        return len(self.time_ns)
