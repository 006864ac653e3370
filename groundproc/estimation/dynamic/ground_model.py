"""Ground models: a raster of heights under one or some revolutions of the scanner, and the difference of two of them.

Source: FOI-R--4045--SE (2014), dynamic calibration: points higher than 0.7 m above the ground are dropped, a 5 cm
raster, empty pixels filled by interpolation over at most 3 pixels, RMSE over the pixels that both models have. What
the source leaves open is chosen here: a pixel has the mean height of its points; a gap is filled linearly along its
row and its column, and by the mean of the two where both reach over it.

A raster is dense, so that a pixel is a single look-up. It is cleared pixel by pixel, so that its size costs memory but
no time.
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.dynamic.plan import DistanceMap, Trimmed, pixel_of

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

_NOTHING: Final = np.zeros((1, 1), np.float32)


class RasterArrays(NamedTuple):
    """A `Raster` as kernels take it; the fields stand there."""

    pixel_m: float
    height_m: Floats
    weight: npt.NDArray[np.int32]
    touched: npt.NDArray[np.int32]
    used: npt.NDArray[np.int64]


class _Near(NamedTuple):
    """A `DistanceMap` as kernels take it; a limit of 0 where there is none."""

    distance_m: Floats
    pixel_m: float
    limit_m: float


@dataclass(frozen=True, slots=True)
class Raster:
    """A square raster of heights, north up, with the numbers of what is in it.

    Attributes
    ----------
    pixel_m : float
    height_m : ndarray of float32, shape (n, n)
        Row is north, column is east; meaningless where `weight` is 0.
    weight : ndarray of int32, shape (n, n)
        Points in a pixel; -1 or -2 where it was filled from one or two sides; 0: empty.
    touched : ndarray of int32, shape (n * n,)
        Flat indices of the pixels in use, the first `used[0]` of them.
    used : ndarray of int64, shape (1,)
    """

    pixel_m: float
    height_m: Floats
    weight: npt.NDArray[np.int32]
    touched: npt.NDArray[np.int32]
    used: npt.NDArray[np.int64]

    @classmethod
    def empty(cls, pixel_m: float, half_width_m: float) -> "Raster":
        """A raster that reaches `half_width_m` to each side of its middle."""
        n = 2 * int(np.ceil(half_width_m / pixel_m))
        return cls(
            pixel_m,
            np.zeros((n, n), np.float32),
            np.zeros((n, n), np.int32),
            np.empty(n * n, np.int32),
            np.zeros(1, np.int64),
        )

    @property
    def half_width_m(self) -> float:
        """From the middle to each side."""
        return 0.5 * self.pixel_m * len(self.height_m)

    def arrays(self) -> RasterArrays:
        """What the kernels take."""
        return RasterArrays(self.pixel_m, self.height_m, self.weight, self.touched, self.used)

    def model(self) -> Array:
        """Heights with nan where there is none, shape (n, n)."""
        return np.where(self.weight != 0, self.height_m, np.nan).astype(np.float64)


def add(raster: Raster, turned_m: Floats, base_m: Floats, mat: Array, shift_m: Array) -> None:
    """Add the heights of points to the sums of a raster; `finish` makes the model.

    Parameters
    ----------
    raster : Raster
    turned_m : ndarray of float32, shape (n, 3)
        From the INS to the point, east north up: what a trim of an angle turns.
    base_m : ndarray of float32, shape (n, 3)
        Where the INS was when the point was measured, from where it was at the revolution's middle.
    mat : ndarray, shape (3, 3)
        Turn by the trims.
    shift_m : ndarray, shape (3,)
        From the raster's middle to the INS at the revolution's middle, trims included.
    """
    _add(Trimmed.of(turned_m, base_m, mat, shift_m), raster.arrays())


def finish(raster: Raster, fill: int) -> None:
    """Means of the sums, and gaps of at most `fill` pixels filled."""
    _finish(raster.arrays(), fill)


def clear(raster: Raster) -> None:
    """Empty it."""
    _clear(raster.arrays())


def _near(upright: DistanceMap | None) -> _Near:
    if upright is None:
        return _Near(_NOTHING, 1.0, 0.0)
    return _Near(upright.distance_m, upright.pixel_m, upright.limit_m)


def compare(raster: Raster, reference: Raster, loss_m: float, upright: DistanceMap | None = None) -> tuple[float, int]:
    """Sum of the losses of height differences over the pixels that both have, and their number.

    Parameters
    ----------
    raster, reference : Raster
    loss_m : float
        The loss of a pixel is its difference squared, and at most that of this difference.
    upright : DistanceMap, optional
        About the same middle. Pixels within its limit of something are left out: the mean height of a wall in a pixel says which laser
        hit it, and nothing of the ground.
    """
    total, count = _compare(raster.arrays(), reference.arrays(), loss_m, _near(upright))
    return float(total), int(count)


def evaluate(
    raster: Raster,
    reference: Raster,
    turned_m: Floats,
    base_m: Floats,
    mat: Array,
    shift_m: Array,
    fill: int,
    loss_m: float,
    upright: DistanceMap | None = None,
) -> tuple[float, int]:
    """The model of points under a trim, compared with a reference: `add`, `finish`, `compare`, `clear` in one call."""
    points = Trimmed.of(turned_m, base_m, mat, shift_m)
    total, count = _evaluate(points, raster.arrays(), reference.arrays(), fill, loss_m, _near(upright))
    return float(total), int(count)


@njit(cache=True, nogil=True, fastmath=True)
def _add(points: Trimmed, raster: RasterArrays) -> None:
    pixel, height, weight, touched, used = raster
    turned, base, m, s = points.turned_m, points.base_m, points.mat, points.shift_m
    n = height.shape[0]
    scale = np.float32(1.0 / pixel)
    flat_height, flat_weight = height.ravel(), weight.ravel()
    count = used[0]
    for i in range(turned.shape[0]):
        at = pixel_of(i, points, scale, n)
        if at < 0:
            continue
        z = m[2, 0] * turned[i, 0] + m[2, 1] * turned[i, 1] + m[2, 2] * turned[i, 2] + base[i, 2] + s[2]
        if flat_weight[at] == 0:
            touched[count] = at
            count += 1
            flat_height[at] = z
            flat_weight[at] = 1
        else:
            flat_height[at] += z
            flat_weight[at] += 1
    used[0] = count


@njit(cache=True, nogil=True)
def _finish(raster: RasterArrays, fill: int) -> None:
    _, height, weight, touched, used = raster
    n = height.shape[0]
    flat_height, flat_weight = height.ravel(), weight.ravel()
    measured = used[0]
    for k in range(measured):
        at = touched[k]
        flat_height[at] /= np.float32(flat_weight[at])
    count = measured
    for k in range(measured):
        at = touched[k]
        row, column = at // n, at % n
        for stride, room in ((1, n - 1 - column), (n, n - 1 - row)):
            if room < 2 or flat_weight[at + stride] > 0:
                continue  # no gap to fill
            for gap in range(2, min(fill + 1, room) + 1):
                other = at + gap * stride
                if flat_weight[other] <= 0:
                    continue
                rise = (flat_height[other] - flat_height[at]) / np.float32(gap)
                for step in range(1, gap):
                    between = at + step * stride
                    value = flat_height[at] + rise * np.float32(step)
                    if flat_weight[between] == 0:
                        touched[count] = between
                        count += 1
                        flat_height[between] = value
                        flat_weight[between] = -1
                    else:  # the other direction has filled it already
                        flat_height[between] = np.float32(0.5) * (flat_height[between] + value)
                        flat_weight[between] = -2
                break
    used[0] = count


@njit(cache=True, nogil=True)
def _clear(raster: RasterArrays) -> None:
    _, _, weight, touched, used = raster
    flat_weight = weight.ravel()
    for k in range(used[0]):
        flat_weight[touched[k]] = 0
    used[0] = 0


@njit(cache=True, nogil=True)
def _compare(raster: RasterArrays, reference: RasterArrays, loss: float, upright: _Near) -> Any:
    pixel, height, _, touched, used = raster
    _, ref_height, ref_weight, _, _ = reference
    near, near_pixel, limit = upright
    flat_height, flat_ref, flat_ref_weight = height.ravel(), ref_height.ravel(), ref_weight.ravel()
    n, half = height.shape[0], 0.5 * near.shape[0]
    total, count, most = 0.0, 0, loss * loss
    for k in range(used[0]):
        at = touched[k]
        if flat_ref_weight[at] == 0:
            continue
        if limit > 0.0:
            row = int(((at // n + 0.5) - 0.5 * n) * pixel / near_pixel + half)
            column = int(((at % n + 0.5) - 0.5 * n) * pixel / near_pixel + half)
            if near[min(row, near.shape[0] - 1), min(column, near.shape[0] - 1)] < limit:
                continue
        difference = np.float64(flat_height[at] - flat_ref[at])
        total += min(difference * difference, most)
        count += 1
    return total, count


@njit(cache=True, nogil=True)
def _evaluate(
    points: Trimmed, raster: RasterArrays, reference: RasterArrays, fill: int, loss: float, upright: _Near
) -> Any:
    _add(points, raster)
    _finish(raster, fill)
    found = _compare(raster, reference, loss, upright)
    _clear(raster)
    return found
