"""The ground of one or two clouds of a place, in metres and in the frame of the first, read as often as it is asked for."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.analysis.epochs import Epochs, laid
from groundproc.analysis.terrain.floor import Floor
from groundproc.cloud import reader
from groundproc.cloud.classes import BUILDING, GROUND, HIGH, LOW, MEDIUM, NO_SURFACE, OF_USES, WATER
from groundproc.raster.cells import Cells

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Progress = Callable[[int], object]

_PER_CELL: Final = 4.0
_FINEST_M, _COARSEST_M = 0.1, 1.0
_WINDOW_M: Final = 3.0
"""Half the width of what is taken off the ground. More would take a terrace that ends with the cloud; houses are told by their outline."""
_STANDS: Final = (LOW, MEDIUM, HIGH, BUILDING, *OF_USES)
_MOST_WATER: Final = 200_000
"""Points of class 9 that a level is told from."""


class Ground:
    """Points of bare ground, by epoch.

    Parameters
    ----------
    clouds : list of reader.Cloud
        One, or the earlier and the later.
    registered : bool
        They lie on each other already.
    folder : Path
        For temporary files.
    progress : callable
    terrain : str
        See `terrain.settings`.

    Attributes
    ----------
    floor : Floor
    cell_m : float
    cells : list of Cells
        Mean and lowest point of each cell, by epoch.
    water : list of ndarray, shape (n, 3)
        Points of class 9, by epoch.
    registration_sigma_m : float or None
    shift : ndarray, shape (3, 3)
        Covariance of laying the epochs on each other.
    """

    def __init__(
        self, clouds: list[reader.Cloud], registered: bool, folder: Path, progress: Progress, terrain: str
    ) -> None:
        self._clouds, self._progress = clouds, progress
        self._epochs: Epochs | None = None
        self.shift = np.zeros((3, 3))
        self.registration_sigma_m: float | None = None
        if len(clouds) > 1:
            self._epochs = laid((clouds[0], clouds[1]), (None, None), registered, lambda stage, count: progress(count))
            if not registered:
                self.shift = self._epochs.registration.covariance[:3, :3]
                self.registration_sigma_m = self._epochs.registration.sigma_m
        self.floor = Floor(clouds[0], folder, progress, terrain, window_m=_WINDOW_M)
        self.cell_m = float(np.clip(np.sqrt(_PER_CELL / self.floor.density_m2), _FINEST_M, _COARSEST_M))
        self.cells = [Cells(self.cell_m, {"mean", "min"}) for _ in clouds]
        self.water: list[Array] = []
        self.points = [0] * len(clouds)
        for epoch, cells in enumerate(self.cells):
            wet: list[Array] = []
            for xyz, bare, water in self._of(epoch):
                cells.add(xyz[bare], xyz[bare, 2])
                self.points[epoch] += int(bare.sum())
                wet.append(xyz[water][:: max(1, self._clouds[epoch].points // _MOST_WATER)])
            self.water.append(np.concatenate([np.empty((0, 3)), *wet]))

    def pieces(self, epoch: int) -> Iterator[Array]:
        """Points of bare ground, shape (n, 3), water left out."""
        for xyz, bare, water in self._of(epoch):
            yield xyz[bare & ~water]

    def _of(self, epoch: int) -> Iterator[tuple[Array, Mask, Mask]]:
        """Places, which are on the ground, and which are of class 9."""
        for chunk, xyz in self._read(epoch):
            kind = chunk.points.columns.get("classification", np.zeros(len(xyz), np.uint8))
            _, found = self.floor.heights(xyz, np.isin(kind, NO_SURFACE))
            water = kind == WATER
            yield xyz, ((found == GROUND) & ~np.isin(kind, _STANDS)) | water, water
            self._progress(len(xyz))

    def _read(self, epoch: int) -> Iterator[tuple[reader.Chunk, Array]]:
        if self._epochs is not None:
            for chunk, xyz, _ in self._epochs.chunks(epoch, ("classification",)):
                yield chunk, np.ascontiguousarray(xyz)
            return
        for chunk in reader.chunks(self._clouds[epoch], columns=("classification",)):
            yield chunk, np.ascontiguousarray(self.floor.metres.of(chunk.points.xyz_m))
