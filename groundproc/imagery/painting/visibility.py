"""Which points an image sees: a depth for each pixel, from discs that lie in the surface, and who stands behind it.

Each point is a small disc in the plane of its neighbours, so that a roof ends where its points end and a wall seen from above has next to
no width. Points lie anyhow, and through one gap in a hundred between such discs what is behind would show: gaps are closed by
morphological closing of the depths (of their inverse), which fills what no circle of its size fits into, and takes nothing beyond an edge.

A point is seen if its own plane, along the ray in the middle of its pixel, is as near as that pixel's depth. So the tolerance is one
across the plane, that of its noise, however grazing the view. One that turns its back is not seen at all, though its edge is as near as
the roof that hides it.
"""

from typing import Any, Final, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.imagery.lenses import projected, unproject_all

Array = npt.NDArray[np.float64]

ROUGH_M: Final = 0.1
"""By which a seen point may be behind the nearest one of its pixel where there is no plane [m]: leaves, edges."""
PLANE_M: Final = 0.02
"""The same across a plane, on top of its roughness."""
_NOISE: Final = 3.5
"""Roughnesses that a plane may be off where points are few."""
_DEEPEST_M: Final = 0.3
"""What noise may come to along a ray, however grazing: an eave is so much nearer than the wall that it hides."""
_GRAZING: Final = 0.02
_STEEP: Final = 0.5
"""Cosine of the angle to the normal above which a plane that should show its back is taken for a ceiling: seen from below."""
WIDEST_PX: Final = 6
"""Radius of a disc in the depth image [px of it]: of a lone point near the camera."""
_REACH: Final = 0.85
"""Radius of a disc in spacings: over the half that points keep from an edge, on average."""
_CLOSED: Final = 1.7
"""Radius of the circles that fit into no gap, in spacings: with a disc's, points at random leave one gap in 300,000."""
_FINE: Final = 1.7
"""Pixels of the depth image that points stand apart."""
ROLLS: Final = 3
"""Times that a pixel's row is looked up for a rolling shutter: each takes what is left by a hundredth or so."""
_NODES: Final = 32
"""Places along each side of a picture at which the directions of its rays are known."""


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
    row_m : ndarray, shape (3,)
        By which it moves from row to row of a rolling shutter; `place_m` is the middle row's.
    """

    kind: int
    lens: Array
    mat_cam_local: Array
    place_m: Array
    size_px: npt.NDArray[np.int64]
    row_m: Array


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
    normal : ndarray of float32, shape (n, 3)
        Of length 1 where it points outwards, 1/2 where nobody knows which side that is, 0 where there is no plane.
    rough_m : ndarray of float32, shape (n,)
        Standard deviation across the plane.
    above_m : ndarray of float32, shape (n,)
        How far the point lies off its plane, along the normal.
    """

    xyz_m: npt.NDArray[np.float32]
    spacing_m: npt.NDArray[np.float32]
    normal: npt.NDArray[np.float32]
    rough_m: npt.NDArray[np.float32]
    above_m: npt.NDArray[np.float32]


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
        self._gap_px = _CLOSED * apart_px * self._scale
        width, height = (int(np.ceil(side * self._scale)) + 1 for side in eye.size_px)
        self.nearest = np.full((height, width), np.inf, np.float32)
        """Distance to the nearest point for each of its pixels [m]; infinite where there is none."""
        self._facing = np.zeros((height, width), np.float32)
        """Cosine of the angle between its ray and the normal of the plane there; 0 where nobody knows."""
        self._turning = _turning(eye) / self._scale

    def at(self, pixel: Array) -> npt.NDArray[np.float32]:
        """The distance to the nearest point at pixels of the picture, shape (n, 2)."""
        row, column = ((pixel[:, axis] + 0.5) * self._scale for axis in (1, 0))
        height, width = self.nearest.shape
        places = np.clip(row, 0, height - 1).astype(np.intp), np.clip(column, 0, width - 1).astype(np.intp)
        return np.asarray(self.nearest[places])

    def add(self, seen: Seen, surface: Surface, place_m: Array) -> None:
        """Take points.

        Parameters
        ----------
        seen : Seen
        surface : Surface
            Of all points that `seen` numbers.
        place_m : ndarray, shape (3,)
            Projection centre in the frame of their coordinates.
        """
        _splat(seen, surface, place_m, (self._scale, self._focal), self._turning, (self.nearest, self._facing))

    def close(self) -> None:
        """Close the gaps between all points, once they are in."""
        radius = int(np.ceil(self._gap_px - 0.25))
        if radius < 1:
            return
        down, right = np.mgrid[-radius : radius + 1, -radius : radius + 1]
        circle = (np.hypot(down, right) <= self._gap_px + 0.25).astype(np.uint8)
        with np.errstate(divide="ignore"):
            # beyond its sides the picture goes on as it ends there; else slopes would be lifted along them
            rim = 2 * radius
            near = np.asarray(cv2.copyMakeBorder(1.0 / self.nearest, rim, rim, rim, rim, cv2.BORDER_REPLICATE))
            closed = np.asarray(cv2.morphologyEx(near, cv2.MORPH_CLOSE, circle))[rim:-rim, rim:-rim]
            self.nearest = np.minimum(self.nearest, 1.0 / closed)

    def sees(self, seen: Seen, surface: Surface, place_m: Array) -> npt.NDArray[np.bool_]:
        """Which of some points nothing hides, shape (k,); parameters as of `add`."""
        out = np.empty(len(seen.number), np.bool_)
        _sees(seen, surface, place_m, (self._scale, self._focal), self._turning, (self.nearest, self._facing), out)
        return out


