"""The voxels of a stretch's points, kept from when they are found: who goes through the stretch again need not look them up again."""

import tempfile
import weakref
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from groundproc.cloud.points import Points
from groundproc.cloud.surroundings import Surroundings

Ints = npt.NDArray[np.int32]


class VoxelNumbers:
    """Numbers of voxels in a temporary file, four bytes a point; it has no name and is gone when this is.

    Where the file has no room, they are looked up when they are asked for.

    Parameters
    ----------
    around : Surroundings
        That have the voxels.
    """

    def __init__(self, around: Surroundings) -> None:
        self._around = around
        self._file: Any = None
        try:
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 (open as long as this lives)
            weakref.finalize(self, self._file.close)
        except OSError:
            pass

    def keep(self, voxel: Ints) -> None:
        """Keep those of the next points, shape (n,)."""
        if self._file is None:
            return
        try:
            left = voxel.view(np.uint8).data
            while len(left):
                left = left[self._file.write(left) :]
        except OSError:
            self._file.close()  # at once: products need the room
            self._file = None

    def beside(self, pieces: Iterable[Points]) -> Iterator[tuple[Points, Ints]]:
        """The pieces of the stretch from its first on, each with the voxels of its points."""
        if self._file is not None:
            self._file.seek(0)
        for points in pieces:
            yield points, self._next(points)
            del points  # the next piece takes its memory

    def _next(self, points: Points) -> Ints:
        if self._file is None:
            return self._around.of(points.xyz_m)
        voxel = np.empty(len(points), np.int32)
        left = voxel.view(np.uint8).data
        while len(left):
            done = self._file.readinto(left)
            if not done:
                raise OSError(f"{len(left)} bytes are missing of the voxels that were kept")
            left = left[done:]
        return voxel
