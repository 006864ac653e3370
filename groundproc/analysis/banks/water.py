"""The line of the water: where the land beside it goes under, at a level that is given, or told by class 9, by echoes or by their lack.

Water lies level. What is flat and lower than all around is water where it sends echoes; where it sends none, the last points of the land
along it lie at one height. Either way a level is found first, with its sigma, and then at each station where the slope of the land
meets it.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from groundproc.numerics.robust import sigma as robust_sigma
from groundproc.raster.grid import Window

Array = npt.NDArray[np.float64]
Raster = npt.NDArray[np.float32]

LEAST_AREA_M2: Final = 25.0
_LEVEL: Final = 0.01
"""Slope of what may be water."""
_FALL: Final = 0.003
"""Prior of the slope of a river, one sigma."""
_RISES: Final = 0.03
"""Slope of the land beside it, at least: else its line is nowhere."""
_BESIDE_M: Final = 4.0
"""The land is looked at so far from the water."""
_SAME_M: Final = 0.06
"""The last points along a shore scatter about its level by that, at most."""
_SHARES: Final = (0.25, 0.5, 1.0)
"""Of the land that may count, by height: from the lowest on."""
_LEAST_HIGH_M: Final = 0.1
_ALIKE: Final = 2.0
"""More land goes on alike where the line stays within so many sigmas."""
_SHARE: Final = 0.4
"""Of the rim of what is taken for water that has land which rises."""


@dataclass(frozen=True, slots=True)
class Level:
    """A surface of water: z = height + east (x - x0) + north (y - y0).

    Attributes
    ----------
    origin_m : ndarray, shape (2,)
    plane : ndarray, shape (3,)
        Height at the origin, slopes eastwards and northwards.
    sigma_m : float
        Of the height.
    told_by : str
        given, class 9, echoes, or lack of echoes.
    """

    origin_m: Array
    plane: Array
    sigma_m: float
    told_by: str

    def at(self, xy_m: Array) -> Array:
        """Height at places, shape (n, 2) -> (n,)."""
        return np.asarray(self.plane[0] + (xy_m - self.origin_m) @ self.plane[1:])


def given(height_m: float) -> Level:
    """A level that the user states."""
    return Level(np.zeros(2), np.array([height_m, 0.0, 0.0]), 0.0, "given")


def level_of(xyz_m: Array, told_by: str, extra_m: float = 0.0) -> Level:
    """The level of points on water, shape (n, 3): a plane that is nearly level, robustly; `extra_m` is what all of them may be off by."""
    origin = xyz_m[:, :2].mean(axis=0)
    design = np.column_stack([np.ones(len(xyz_m)), xyz_m[:, :2] - origin])
    z, weight = xyz_m[:, 2], np.ones(len(xyz_m))
    plane = np.array([float(np.median(z)), 0.0, 0.0])
    scatter = 0.01
    for _ in range(8):
        off = z - design @ plane
        scatter = max(robust_sigma(off), 1e-3)
        weight = 1.0 / (1.0 + (off / (2.0 * scatter)) ** 2)
        prior = np.diag([0.0, (scatter / _FALL) ** 2, (scatter / _FALL) ** 2])
        normal = (design * weight[:, None]).T @ design + prior
        plane = np.linalg.solve(normal, (design * weight[:, None]).T @ z)
    # echoes of one metre err together
    metres = len(np.unique(np.floor(xyz_m[:, :2]).astype(np.int64), axis=0))
    return Level(origin, plane, float(np.hypot(scatter / np.sqrt(metres), extra_m)), told_by)


def find(lowest_m: Raster, window: Window, cell_m: float) -> list[tuple[Level, npt.NDArray[np.bool_]]]:
    """Levels of waters in a window, each with its cells, shape (rows, columns).

    Parameters
    ----------
    lowest_m : ndarray of float32, shape (rows, columns)
        Lowest point of each cell, the first row in the north; NaN without any.
    window : Window
    cell_m : float
    """
    known = np.isfinite(lowest_m)
    if known.sum() < 9:
        return []
    x = np.asarray((window.column + np.arange(lowest_m.shape[1]) + 0.5) * cell_m, np.float64)
    y = np.asarray((window.row + window.rows - np.arange(lowest_m.shape[0]) - 0.5) * cell_m, np.float64)
    wet, silent = _flat(lowest_m, known, cell_m), void(known, cell_m)
    found = []
    for mask, told_by in ((wet, "echoes"), (silent, "lack of echoes")):
        body, count = ndimage.label(mask)
        for number, where in enumerate(ndimage.find_objects(body, count), 1):
            inside = body == number
            if inside[where].sum() * cell_m**2 < LEAST_AREA_M2:
                continue
            level = _level(inside, lowest_m, known, (x, y, cell_m), told_by)
            if level is not None:
                found.append((level, inside))
    return found


def _flat(lowest_m: Raster, known: npt.NDArray[np.bool_], cell_m: float) -> npt.NDArray[np.bool_]:
    """Cells in the midst of what is level over some metres."""
    if min(known.shape) < 2:
        return np.zeros(known.shape, np.bool_)
    size = 2 * max(round(1.5 / cell_m), 1) + 1
    share = ndimage.uniform_filter(known.astype(np.float32), size)
    height = np.where(known, lowest_m, 0.0).astype(np.float64)
    mean = ndimage.uniform_filter(height, size) / np.maximum(share, 1e-6)
    down, right = np.gradient(mean, cell_m)
    level = (share > 0.02) & (np.hypot(down, right) < _LEVEL)
    return np.asarray(ndimage.binary_opening(level, np.ones((3, 3), np.bool_)) & (share > 0.02))


def void(known: npt.NDArray[np.bool_], cell_m: float) -> npt.NDArray[np.bool_]:
    """Where nothing answered: larger than gaps between points, within the window or at its edge."""
    gap = max(round(1.0 / cell_m), 1)
    return np.asarray(
        ndimage.binary_opening(
            ~ndimage.binary_closing(np.pad(known, gap), iterations=gap)[gap:-gap, gap:-gap], iterations=gap
        )
    )


def _level(
    inside: npt.NDArray[np.bool_],
    lowest_m: Raster,
    known: npt.NDArray[np.bool_],
    frame: tuple[Array, Array, float],
    told_by: str,
) -> Level | None:
    """The level of what may be water; None where the land along it does not rise, or its rim is not level."""
    x, y, cell_m = frame
    away = max(round(_BESIDE_M / cell_m), 2)
    beside = ndimage.binary_dilation(inside, iterations=away) & ~ndimage.binary_dilation(inside, iterations=away - 1)
    rows, columns = np.nonzero(beside & known)
    last = inside if told_by == "echoes" else _last(inside, known)
    shore, low = _nearest(last, lowest_m, (rows, columns))
    if not len(shore):
        return None
    rises = lowest_m[rows, columns] - low > _RISES * _BESIDE_M
    if rises.mean() < _SHARE:
        return None
    if told_by == "echoes":
        at = np.nonzero(inside & known)
        return level_of(np.column_stack([x[at[1]], y[at[0]], lowest_m[at]]), told_by)
    pick = np.unique(shore[rises], axis=0)
    places = np.column_stack([x[pick[:, 1]], y[pick[:, 0]], lowest_m[pick[:, 0], pick[:, 1]]])
    if len(places) < 5:
        return None
    rise = float(np.median((lowest_m[rows, columns] - low)[rises])) / _BESIDE_M
    level = level_of(places, told_by, rise * cell_m / 2.0)
    return level if robust_sigma(places[:, 2] - level.at(places[:, :2])) < max(_SAME_M, rise * cell_m) else None


def _last(inside: npt.NDArray[np.bool_], known: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """The last cells of the land towards where nothing answers: the nearest ones from its edge."""
    edge = np.nonzero(inside & ~ndimage.binary_erosion(inside))
    index = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    out = np.zeros_like(known)
    out[index[0][edge], index[1][edge]] = True
    return out


def _nearest(
    among: npt.NDArray[np.bool_], lowest_m: Raster, cells: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]
) -> tuple[npt.NDArray[np.int64], Array]:
    """The nearest known cell of some for each of others, and its height."""
    target = among & np.isfinite(lowest_m)
    if not target.any() or not len(cells[0]):
        return np.empty((0, 2), np.int64), np.empty(0)
    index = ndimage.distance_transform_edt(~target, return_distances=False, return_indices=True)
    rows, columns = index[0][cells], index[1][cells]
    return np.column_stack([rows, columns]), np.asarray(lowest_m[rows, columns], np.float64)


def crossing(
    s: Array, z: Array, level_m: float, sigma_level_m: float, between_m: tuple[float, float]
) -> tuple[float, float] | None:
    """Where the land of a profile meets the water, and its sigma; None where it does not rise.

    The slope is that of the lowest land, and of as much above it as goes on alike: behind a beach a bank may stand.

    Parameters
    ----------
    s, z : ndarray, shape (n,)
        Ways uphill from about the line, and heights.
    level_m, sigma_level_m : float
    between_m : tuple of float
        Heights above the level of the land that may count.
    """
    above, best = z - level_m, None
    for share in _SHARES:
        found = _sloping(s, above, (between_m[0], max(share * between_m[1], between_m[0] + _LEAST_HIGH_M)))
        if found is None:
            continue
        at, unsure = found[0], found[2] / found[1]
        if best is not None and (unsure > best[1] or abs(at - best[0]) > _ALIKE * best[1]):
            break
        best = at, unsure, found[1]
    return None if best is None else (best[0], float(np.hypot(best[1], sigma_level_m / best[2])))


def _sloping(s: Array, above: Array, between_m: tuple[float, float]) -> tuple[float, float, float] | None:
    """The line of the land between two heights: where it is 0, its slope, and its sigma in height there."""
    some = (above > between_m[0]) & (above < between_m[1])
    found = None
    for _ in range(4):
        some &= _unbroken(s, some)
        found = _line(s[some], above[some])
        if found is None or found[1] < _RISES:
            return None
        # by the line and not by the points: what noise lifts above the lower limit would tilt it
        by_line = found[1] * (s - found[0])
        some = (by_line > between_m[0]) & (by_line < between_m[1])
    return found


def _unbroken(s: Array, some: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Points up to the first gap of a metre: what rises behind is another slope."""
    way = np.sort(s[some])
    gap = np.flatnonzero(np.diff(way) > 1.0)
    return np.asarray(s <= way[gap[0]]) if len(gap) else np.ones(len(s), np.bool_)


