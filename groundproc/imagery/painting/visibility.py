"""Which points an image sees: a depth for each pixel, from discs as wide as the points stand apart, and who stands behind it.

A point that is nearer than any other in its pixel, within a tolerance, is seen. A disc closes the gaps between points, through which else
what is behind would show; it is never wider than that, for it would then hide what is beside. The tolerance follows the surface: along
one that is seen at a grazing angle the points of one pixel lie far one behind the other, and one that turns its back is not seen at
all, though its edge is as near as the roof that hides it.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.imagery.lenses import projected

Array = npt.NDArray[np.float64]

TOLERANCE: Final = 0.001
"""Share of the distance by which a seen point may be behind the nearest one of its pixel: what poses and lens leave."""
ROUGH_M: Final = 0.1
"""The same in metres where there is no plane: leaves, edges."""
PLANE_M: Final = 0.02
"""Across a plane, on top of its roughness."""
_NOISE: Final = 4.0
"""Roughnesses that the nearest point of a pixel may lie before a plane and another behind it."""
_DEEPEST_M: Final = 4.0
_GRAZING: Final = 0.02
_STEEP: Final = 0.5
"""Cosine of the angle to the normal above which a plane that should show its back is taken for a ceiling: seen from below."""
WIDEST_PX: Final = 6
"""Radius of a disc in the depth image [px of it]: of a lone point near the camera."""
_REACH: Final = 1.2
"""Radius of a disc in spacings. Points lie anyhow: at 0.9 three hidden points in a thousand shine through, at 1.2 two in ten thousand."""
_FINE: Final = 1.5
"""Pixels of the depth image that points stand apart."""


class Eye(NamedTuple):
    """A camera at a place, as the kernels want it.

    Attributes
    ----------
    kind : int
    lens : ndarray, shape (lenses.SIZE,)
    mat_cam_local : ndarray, shape (3, 3)
    place_m : ndarray, shape (3,)
        Projection centre in the local frame.
    size_px : ndarray of int64, shape (2,)
        Width and height.
    """

    kind: int
    lens: Array
    mat_cam_local: Array
    place_m: Array
    size_px: npt.NDArray[np.int64]


class Seen(NamedTuple):
    """Points in the picture.

    Attributes
    ----------
    number : ndarray of int64, shape (k,)
        Which points.
    pixel : ndarray of float32, shape (k, 2)
    range_m : ndarray of float32, shape (k,)
        From the projection centre.
    """

    number: npt.NDArray[np.int64]
    pixel: npt.NDArray[np.float32]
    range_m: npt.NDArray[np.float32]


def project(eye: Eye, xyz_m: npt.NDArray[Any]) -> Seen:
    """Local points, shape (n, 3), in the picture, whether hidden or not."""
    number = np.empty(len(xyz_m), np.int64)
    pixel, range_m = np.empty((len(xyz_m), 2), np.float32), np.empty(len(xyz_m), np.float32)
    count = _project(eye, xyz_m, number, pixel, range_m)
    return Seen(number[:count], pixel[:count], range_m[:count])


class Surface(NamedTuple):
    """What is known of the surface about each of some points.

    Attributes
    ----------
    xyz_m : ndarray of float32, shape (n, 3)
    spacing_m : ndarray of float32, shape (n,)
        Distance to the neighbours.
    normal : ndarray of float16, shape (n, 3)
        Of length 1 where it points outwards, 1/2 where nobody knows which side that is, 0 where there is no plane.
    rough_m : ndarray of float16, shape (n,)
        Standard deviation across the plane.
    """

    xyz_m: npt.NDArray[np.float32]
    spacing_m: npt.NDArray[np.float32]
    normal: npt.NDArray[np.float32]
    rough_m: npt.NDArray[np.float32]


class Depths:
    """The depth image of a picture.

    Parameters
    ----------
    eye : Eye
    focal_px : float
    spacing_m, range_m : float
        How far points stand apart, and how far they are, usually: a coarser picture than its pixels will do where the points are coarse.
    """

    def __init__(self, eye: Eye, focal_px: float, spacing_m: float, range_m: float) -> None:
        apart_px = focal_px * spacing_m / max(range_m, 0.1)
        self._scale = min(1.0, _FINE / max(apart_px, 1e-6))
        self._focal = focal_px * self._scale
        width, height = (int(np.ceil(side * self._scale)) + 1 for side in eye.size_px)
        self.nearest = np.full((height, width), np.inf, np.float32)
        """Distance to the nearest point for each of its pixels [m]; infinite where there is none."""

    def at(self, pixel: Array) -> npt.NDArray[np.float32]:
        """The distance to the nearest point at pixels of the picture, shape (n, 2)."""
        row, column = ((pixel[:, axis] + 0.5) * self._scale for axis in (1, 0))
        height, width = self.nearest.shape
        places = np.clip(row, 0, height - 1).astype(np.intp), np.clip(column, 0, width - 1).astype(np.intp)
        return np.asarray(self.nearest[places])

    def add(self, seen: Seen, spacing_m: npt.NDArray[np.float32]) -> None:
        """Take points, with the distances to their neighbours, shape (k,)."""
        _splat(seen.pixel, seen.range_m, spacing_m, self._focal, self._scale, self.nearest)

    def sees(self, seen: Seen, surface: Surface, place_m: Array) -> npt.NDArray[np.bool_]:
        """Which of some points nothing hides, shape (k,).

        Parameters
        ----------
        seen : Seen
        surface : Surface
            Of all points that `seen` numbers.
        place_m : ndarray, shape (3,)
            Projection centre in the frame of their coordinates.
        """
        out = np.empty(len(seen.number), np.bool_)
        _sees(seen, surface, place_m, (self._scale, self._focal), self.nearest, out)
        return out


@njit(cache=True, nogil=True)
def _project(eye: Any, xyz: Any, number: Any, pixel: Any, ranges: Any) -> int:
    count = 0
    ray, place = np.empty(3), np.empty(2)
    mat, at = eye.mat_cam_local, eye.place_m
    right, down = eye.size_px[0] - 0.5, eye.size_px[1] - 0.5
    for i in range(len(xyz)):
        x, y, z = xyz[i, 0] - at[0], xyz[i, 1] - at[1], xyz[i, 2] - at[2]
        for row in range(3):
            ray[row] = mat[row, 0] * x + mat[row, 1] * y + mat[row, 2] * z
        if projected(eye.kind, eye.lens, ray, place) and -0.5 <= place[0] <= right and -0.5 <= place[1] <= down:
            number[count] = i
            pixel[count, 0], pixel[count, 1] = place[0], place[1]
            ranges[count] = np.sqrt(x * x + y * y + z * z)
            count += 1
    return count


@njit(cache=True, nogil=True)
def _splat(pixel: Any, ranges: Any, spacing: Any, focal: float, scale: float, nearest: Any) -> None:
    height, width = nearest.shape
    for i in range(len(ranges)):
        radius = min(_REACH * spacing[i] * focal / ranges[i], WIDEST_PX)
        u, v = (pixel[i, 0] + 0.5) * scale, (pixel[i, 1] + 0.5) * scale
        left, right = max(0, int(u - radius)), min(width - 1, int(u + radius))
        top, bottom = max(0, int(v - radius)), min(height - 1, int(v + radius))
        square = radius * radius
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                du, dv = column + 0.5 - u, row + 0.5 - v
                own = row == int(v) and column == int(u)
                if (own or du * du + dv * dv <= square) and ranges[i] < nearest[row, column]:
                    nearest[row, column] = ranges[i]


@njit(cache=True, nogil=True)
def _sees(seen: Any, surface: Any, place: Any, scales: Any, nearest: Any, out: Any) -> None:
    scale, focal = scales
    for i in range(len(seen.range_m)):
        point, distance = seen.number[i], seen.range_m[i]
        row, column = int((seen.pixel[i, 1] + 0.5) * scale), int((seen.pixel[i, 0] + 0.5) * scale)
        behind = distance - nearest[row, column]
        aside = _REACH * surface.spacing_m[point] + distance / focal  # of the nearest one from this one, at most
        out[i] = behind <= TOLERANCE * distance + _slack(surface, point, place, distance, aside)


@njit(cache=True, nogil=True)
def _slack(surface: Any, point: int, place: Any, distance: float, aside: float) -> float:
    """How far behind the nearest one of its pixel a seen point may be [m]; below 0 where it cannot be seen."""
    cosine, square = 0.0, 0.0
    for axis in range(3):
        normal = np.float64(surface.normal[point, axis])
        cosine += normal * (place[axis] - surface.xyz_m[point, axis])
        square += normal * normal
    if square < 0.1:
        return ROUGH_M + 0.5 * aside
    cosine /= distance * np.sqrt(square)
    if square > 0.5 and cosine < 0.0 and cosine > -_STEEP:
        return -_DEEPEST_M
    across = PLANE_M + _NOISE * surface.rough_m[point] + aside * np.sqrt(max(0.0, 1.0 - cosine * cosine))
    return float(min(across / max(abs(cosine), _GRAZING), _DEEPEST_M))
