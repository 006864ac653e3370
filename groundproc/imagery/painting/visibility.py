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

from groundproc.imagery.lenses import placed, unproject_all

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
_BEYOND: Final = 0.5
"""The same of a point that lies in no plane: as far as a thing goes on, on average, beyond the outermost of its points. It need reach no
neighbour, as gaps between them are closed; and what a leaf does not cover it does not hide."""
_CLOSED: Final = 1.7
"""Radius of the circles that fit into no gap, in spacings: with a disc's, points at random leave one gap in 300,000."""
_LOOSE: Final = 0.5
"""Of the circle's radius where leaves and edges are: light comes through what lies in no plane, but not between its neighbours."""
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


def project(eye: Eye, xyz_m: npt.NDArray[Any], spans: npt.NDArray[np.int64] | None = None) -> Seen:
    """Local points, shape (n, 3), in the picture, whether hidden or not; of spans (first and that after the last), shape (k, 2), or all."""
    spans = np.array([[0, len(xyz_m)]]) if spans is None else spans
    most = int((spans[:, 1] - spans[:, 0]).sum())
    number = np.empty(most, np.int64)
    pixel, range_m = np.empty((most, 2), np.float32), np.empty(most, np.float32)
    count = _project(eye, xyz_m, spans, number, pixel, range_m)
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
        self._near = np.zeros((height, width), np.float32)
        """One over the distance to the nearest point for each of its pixels [1/m]; 0 where there is none."""
        self._loose = np.zeros((height, width), np.float32)
        """The same of points that lie in no plane, until gaps are closed: between leaves there are gaps."""
        self._facing = np.zeros((height, width), np.float32)
        """Cosine of the angle between its ray and the normal of the plane there; 0 where nobody knows."""
        self._turning = _turning(eye) / self._scale

    @property
    def nearest(self) -> npt.NDArray[np.float32]:
        """Distance to the nearest point for each of its pixels [m]; infinite where there is none."""
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / self._near)

    def at(self, pixel: Array) -> npt.NDArray[np.float32]:
        """The distance to the nearest point at pixels of the picture, shape (n, 2)."""
        row, column = ((pixel[:, axis] + 0.5) * self._scale for axis in (1, 0))
        height, width = self._near.shape
        places = np.clip(row, 0, height - 1).astype(np.intp), np.clip(column, 0, width - 1).astype(np.intp)
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / self._near[places])

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
        depths = self._near, self._facing, self._loose
        _splat(seen, surface, place_m, (self._scale, self._focal), self._turning, depths)

    def close(self) -> None:
        """Close the gaps of surfaces, once all points are in; then lay over them what lies in no plane, and close finer gaps of all."""
        self._close(self._gap_px)
        if _lay_over(self._loose, self._near, self._facing):
            self._close(self._gap_px * _LOOSE)

    def _close(self, gap_px: float) -> None:
        radius = int(np.ceil(gap_px - 0.25))
        if radius < 1:
            return
        down, right = np.mgrid[-radius : radius + 1, -radius : radius + 1]
        circle = (np.hypot(down, right) <= gap_px + 0.25).astype(np.uint8)
        # beyond its sides the picture goes on as it ends there; else slopes would be lifted along them
        rim = 2 * radius
        near = cv2.copyMakeBorder(self._near, rim, rim, rim, rim, cv2.BORDER_REPLICATE)
        closed = np.asarray(cv2.morphologyEx(near, cv2.MORPH_CLOSE, circle))[rim:-rim, rim:-rim]
        np.maximum(self._near, closed, out=self._near)

    def sees(self, seen: Seen, surface: Surface, place_m: Array) -> Seen:
        """Those of some points that nothing hides; parameters as of `add`."""
        out = Seen(np.empty_like(seen.number), np.empty_like(seen.pixel), np.empty_like(seen.range_m))
        depths = self._near, self._facing
        count = _sees(seen, surface, place_m, (self._scale, self._focal), self._turning, depths, out)
        return Seen(out.number[:count], out.pixel[:count], out.range_m[:count])


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


# What a point is and where it is goes from one kernel to the next as tuples of numbers: arrays would be counted, at every call.


