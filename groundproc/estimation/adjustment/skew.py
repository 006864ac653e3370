"""How far the axes of a gyro may be turned on their board, which no flight tells, by how far they lie askew to each other, which it does.

Each axis of a triad leans towards each of the two others by an angle t_ij of its own. What is common to both of a pair is a turn of the
triad, (t_ij - t_ji) / 2; what is not is cross-axis sensitivity, (t_ij + t_ji) / 2. Both are of one size. The class of the instrument says
how large that is; axes that are found to lie farther askew are of a worse one.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.observations.unit import sheared

Array = npt.NDArray[np.float64]

MISALIGNMENT_RAD: Final = np.deg2rad(0.2)
"""How far the axes of a cheap gyro are from those of its board (cross-axis sensitivity of its class, one sigma): the boresight is found
through the gyro, and no flight tells the two apart."""
WORTH: Final = 4.0
"""The class counts as much as so many angles that one has seen."""
PAIRS: Final = ((1, 2), (2, 0), (0, 1))


def misalignment_rad(values: Mapping[str, tuple[Array, Array]], mat_ins_lidar: Array) -> float:
    """Sigma of the turn of a gyro's axes on their board, about each axis; never below `MISALIGNMENT_RAD`.

    Parameters
    ----------
    values : mapping of str to (ndarray, ndarray)
        Unknowns and their sigmas, of which "ins.scale" and "ins.shear" are looked at: on the axes of the sensor.
    mat_ins_lidar : ndarray, shape (3, 3)
        Nominal. Scales that differ are cross-axis sensitivity on axes that lie askew to the unit's own.
    """
    if "ins.shear" not in values or "ins.scale" not in values:
        return float(MISALIGNMENT_RAD)
    (scale, scale_sigma), (shear, shear_sigma) = values["ins.scale"], values["ins.shear"]
    across = _across(np.diag(scale) + sheared(shear), mat_ins_lidar)
    each = [(np.diag(unit), sigma) for unit, sigma in zip(np.eye(3), scale_sigma, strict=True)]
    each += [(sheared(unit), sigma) for unit, sigma in zip(np.eye(3), shear_sigma, strict=True)]
    variance = np.sum([np.square(_across(gain, mat_ins_lidar) * sigma) for gain, sigma in each], axis=0)
    told = variance < MISALIGNMENT_RAD**2
    seen = float((np.square(across) - variance)[told].sum())
    square = (WORTH * MISALIGNMENT_RAD**2 + seen) / (WORTH + int(told.sum()))
    return float(np.sqrt(max(square, MISALIGNMENT_RAD**2)))


def _across(gain: Array, mat_ins_lidar: Array) -> Array:
    """Cross-axis sensitivities of the unit's own axes, shape (3,), of what a triad reads on those of the sensor, shape (3, 3)."""
    own = mat_ins_lidar @ gain @ mat_ins_lidar.T
    return np.array([own[pair] for pair in PAIRS])