def _turning(eye: Eye) -> Array:
    """How rays turn from pixel to pixel, to the right and down, at nodes over the picture, shape (nodes, nodes, 2, 3), in the local frame.

    0 where the lens does not reach.
    """
    across, down = ((np.arange(_NODES) + 0.5) / _NODES * side - 0.5 for side in eye.size_px)
    u, v = np.meshgrid(across, down)
    rays = []
    for right, below in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        pixels = np.stack([u.ravel() + right, v.ravel() + below], axis=1)
        ray, reached = np.empty((len(pixels), 3)), np.empty(len(pixels), np.bool_)
        unproject_all(eye.kind, eye.lens, pixels, ray, reached)
        ray[~reached] = np.nan
        rays.append(ray)
    steps = np.stack([0.5 * (rays[0] - rays[1]), 0.5 * (rays[2] - rays[3])], axis=1)
    found = np.nan_to_num(steps) @ eye.mat_cam_local
    return np.ascontiguousarray(found.reshape(_NODES, _NODES, 2, 3))


@njit(cache=True, nogil=True)
def _project(eye: Any, xyz: Any, number: Any, pixel: Any, ranges: Any) -> int:
    count = 0
    ray, place = np.empty(3), np.empty(2)
    mat, at = eye.mat_cam_local, eye.place_m
    right, down = eye.size_px[0] - 0.5, eye.size_px[1] - 0.5
    late = mat @ eye.row_m
    rolls, middle = (eye.row_m != 0.0).any(), 0.5 * (eye.size_px[1] - 1)
    for i in range(len(xyz)):
        x, y, z = xyz[i, 0] - at[0], xyz[i, 1] - at[1], xyz[i, 2] - at[2]
        for row in range(3):
            ray[row] = mat[row, 0] * x + mat[row, 1] * y + mat[row, 2] * z
        reached = projected(eye.kind, eye.lens, ray, place)
        if rolls and reached:
            reached = _rolled(eye, ray, late, middle, place)
        if reached and -0.5 <= place[0] <= right and -0.5 <= place[1] <= down:
            number[count] = i
            pixel[count, 0], pixel[count, 1] = place[0], place[1]
            ranges[count] = np.sqrt(x * x + y * y + z * z)
            count += 1
    return count


@njit(cache=True, nogil=True)
def _rolled(eye: Any, ray: Any, late: Any, middle: float, place: Any) -> bool:
    """The pixel of a ray of the middle row as the camera has it that moves on until the pixel's own row."""
    own, reached = np.empty(3), True
    for _ in range(ROLLS):
        rows = min(max(place[1] - middle, -middle - 1.0), middle + 1.0)
        for axis in range(3):
            own[axis] = ray[axis] - rows * late[axis]
        reached = projected(eye.kind, eye.lens, own, place)
        if not reached:
            break
    return reached


