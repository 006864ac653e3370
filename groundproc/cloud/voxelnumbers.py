"""The voxels of a stretch's points, kept from when they are found: who goes through the stretch again need not look them up again."""

import contextlib
from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

from groundproc.cloud.points import Points
from groundproc.cloud.surroundings import Surroundings
from groundproc.machine.scratch import Scratch

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
        self._file: Scratch | None = None
        with contextlib.suppress(OSError):
            self._file = Scratch()

    def keep(self, voxel: Ints) -> None:
        """Keep those of the next points, shape (n,)."""
        if self._file is None:
            return
        try:
            self._file.write(voxel)
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
        return self._file.read(len(points), np.int32)
