"""Clusters of many slices, as columns."""

import contextlib
import io
import tempfile
import weakref
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]


@dataclass(slots=True, weakref_slot=True)
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
    _file: io.BufferedRandom | None = field(default=None, repr=False, compare=False)

    def put_aside(self) -> None:
        """Have the scatter, half of all, in a file until it is taken back; where a file has no room, it stays."""
        if not len(self.scatter_m2):
            return
        if self._file is None:
            try:
                with contextlib.ExitStack() as stack:
                    file = stack.enter_context(tempfile.TemporaryFile())
                    file.write(np.ascontiguousarray(self.scatter_m2).data)
                    file.flush()
                    weakref.finalize(self, stack.pop_all().close)  # it goes with the clusters
            except OSError:
                return
            self._file = file
        self.scatter_m2 = np.empty((0, 6), np.float32)

    def take_back(self) -> None:
        """Have the scatter in memory again."""
        if self._file is not None and not len(self.scatter_m2):
            self.scatter_m2 = np.empty((len(self), 6), np.float32)
            self._file.seek(0)
            self._file.readinto(self.scatter_m2.data)

    @classmethod
    def none(cls) -> "Clusters":
        """Columns without rows, of no laser."""
        return cls(
            np.empty(0, np.int64), np.empty((0, 3), np.float32), np.empty((0, 6), np.float32), np.empty(0, np.int32)
        )

    def __len__(self) -> int:
        return len(self.time_ns)