@njit(cache=True, nogil=True)
def _node(pixel: Any, scale: float, nearest: Any) -> tuple[int, int]:
    """Row and column of the node that a pixel is next to."""
    row = int((pixel[1] + 0.5) * scale / nearest.shape[0] * _NODES)
    column = int((pixel[0] + 0.5) * scale / nearest.shape[1] * _NODES)
    return min(max(row, 0), _NODES - 1), min(max(column, 0), _NODES - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _facing(surface: Any, point: int, place: Any, turning: Any, out: Any) -> bool:
    """The plane of a point as rays meet it: cosine, its changes from pixel to pixel, distance across; False where it has none.

    The distance along the ray so many pixels to the right and below that of the point is
    out[3] / (out[0] + out[1] right + out[2] below). out[4:7] is the way to the point.
    """
    square = 0.0
    out[:4] = 0.0
    for axis in range(3):
        normal = np.float64(surface.normal[point, axis])
        way = surface.xyz_m[point, axis] - place[axis]
        square += normal * normal
        out[0] += normal * way
        out[1] += normal * turning[0, axis]
        out[2] += normal * turning[1, axis]
        out[4 + axis] = way
    if square < 0.1:
        return False
    length = np.sqrt(square)
    distance = np.sqrt(out[4] ** 2 + out[5] ** 2 + out[6] ** 2)
    out[3] = out[0] / length - surface.above_m[point]
    out[0] /= length * distance
    out[1] /= length
    out[2] /= length
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _splat(seen: Any, surface: Any, place: Any, scales: Any, turning: Any, depths: Any) -> None:
    nearest, facing = depths
    height, width = nearest.shape
    scale, focal = scales
    plane = np.empty(7)
    for i in range(len(seen.number)):
        point, distance = seen.number[i], float(seen.range_m[i])
        reach = min(_REACH * surface.spacing_m[point], WIDEST_PX * distance / focal)
        radius, inverse = reach * focal / distance, 1.0 / distance
        u, v = (seen.pixel[i, 0] + 0.5) * scale, (seen.pixel[i, 1] + 0.5) * scale
        down, across = _node(seen.pixel[i], scale, nearest)
        turn = turning[down, across]
        flat = _facing(surface, point, place, turn, plane)
        left, right = max(0, int(u - radius)), min(width - 1, int(u + radius))
        top, bottom = max(0, int(v - radius)), min(height - 1, int(v + radius))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                du, dv = column + 0.5 - u, row + 0.5 - v
                far, cosine = distance, 0.0
                if flat:
                    cosine = plane[0] + du * plane[1] + dv * plane[2]
                    far = plane[3] / cosine
                    own = row == int(v) and column == int(u)
                    if not own and not far < nearest[row, column]:
                        continue
                    off = 0.0
                    for axis in range(3):
                        ray = plane[4 + axis] * inverse + du * turn[0, axis] + dv * turn[1, axis]
                        off += (far * ray - plane[4 + axis]) ** 2
                    inside = off <= reach * reach
                else:
                    inside = du * du + dv * dv <= radius * radius
                if not inside:
                    if row != int(v) or column != int(u):
                        continue
                    far = distance
                if far < nearest[row, column]:
                    nearest[row, column], facing[row, column] = far, abs(cosine)


@njit(cache=True, nogil=True, error_model="numpy")
def _sees(seen: Any, surface: Any, place: Any, scales: Any, turning: Any, depths: Any, out: Any) -> None:
    nearest, facing = depths
    scale, focal = scales
    plane = np.empty(7)
    for i in range(len(seen.range_m)):
        point, distance = seen.number[i], np.float64(seen.range_m[i])
        u, v = (seen.pixel[i, 0] + 0.5) * scale, (seen.pixel[i, 1] + 0.5) * scale
        row, column = int(v), int(u)
        down, across = _node(seen.pixel[i], scale, nearest)
        near = np.float64(nearest[row, column])
        if not _facing(surface, point, place, turning[down, across], plane):
            aside = _REACH * surface.spacing_m[point] + distance / focal  # of the nearest one from this one, at most
            out[i] = distance - near <= ROUGH_M + 0.5 * aside
            continue
        known = _length2(surface, point) > 0.5
        if known and 0.0 < plane[0] < _STEEP:
            out[i] = False
            continue
        reach = _REACH * surface.spacing_m[point]
        cosine = plane[0] + (column + 0.5 - u) * plane[1] + (row + 0.5 - v) * plane[2]
        far = plane[3] / cosine if abs(cosine) >= _GRAZING else distance
        far = min(max(far, distance - reach), distance + reach)  # farther along the plane there may be no surface
        # neither may lie off the other's plane: an eave is near the plane of the wall below it, not so the wall
        across = max(abs(cosine), np.float64(facing[row, column]), _GRAZING)
        slack = PLANE_M + _NOISE * surface.rough_m[point]
        out[i] = far - near <= min(slack / across, _DEEPEST_M)


@njit(cache=True, nogil=True)
def _length2(surface: Any, point: int) -> float:
    """Square of the length of a point's normal."""
    x, y, z = surface.normal[point, 0], surface.normal[point, 1], surface.normal[point, 2]
    return float(x * x + y * y + z * z)
