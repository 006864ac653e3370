"""Where the faces of banks run: lines half way up what is steep, found on a raster of the ground.

What is steep falls apart into faces. In each the line is drawn where the ground lies half way between the highest and the lowest around
it, as wide as the face is: a bank may fall along with its river.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import shapely
from contourpy import contour_generator
from scipy import ndimage

from groundproc.raster.grid import Window

Array = npt.NDArray[np.float64]
Raster = npt.NDArray[np.float32]

_WIDEST_M: Final = 40.0
"""Of a face: what is wider is a hillside."""
_GENTLER: Final = 0.6
"""Of the least slope: cells blur an edge."""
_BLUR: Final = 0.8
"""Cells, sigma of the smoothing before slopes are taken."""
_BEYOND: Final = 2
"""Cells around a face in which its line may run."""
_STANDS_M2: Final = 2500.0
"""What is no larger and falls off on all sides stands there: a house, a heap, a boulder."""
_JOIN: Final = 3.0
"""Cells between ends of lines that are one."""


@dataclass(frozen=True, slots=True)
class Axis:
    """A line along a face.

    Attributes
    ----------
    places_m : ndarray, shape (n, 2)
        At equal steps.
    downhill : ndarray, shape (n, 2)
        Unit vectors.
    width_m : float
        Of the face, about.
    """

    places_m: Array
    downhill: Array
    width_m: float


def halo_m() -> float:
    """Around a block that its lines are drawn from."""
    return 1.5 * _WIDEST_M


def lines_of(
    ground_m: Raster, window: Window, cell_m: float, least_drop_m: float, least_slope_rad: float
) -> list[tuple[Array, float]]:
    """Lines along faces, shape (n, 2) each, with the width of the face.

    Parameters
    ----------
    ground_m : ndarray of float32, shape (rows, columns)
        The first row in the north; NaN where it is not known.
    window : Window
        Its place in cells.
    cell_m, least_drop_m, least_slope_rad : float
    """
    known = np.isfinite(ground_m)
    if known.sum() < 9 or min(known.shape) < 3:
        return []
    smooth = _blurred(ground_m, known)
    down, right = np.gradient(smooth, cell_m)
    steep = (np.hypot(down, right) > _GENTLER * np.tan(min(least_slope_rad, np.deg2rad(80.0)))) & known
    face, count = ndimage.label(ndimage.binary_closing(steep, np.ones((3, 3), np.bool_)) & known, np.ones((3, 3)))
    x = (window.column + np.arange(ground_m.shape[1]) + 0.5) * cell_m
    y = (window.row + window.rows - np.arange(ground_m.shape[0]) - 0.5) * cell_m
    found: list[tuple[Array, float]] = []
    for number, where in enumerate(ndimage.find_objects(face, count), 1):
        inside = face[where] == number
        half = float(ndimage.distance_transform_edt(np.pad(inside, 1)).max())
        width_m = 2.0 * half * cell_m
        if width_m > _WIDEST_M or inside.sum() < 4:
            continue
        reach = int(np.ceil(1.5 * half)) + 1
        rows, columns = (slice(max(each.start - reach, 0), each.stop + reach) for each in where)
        part = np.where(known, smooth, np.nan)[rows, columns]
        top = ndimage.maximum_filter(np.where(np.isfinite(part), part, -np.inf), 2 * reach + 1)
        foot = ndimage.minimum_filter(np.where(np.isfinite(part), part, np.inf), 2 * reach + 1)
        of_face = face[rows, columns] == number
        if float((top - foot)[of_face].max()) < least_drop_m:
            continue
        if min(part.shape) < 2:
            continue
        # a little beyond the face: that of an upright one is a cell or two wide, and lines would be cut
        wide = ndimage.binary_dilation(of_face, iterations=_BEYOND) & np.isfinite(part)
        drawn = wide & (top - foot >= 0.5 * least_drop_m)
        off = np.full(part.shape, np.nan)
        off[drawn] = part[drawn] - (top[drawn] + foot[drawn]) / 2.0
        # from south to north, so that what is higher is on the left of the lines
        generator = contour_generator(x[columns], y[rows][::-1], np.ma.masked_invalid(off[::-1]), name="serial")
        found += [(np.asarray(line), width_m) for line in generator.lines(0.0) if len(line) > 1]
    return found


def _blurred(ground_m: Raster, known: npt.NDArray[np.bool_]) -> Raster:
    weight = ndimage.gaussian_filter(known.astype(np.float32), _BLUR)
    value = ndimage.gaussian_filter(np.where(known, ground_m, 0.0).astype(np.float32), _BLUR)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(known, value / weight, np.nan), np.float32)


def axes(
    lines: list[tuple[Array, float]], cell_m: float, step_m: float, shortest_m: float, alone: list[float] | None = None
) -> list[Axis]:
    """Pieces joined to axes with stations at equal steps, those long enough.

    Parameters
    ----------
    lines : list of tuple
        Shape (n, 2), and the width of the face.
    cell_m, step_m, shortest_m : float
    alone : list of float, optional
        Is given the area of what stands alone, such as houses, and is no bank; without it, it makes axes.
    """
    found = []
    for places, width_m in _joined(lines, _JOIN * cell_m):
        line = shapely.LineString(places)
        if line.length < shortest_m:
            continue
        fine = shapely.get_coordinates(line.interpolate(np.arange(0.0, line.length, cell_m / 2.0)))
        closed = bool(np.hypot(*(places[0] - places[-1])) < 2.0 * cell_m)
        around_m2 = _turned(places) if closed else 0.0
        if alone is not None and 0.0 < around_m2 < _STANDS_M2:
            alone.append(around_m2)
            continue
        smooth = ndimage.gaussian_filter1d(
            fine, 2.0 * max(width_m / 2.0, cell_m, step_m) / cell_m, axis=0, mode="wrap" if closed else "nearest"
        )
        line = shapely.LineString(smooth)
        at = np.arange(0.0, line.length, step_m)
        stations = shapely.get_coordinates(line.interpolate(at))
        ahead = shapely.get_coordinates(line.interpolate(np.minimum(at + step_m, line.length)))
        behind = shapely.get_coordinates(line.interpolate(np.maximum(at - step_m, 0.0)))
        way = ahead - behind
        way /= np.maximum(np.hypot(*way.T), 1e-9)[:, None]
        found.append(Axis(stations, np.stack([way[:, 1], -way[:, 0]], axis=1), width_m))
    return found


def _turned(places: Array) -> float:
    """Area within a closed line, above 0 where it has it on its left: there it is higher."""
    x, y = (places - places[0]).T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2.0


def _joined(lines: list[tuple[Array, float]], within_m: float) -> list[tuple[Array, float]]:
    """Lines put together where one ends and another begins."""
    left = sorted(lines, key=lambda each: -len(each[0]))
    out = []
    while left:
        places, width = left.pop(0)
        while True:
            ends = [(float(np.hypot(*(places[-1] - other[0]))), n, False) for n, (other, _) in enumerate(left)]
            ends += [(float(np.hypot(*(places[0] - other[-1]))), n, True) for n, (other, _) in enumerate(left)]
            nearest = min(ends, default=(np.inf, -1, False))
            if nearest[0] > within_m:
                break
            other, wide = left.pop(nearest[1])
            places = np.concatenate([other, places] if nearest[2] else [places, other])
            width = max(width, wide)
        out.append((places, width))
    return out
