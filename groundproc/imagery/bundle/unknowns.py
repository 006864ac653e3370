"""Which columns the unknowns of a block have, points apart."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from groundproc.imagery import lenses
from groundproc.imagery.bundle.block import POSE, Block
from groundproc.imagery.rig import MOUNTING

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

OF_CAMERA = lenses.FREE + len(MOUNTING)
"""Numbers of a camera that can be unknowns: those of its lens, then `MOUNTING`."""
LEAST_POINTS = 3
"""Control points that make a datum."""


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Columns of the reduced system.

    Attributes
    ----------
    station : ndarray of int64, shape (s, 6)
        -1 where a value is held for the datum.
    camera : ndarray of int64, shape (c, OF_CAMERA)
        -1 where it is held.
    size : int
    datum : str
        How it lies in space: "observed", or which values are held.
    common : ndarray of int64, shape (7,)
        Lateness of the trajectory's attitudes, then shift and turn of the trajectory as a whole.
    """

    station: Ints
    camera: Ints
    size: int
    datum: str
    common: Ints = field(default_factory=lambda: np.full(1 + POSE, -1))

    def names_of(self, camera: int, names: tuple[str, ...]) -> tuple[tuple[str, ...], Ints]:
        """Names of a camera's unknowns and their columns; `names` are those of its lens vector's places."""
        every = (*names, *MOUNTING)
        columns = self.camera[camera]
        chosen = np.flatnonzero(columns >= 0)
        return tuple(every[place] for place in chosen), columns[chosen]


def lens_names(block: Block, camera: int) -> tuple[str, ...]:
    """Name of each place of the lens vector of a camera; empty where it has none."""
    model = block.rig.cameras[camera].camera
    names = [""] * lenses.FREE
    for name in model.names:
        names[model.place_of(name)] = name
    return tuple(names)


def lay_out(block: Block) -> Unknowns:
    """Give each unknown its column; where nothing says where the block lies, seven values are held.

    The datum of a free network is the pose of its first station and the coordinate that differs most from it: dependent
    relative orientation.
    """
    stations, cameras = len(block.stations), len(block.rig.cameras)
    station = np.arange(stations * POSE).reshape(stations, POSE)
    free = np.ones_like(station, np.bool_)
    datum = "observed"
    if not has_datum(block):
        base = np.abs(block.stations.place_m - block.stations.place_m[0])
        farthest, axis = (int(place) for place in np.unravel_index(np.argmax(base), base.shape))
        free[0], free[farthest, axis] = False, False
        first, last = (block.images[int(np.flatnonzero(block.station == s)[0])] for s in (0, farthest))
        datum = f"free network: the pose of {first} and coordinate {'xyz'[axis]} of {last} are held"
    columns = np.where(free, np.cumsum(free.ravel()).reshape(free.shape) - 1, -1)
    size = int(free.sum())
    camera = np.full((cameras, OF_CAMERA), -1)
    for number, one in enumerate(block.rig.cameras):
        if not (block.camera == number).any():
            continue
        places = sorted(one.camera.place_of(name) for name in one.estimate)
        mounting = block.mounting[number] if block.mounting else ()
        places += [lenses.FREE + MOUNTING.index(name) for name in MOUNTING if name in mounting]
        camera[number, places] = size + np.arange(len(places))
        size += len(places)
    size = _share_clocks(block, camera, size)
    given = block.priors.common
    shared = np.array([given.late_sigma_s > 0.0, *[given.covariance is not None] * POSE]) & bool(len(block.priors))
    common = np.where(shared, size + np.cumsum(shared) - 1, -1)
    return Unknowns(columns, camera, size + int(shared.sum()), datum, common)


def _share_clocks(block: Block, camera: Ints, size: int) -> int:
    """Cameras that are triggered together have one unknown shift: that of the lead of their stations; how many columns there are then."""
    shift = lenses.FREE + MOUNTING.index("timeshift")
    lead = np.arange(len(camera))
    np.minimum.at(lead, block.camera, block.stations.lead[block.station])
    follows = (lead != np.arange(len(camera))) & (camera[:, shift] >= 0)
    gone = camera[follows, shift]
    camera[follows, shift] = -1
    for column in sorted(gone, reverse=True):
        camera[camera > column] -= 1
    camera[follows, shift] = camera[lead[follows], shift]
    return size - len(gone)


def has_datum(block: Block) -> bool:
    """Whether observations say where the block lies: positions of three stations, or three control points, not all on a line."""
    places = []
    if len(block.priors):
        finite = np.isfinite(np.diagonal(block.priors.covariance, axis1=1, axis2=2))
        if finite.all(axis=1).any() and len(block.stations) >= 1 and finite[:, :3].all(axis=1).sum() >= 2:
            return True
        places.append(block.priors.place_m[finite[:, :3].all(axis=1)])
    control = block.rows.source == 0
    known, counts = np.unique(block.rows.point[control], return_counts=True)
    seen = np.isin(known, block.measured.point[block.measured.weight > 0.0])
    places.append(block.points_m[known[(counts == POSE // 2) & seen]])
    every = np.concatenate(places)
    if len(every) < LEAST_POINTS:
        return False
    spread = np.linalg.svd(every - every.mean(axis=0), compute_uv=False)
    return bool(spread[1] > 1e-3 * spread[0])