@njit(cache=True, nogil=True, inline="always")
def _turned(mat: Any, way: Any) -> tuple[float, float, float]:
    return (
        mat[0, 0] * way[0] + mat[0, 1] * way[1] + mat[0, 2] * way[2],
        mat[1, 0] * way[0] + mat[1, 1] * way[1] + mat[1, 2] * way[2],
        mat[2, 0] * way[0] + mat[2, 1] * way[1] + mat[2, 2] * way[2],
    )


@njit(cache=True, nogil=True, inline="always")
def _step(turning: Any, row: int, column: int, which: int) -> tuple[float, float, float]:
    """How the ray turns to the right (0) or down (1) at a node."""
    return turning[row, column, which, 0], turning[row, column, which, 1], turning[row, column, which, 2]


@njit(cache=True, nogil=True, inline="always")
def _triple(rows: Any, i: int) -> tuple[float, float, float]:
    return np.float64(rows[i, 0]), np.float64(rows[i, 1]), np.float64(rows[i, 2])


@njit(cache=True, nogil=True, inline="always")
def _way(xyz: Any, i: int, place: Any) -> tuple[float, float, float]:
    return xyz[i, 0] - place[0], xyz[i, 1] - place[1], xyz[i, 2] - place[2]


@njit(cache=True, nogil=True, inline="always")
def _dot(a: Any, b: Any) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@njit(cache=True, nogil=True, inline="always")
def _node(u: float, v: float, shape: Any) -> tuple[int, int]:
    """Row and column of the node that a place in a depth image is next to."""
    row, column = int(v / shape[0] * _NODES), int(u / shape[1] * _NODES)
    return min(max(row, 0), _NODES - 1), min(max(column, 0), _NODES - 1)


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _facing(normal: Any, way: Any, above: float, right: Any, below: Any) -> tuple[float, float, float, float, float]:
    """The plane of a point as rays meet it: cosine, its changes from pixel to pixel, distance across, and how long its normal is.

    The distance along the ray so many pixels to the right and below that of the point is
    across / (cosine + by_u right + by_v below). Of a point without a plane the normal has no length, and the others are no numbers.
    """
    length = np.sqrt(_dot(normal, normal))
    across = _dot(normal, way) / length
    cosine = across / np.sqrt(_dot(way, way))
    return cosine, _dot(normal, right) / length, _dot(normal, below) / length, across - above, length


@njit(cache=True, nogil=True, error_model="numpy")
def _project(eye: Any, xyz: Any, spans: Any, number: Any, pixel: Any, ranges: Any) -> int:
    count = 0
    mat, lens, kind, place = eye.mat_cam_local, eye.lens, eye.kind, eye.place_m
    right, down = eye.size_px[0] - 0.5, eye.size_px[1] - 0.5
    late = _turned(mat, (eye.row_m[0], eye.row_m[1], eye.row_m[2]))
    rolls, middle = _dot(late, late) > 0.0, 0.5 * (eye.size_px[1] - 1)
    for span in range(len(spans)):
        for i in range(spans[span, 0], spans[span, 1]):
            way = _way(xyz, i, place)
            ray = _turned(mat, way)
            reached, u, v = placed(kind, lens, ray[0], ray[1], ray[2])
            if rolls and reached:
                reached, u, v = _rolled((kind, lens), ray, late, middle, v)
            if reached and -0.5 <= u <= right and -0.5 <= v <= down:
                number[count] = i
                pixel[count, 0], pixel[count, 1] = u, v
                ranges[count] = np.sqrt(_dot(way, way))
                count += 1
    return count


@njit(cache=True, nogil=True)
def _rolled(camera: Any, ray: Any, late: Any, middle: float, v: float) -> tuple[bool, float, float]:
    """The pixel of a ray of the middle row as the camera has it that moves on until the pixel's own row; `v`: without moving."""
    kind, lens = camera
    reached, u = True, 0.0
    for _ in range(ROLLS):
        rows = min(max(v - middle, -middle - 1.0), middle + 1.0)
        reached, u, v = placed(kind, lens, ray[0] - rows * late[0], ray[1] - rows * late[1], ray[2] - rows * late[2])
        if not reached:
            break
    return reached, u, v


