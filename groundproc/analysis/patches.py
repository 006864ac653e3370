"""Patches of ground that stand out against their surroundings, by height and by the strength of the echoes.

Mean heights of cells are compared with the plane that fits them best within two metres. The residuals are averaged
over a patch of the wanted size. How much such averages scatter where there is nothing, with noise, stones and tufts
included, is measured on the ground around: the median of their absolute values. So a patch is judged by how unusual it
is for this ground. A step in reflectance adds to the odds; alone it is no claim.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import correlate1d, label, maximum_filter, median_filter, uniform_filter

from groundproc.numerics.robust import MAD_TO_SIGMA

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

AROUND: Final = 4.0
"""Side of the square that a plane is fitted to, in sizes of a patch."""
_ROUNDS: Final = 3
_LEAST_FILLED: Final = 0.6
_LEAST_AROUND: Final = 0.4
"""Shares of a patch, and of the square around it, that have to be measured: on the edge of a cloud that is less than half."""
_TAIL: Final = 1.645
"""Sigmas that a tenth of a bell lies beyond."""
_BLOCKS: Final = 8
"""Scatter is told in squares of so many patches, three by three of them."""
_LEAST_HEIGHT: Final = 3.0
"""Sigmas in height, at least: what is only darker is no claim."""
_EDGE: Final = 0.5
"""A patch reaches to where it has this share of its greatest height."""


@dataclass(frozen=True, slots=True)
class Field:
    """Cells of ground.

    Attributes
    ----------
    height_m : ndarray, shape (rows, columns)
        Mean, or how much it changed; NaN where there is none. Rows northwards.
    variance_m2 : ndarray, shape (rows, columns)
        Of that.
    strength : ndarray, shape (rows, columns)
        Logarithm of the reflectance, or how much that changed; NaN where it is not known.
    cell_m : float
    """

    height_m: Array
    variance_m2: Array
    strength: Array
    cell_m: float


@dataclass(frozen=True, slots=True)
class Patch:
    """What stands out.

    Attributes
    ----------
    cells : ndarray of bool, shape (rows, columns)
        Of the field.
    row, column : float
        Its middle.
    height_m, height_sigma_m : float
        Mean over its cells, above what is around; the sigma has the ground's own unevenness in it.
    step : float
        Reflectance there over that around; NaN where it is not known.
    score : float
        How unusual it is, in sigmas, of height and reflectance together.
    """

    cells: Flags
    row: float
    column: float
    height_m: float
    height_sigma_m: float
    step: float
    score: float


def patches(field: Field, size_m: float, least_score: float, least_m: float) -> list[Patch]:
    """Patches of a field, the most unusual first.

    Parameters
    ----------
    field : Field
    size_m : float
        Side of the smallest that is looked for.
    least_score : float
        Sigmas.
    least_m : float
        Height that is worth a claim.
    """
    size = max(round(size_m / field.cell_m), 1)
    above, mean, filled = _over(field.height_m, size)
    known = np.isfinite(mean)
    if not known.any():
        return []
    own = _mean_variance(field.variance_m2, np.isfinite(field.height_m), size)
    rough = np.maximum(_scatter(mean, size), np.sqrt(np.where(known, own, 0.0)))
    height = np.where(known, mean / np.maximum(rough, 1e-6), 0.0)
    over, stronger, _ = _over(field.strength, size)
    light = np.nan_to_num(stronger / np.maximum(_scatter(stronger, size), 1e-6), nan=0.0)
    score = np.sqrt(height**2 + light**2)
    score[(np.abs(height) < _LEAST_HEIGHT) | (np.abs(np.nan_to_num(mean)) < least_m) | ~filled] = 0.0
    peak = (score >= least_score) & (score == maximum_filter(score, size))
    found, taken = [], np.zeros(peak.shape, np.bool_)
    for row, column in sorted(np.argwhere(peak).tolist(), key=lambda at: -score[at[0], at[1]]):
        if taken[row, column]:
            continue
        cells = _around(mean, row, column, size) & ~taken
        if not cells.any():
            continue
        taken |= cells
        rows, columns = np.nonzero(cells)
        inner = cells & np.isfinite(above)
        step = over[cells & np.isfinite(over)]
        found.append(Patch(
            cells, float(rows.mean()), float(columns.mean()), float(above[inner].mean()) if inner.any() else float(mean[row, column]),
            float(rough[row, column]), float(np.exp(step.mean())) if len(step) else float("nan"), float(score[row, column]),
        ))  # fmt: skip
    return found


def _over(values: Array, size: int) -> tuple[Array, Array, Flags]:
    """Values less the plane around, their mean over a patch, and where enough of both is measured."""
    known = np.isfinite(values)
    plain = np.where(known, values, 0.0)
    weight = known.astype(np.float64)
    around = round(AROUND * size) | 1
    within = uniform_filter(known.astype(np.float64), size) >= _LEAST_FILLED
    filled = within & (uniform_filter(known.astype(np.float64), around) >= _LEAST_AROUND)
    left = plain
    for _ in range(_ROUNDS):
        left = np.where(known, plain - _plane(plain, weight, around), 0.0)
        smooth = _mean(left, known, size)
        scale = 2.0 * max(_robust(smooth[filled]), 1e-6)
        weight = known / (1.0 + (np.nan_to_num(smooth) / scale) ** 4)
    smooth = _mean(left, known, size)
    return np.where(known, left, np.nan), np.where(filled, smooth, np.nan), filled


def _plane(values: Array, weight: Array, around: int) -> Array:
    """In the middle of each square, the height there of the plane that fits the values within it best."""
    reach = around // 2
    ones, ramp = np.ones(around), np.arange(-reach, reach + 1, dtype=np.float64) / max(reach, 1)

    def total(of: Array, down: Array, right: Array) -> Array:
        return np.asarray(correlate1d(correlate1d(of, down, 0, mode="constant"), right, 1, mode="constant"))

    n, x, y = total(weight, ones, ones), total(weight, ones, ramp), total(weight, ramp, ones)
    xx, xy, yy = total(weight, ones, ramp**2), total(weight, ramp, ramp), total(weight, ramp**2, ones)
    v = weight * values
    z, xz, yz = total(v, ones, ones), total(v, ones, ramp), total(v, ramp, ones)
    n = np.maximum(n, 1e-9)
    # about the middle of what is there; a little stiffness where all of it lies in a line
    mx, my, mz = x / n, y / n, z / n
    cxx, cyy, cxy = xx / n - mx**2 + 1e-3, yy / n - my**2 + 1e-3, xy / n - mx * my
    cxz, cyz = xz / n - mx * mz, yz / n - my * mz
    det = cxx * cyy - cxy**2
    return np.asarray(mz - ((cyy * cxz - cxy * cyz) * mx + (cxx * cyz - cxy * cxz) * my) / det)


def _mean(values: Array, known: Flags, size: int) -> Array:
    share = uniform_filter(known.astype(np.float64), size)
    total = uniform_filter(np.where(known, values, 0.0), size)
    return np.where(share > 1e-9, total / np.maximum(share, 1e-9), np.nan)


def _mean_variance(variance: Array, known: Flags, size: int) -> Array:
    """Variance of the mean over a patch."""
    cells = uniform_filter(known.astype(np.float64), size) * size**2
    return np.asarray(uniform_filter(np.where(known, variance, 0.0), size) * size**2 / np.maximum(cells, 1.0) ** 2)


def _robust(values: Array) -> float:
    return MAD_TO_SIGMA * float(np.median(np.abs(values))) if len(values) else 0.0


def _scatter(mean: Array, size: int) -> Array:
    """How much means over a patch scatter around each place."""
    block = _BLOCKS * size
    rows, columns = -(-mean.shape[0] // block), -(-mean.shape[1] // block)
    padded = np.full((rows * block, columns * block), np.nan)
    padded[: mean.shape[0], : mean.shape[1]] = np.abs(mean)
    parts = padded.reshape(rows, block, columns, block).swapaxes(1, 2).reshape(rows, columns, -1)
    enough = np.isfinite(parts).mean(axis=2) > 0.1
    known = np.isfinite(mean)
    if not known.any():
        return np.zeros(mean.shape)
    sheet = np.full((rows, columns), _tailed(np.abs(mean[known])[None])[0])
    if enough.any():
        sheet[enough] = _tailed(parts[enough])
    sheet = median_filter(sheet, 3, mode="nearest")
    return np.repeat(np.repeat(sheet, block, 0), block, 1)[: mean.shape[0], : mean.shape[1]]


def _tailed(absolute: Array) -> Array:
    """Sigma of rows of absolute values: by their middle, or by their tenth part from the top where that is heavier than a bell's."""
    middle, tail = np.nanquantile(absolute, (0.5, 0.9), axis=1)
    return np.asarray(np.maximum(MAD_TO_SIGMA * middle, tail / _TAIL))


def _around(mean: Array, row: int, column: int, size: int) -> Flags:
    """Cells that belong to a patch: joined to its peak, and as high as half of it."""
    peak = mean[row, column]
    reach = 8 * size
    window = np.s_[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    near = np.nan_to_num(mean[window] / peak, nan=0.0) >= _EDGE
    numbers, _ = label(near)
    out = np.zeros(mean.shape, np.bool_)
    out[window] = numbers == numbers[row - max(row - reach, 0), column - max(column - reach, 0)]
    return out
