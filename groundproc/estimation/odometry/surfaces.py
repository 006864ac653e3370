"""What a map holds, by kinds: the surfaces that are laid on another map, or that another map is laid on."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.odometry.matching import GROUND as GROUND_COSINE
from groundproc.estimation.odometry.voxels import COUNT, FLATNESS, MEAN, NORMAL, SPREAD, PlaneMap

Array = npt.NDArray[np.float64]
Kinds = npt.NDArray[np.int8]
Ints = npt.NDArray[np.int64]

GROUND, STANDING, FILLED, LOOSE = range(4)
"""What a voxel holds: level plane, other plane, leaves; and what is none of them, or not known to be."""
MOST_POINTS: Final = 700
THIN_M: Final = 1.0
"""One point for each cube of this edge: near walls would outvote all else."""


@dataclass(frozen=True, slots=True)
class Surfaces:
    """What a map holds.

    Attributes
    ----------
    place_m : ndarray, shape (n, 3)
    normal : ndarray, shape (n, 3)
        Of planes; zero for all else.
    kind : ndarray of int8, shape (n,)
    """

    place_m: Array
    normal: Array
    kind: Kinds

    def __len__(self) -> int:
        return len(self.kind)

    def of(self, chosen: npt.NDArray[np.bool_] | Ints) -> "Surfaces":
        """Some of them."""
        return Surfaces(self.place_m[chosen], self.normal[chosen], self.kind[chosen])

    def near(self, centre_m: Array, radius_m: float) -> "Surfaces":
        """Those within a horizontal distance of a place."""
        return self.of(np.square(self.place_m[:, :2] - centre_m[:2]).sum(axis=1) < radius_m**2)


def surfaces_of(planes: PlaneMap, centre_m: Array, radius_m: float) -> Surfaces:
    """What a map holds within a horizontal distance of a place."""
    rows = planes.voxels[: planes.count]
    rows = rows[np.square(rows[:, MEAN : MEAN + 2] - centre_m[:2]).sum(axis=1) < radius_m**2]
    flat, normal = rows[:, FLATNESS] >= 0.0, rows[:, NORMAL : NORMAL + 3]
    level = np.abs(normal[:, 2]) > GROUND_COSINE
    kind = np.where(rows[:, SPREAD] > 0.0, FILLED, LOOSE)
    kind = np.where((rows[:, COUNT] > 0) & flat, np.where(level, GROUND, STANDING), kind)
    return Surfaces(rows[:, MEAN : MEAN + 3].copy(), np.where(flat[:, None], normal, 0.0), kind.astype(np.int8))


def thinned(given: Surfaces) -> Surfaces:
    """One for each cube, what stands first, and of the whole as many as are used."""
    order = np.argsort(np.array([2, 0, 1, 3])[given.kind], kind="stable")
    _, first = np.unique(np.floor(given.place_m[order] / THIN_M).astype(np.int64), axis=0, return_index=True)
    chosen = np.sort(order[first])
    kept = []
    for which in (given.kind[chosen] == GROUND, np.isin(given.kind[chosen], (STANDING, FILLED))):
        own = chosen[which]
        kept.append(own[:: max(1, -(-len(own) // MOST_POINTS))])
    return given.of(np.concatenate(kept))