@njit(cache=True, nogil=True, error_model="numpy")
def _splat(seen: Any, surface: Any, place: Any, scales: Any, turning: Any, depths: Any) -> None:
    near, facing, loose = depths
    xyz, spacing, normals, above = surface.xyz_m, surface.spacing_m, surface.normal, surface.above_m
    number, pixel, ranges, shape = seen.number, seen.pixel, seen.range_m, near.shape
    scale, focal = scales
    for i in range(len(number)):
        point, inverse = number[i], 1.0 / np.float64(ranges[i])
        u, v = (pixel[i, 0] + 0.5) * scale, (pixel[i, 1] + 0.5) * scale
        reach = min(_REACH * spacing[point], WIDEST_PX / (focal * inverse))
        radius = reach * focal * inverse
        row, column = _node(u, v, shape)
        right, below = _step(turning, row, column, 0), _step(turning, row, column, 1)
        way = _way(xyz, point, place)
        plane = _facing(_triple(normals, point), way, np.float64(above[point]), right, below)
        if plane[4] > 0.3:
            shape_ = plane[0], plane[1], plane[2], reach
            _disc(shape_, (way, right, below), (u, v, radius), (inverse, plane[3]), near, facing)
        else:
            _round((u, v, radius * (_BEYOND / _REACH)), inverse, loose)


@njit(cache=True, nogil=True, inline="always")
def _sides(at: float, radius: float, size: int) -> tuple[int, int]:
    """First pixel about a place, and that after the last one."""
    return max(0, int(at - radius)), min(size, int(at + radius) + 1)


@njit(cache=True, nogil=True, inline="always")
def _round(at: Any, inverse: float, near: Any) -> None:
    """A disc that faces the camera, at least its own pixel."""
    u, v, radius = at
    top, bottom = _sides(v, radius, near.shape[0])
    left, beyond = _sides(u, radius, near.shape[1])
    for row in range(top, bottom):
        for column in range(left, beyond):
            du, dv = column + 0.5 - u, row + 0.5 - v
            inside = du * du + dv * dv <= radius * radius or (row == int(v) and column == int(u))
            if inside and inverse > near[row, column]:
                near[row, column] = inverse


@njit(cache=True, nogil=True)
def _lay_over(loose: Any, near: Any, facing: Any) -> bool:
    some = False
    for row in range(near.shape[0]):
        for column in range(near.shape[1]):
            if loose[row, column] > near[row, column]:
                near[row, column], facing[row, column], some = loose[row, column], 0.0, True
    return some


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _disc(plane: Any, ways: Any, at: Any, terms: Any, near: Any, facing: Any) -> None:
    """A disc in a plane, at least its own pixel.

    A ray meets the plane at 1 / w. It is inside where | ray / w - way | <= reach; times w that is
    | (inverse - w) way + du right + dv below |^2 - (reach w)^2 <= 0. As w is linear in du and dv, that is a polynomial of second degree.
    """
    u, v, radius = at
    inverse, across = terms
    w0, wu, wv = plane[0] / across, plane[1] / across, plane[2] / across
    row, column = int(v), int(u)
    du, dv = column + 0.5 - u, row + 0.5 - v
    w = w0 + du * wu + dv * wv
    # no more than its own pixel, and that is taken by something nearer: as most are where points are dense
    if radius <= 0.5 and inverse <= near[row, column] and not w > near[row, column]:
        return
    c, cu, cv, cuu, cuv, cvv = _rim(ways, inverse, (w0, wu, wv), plane[3] * plane[3])
    inside = c + du * (cu + du * cuu) + dv * (cv + du * cuv + dv * cvv) <= 0.0
    if inside and w > near[row, column]:
        near[row, column] = w
        facing[row, column] = abs(w * across)
    elif inverse > near[row, column] and not (
        inside and w > 0.0
    ):  # else it has been laid, farther than the point or not
        near[row, column] = inverse
        facing[row, column] = abs(w * across)
    if radius > 0.5:
        _spread((w0, wu, wv, across), (c, cu, cv, cuu, cuv, cvv), at, near, facing)