def _line(s: Array, z: Array) -> tuple[float, float, float] | None:
    """Where a robust line through points is 0, its slope, and its sigma in height there."""
    if len(s) < 8 or np.ptp(s) < 0.1:
        return None
    weight, off = np.ones(len(s)), np.zeros(len(s))
    fit: Array = np.zeros(2)
    design = np.column_stack([np.ones(len(s)), s])
    for _ in range(6):
        fit = np.asarray(
            np.linalg.solve((design * weight[:, None]).T @ design, (design * weight[:, None]).T @ z), np.float64
        )
        off = z - design @ fit
        weight = 1.0 / (1.0 + (off / (2.0 * max(robust_sigma(off), 1e-3))) ** 2)
    at = float(-fit[0] / fit[1]) if fit[1] > 0.0 else np.inf
    if not np.isfinite(at):
        return None
    inverse = np.linalg.inv((design * weight[:, None]).T @ design)
    number = np.unique(np.floor(s / 0.5), return_inverse=True)[1].ravel()
    score = np.zeros((int(number.max()) + 1, 2))
    np.add.at(score, number, design * (weight * off)[:, None])
    by_groups = inverse @ (score.T @ score) @ inverse * (len(score) / max(len(score) - 2, 1))
    by_points = inverse * float(np.sum(weight * off**2) / max(weight.sum() - 2.0, 1.0))
    way = np.array([1.0, at])
    return at, float(fit[1]), float(np.sqrt(max(way @ by_groups @ way, way @ by_points @ way)))
