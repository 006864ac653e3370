"""Points from rays: where the rays of a point come nearest to each other."""

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.imagery import lenses
from groundproc.imagery.bundle.block import Block
from groundproc.imagery.bundle.rows import System, ray_of, system_of
from groundproc.imagery.bundle.schur import inverted
from groundproc.imagery.bundle.unknowns import Unknowns, lay_out

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@njit(cache=True, nogil=True)
def _widest(directions: Array) -> float:
    """Widest angle between unit vectors, shape (n, 3) [rad]."""
    least = 1.0
    for i in range(len(directions)):
        for j in range(i):
            cosine = 0.0
            for k in range(3):
                cosine += directions[i, k] * directions[j, k]
            least = min(least, cosine)
    return float(np.arccos(max(-1.0, least)))


@njit(cache=True, nogil=True)
def _intersect(system: System, points: Array, angle: Array) -> None:
    ray, mat, away = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    origin, inside, centre = np.zeros(3), np.zeros(3), np.zeros(3)
    inverse = np.zeros((3, 3))
    for p in range(len(points)):
        matrix, right = np.zeros((3, 3)), np.zeros(3)
        first, last = system.first[p], system.first[p + 1]
        directions = np.zeros((last - first, 3))
        count = 0
        for i in range(first, last):
            camera = system.camera[system.image[i]]
            if system.root_weight[i] == 0.0:
                continue
            if not lenses.unprojected(system.kind[camera], system.lens[camera], system.pixel[i], ray):
                continue
            inside[0], inside[1], inside[2] = ray[0], ray[1], ray[2]
            # with the point at the frame's origin the ray is the origin in the camera frame, and the camera is where it is nothing
            ray_of(system, i, origin, ray, mat, away)
            for j in range(3):
                centre[j] = -(mat[0, j] * ray[0] + mat[1, j] * ray[1] + mat[2, j] * ray[2])
                directions[count, j] = mat[0, j] * inside[0] + mat[1, j] * inside[1] + mat[2, j] * inside[2]
            direction = directions[count]
            count += 1
            for j in range(3):
                for k in range(3):
                    share = (1.0 if j == k else 0.0) - direction[j] * direction[k]
                    matrix[j, k] += share
                    right[j] += share * centre[k]
        angle[p] = _widest(directions[:count])
        if count < 2 or not inverted(matrix, 0.0, inverse):
            points[p, 0], points[p, 1], points[p, 2] = np.nan, np.nan, np.nan
            continue
        for k in range(3):
            points[p, k] = inverse[k, 0] * right[0] + inverse[k, 1] * right[1] + inverse[k, 2] * right[2]


def intersect(block: Block, unknowns: Unknowns | None = None) -> tuple[Array, Array]:
    """Points of a block from its poses, and the widest angle of their rays.

    Returns
    -------
    points_m : ndarray, shape (p, 3)
        Where the sum of squared distances from the rays is least; not a number where they are parallel, or fewer than two.
    angle_rad : ndarray, shape (p,)
    """
    points, angle = np.full((len(block.points_m), 3), np.nan), np.zeros(len(block.points_m))
    _intersect(system_of(block, unknowns or lay_out(block)), points, angle)
    return points, angle