@njit(cache=True, nogil=True, inline="always")
def _spread(plane: Any, rim: Any, at: Any, near: Any, facing: Any) -> None:
    """The pixels that lie inside of a disc."""
    w0, wu, wv, across = plane
    c, cu, cv, cuu, cuv, cvv = rim
    u, v, radius = at
    top, bottom = _sides(v, radius, near.shape[0])
    left, beyond = _sides(u, radius, near.shape[1])
    for row in range(top, bottom):
        dv = row + 0.5 - v
        start, slope, first = c + dv * (cv + dv * cvv), cu + dv * cuv, w0 + dv * wv
        for column in range(left, beyond):
            du = column + 0.5 - u
            w = first + du * wu
            if (w > near[row, column]) & (start + du * (slope + du * cuu) <= 0.0):
                near[row, column] = w
                facing[row, column] = abs(w * across)


@njit(cache=True, nogil=True, inline="always")
def _rim(ways: Any, inverse: float, w: Any, square: float) -> tuple[float, float, float, float, float, float]:
    """The polynomial that is 0 at the rim of a disc: constant, du, dv, du du, du dv, dv dv."""
    way, right, below = ways
    s, ww, wu, wv = inverse - w[0], _dot(way, way), _dot(way, right), _dot(way, below)
    # the vector is s way + du (right - w[1] way) + dv (below - w[2] way)
    along_u, along_v = wu - w[1] * ww, wv - w[2] * ww
    uu = _dot(right, right) - w[1] * (wu + along_u)
    uv = _dot(right, below) - w[2] * wu - w[1] * along_v
    vv = _dot(below, below) - w[2] * (wv + along_v)
    return (
        s * s * ww - square * w[0] * w[0], 2.0 * (s * along_u - square * w[0] * w[1]), 2.0 * (s * along_v - square * w[0] * w[2]),
        uu - square * w[1] * w[1], 2.0 * (uv - square * w[1] * w[2]), vv - square * w[2] * w[2],
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _sees(seen: Any, surface: Any, place: Any, scales: Any, turning: Any, depths: Any, out: Any) -> int:
    nearest, facing = depths
    xyz, spacing, normals, above, rough = (
        surface.xyz_m,
        surface.spacing_m,
        surface.normal,
        surface.above_m,
        surface.rough_m,
    )
    number, pixel, ranges, shape = seen.number, seen.pixel, seen.range_m, nearest.shape
    out_number, out_pixel, out_range = out.number, out.pixel, out.range_m
    scale, focal = scales
    count = 0
    for i in range(len(number)):
        point, distance = number[i], np.float64(ranges[i])
        u, v = (pixel[i, 0] + 0.5) * scale, (pixel[i, 1] + 0.5) * scale
        row, column = _node(u, v, shape)
        right, below = _step(turning, row, column, 0), _step(turning, row, column, 1)
        plane = _facing(_triple(normals, point), _way(xyz, point, place), np.float64(above[point]), right, below)
        row, column = int(v), int(u)
        pixel_ = 1.0 / np.float64(nearest[row, column]), np.float64(facing[row, column])
        sizes = _REACH * spacing[point], distance / focal, np.float64(rough[point])
        if _clear(plane, distance, (column + 0.5 - u, row + 0.5 - v), pixel_, sizes):
            out_number[count], out_range[count] = point, ranges[i]
            out_pixel[count, 0], out_pixel[count, 1] = pixel[i, 0], pixel[i, 1]
            count += 1
    return count


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _clear(plane: Any, distance: float, off: Any, pixel: Any, sizes: Any) -> bool:
    """Whether nothing hides a point: its plane, how far the middle of its pixel is off, depth and cosine there, and its sizes."""
    near, facing = pixel
    reach, pixel_m, rough_m = sizes
    if not plane[4] > 0.3:
        return bool(distance - near <= ROUGH_M + 0.5 * (reach + pixel_m))  # of the nearest one from this one, at most
    if plane[4] > 0.7 and 0.0 < plane[0] < _STEEP:
        return False
    cosine = plane[0] + off[0] * plane[1] + off[1] * plane[2]
    far = plane[3] / cosine if abs(cosine) >= _GRAZING else distance
    far = min(max(far, distance - reach), distance + reach)  # farther along the plane there may be no surface
    # neither may lie off the other's plane: an eave is near the plane of the wall below it, not so the wall
    across = max(abs(cosine), facing, _GRAZING)
    slack = PLANE_M + _NOISE * rough_m
    return bool(far - near <= min(slack / across, _DEEPEST_M))
