"""Empty cells filled from those around them: a membrane through what is known, by a pyramid of ever larger cells.

The membrane is the surface of least slope (Laplace's equation) whose known cells stay as they are. Each level of the pyramid is the mean
of the known cells of the finer one; the coarsest is solved first, and each finer level starts from it and needs few sweeps. Work and
memory grow with the number of cells, where a direct solution grows faster.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

Raster = npt.NDArray[np.float32]

_SWEEPS: Final = 6
"""Of red-black relaxation on each level; what is left of an error of the start is below a hundredth of the step between levels."""
_OVER: Final = 1.4
"""Over-relaxation."""


def fill(values: Raster) -> Raster:
    """Fill cells that are not finite.

    Parameters
    ----------
    values : ndarray, shape (rows, columns)

    Returns
    -------
    ndarray of float32, shape (rows, columns)
        Known cells unchanged; all NaN where nothing is known.
    """
    known = np.isfinite(values)
    values = np.ascontiguousarray(values, np.float32)
    if known.all() or not known.any():
        return values.copy()
    levels = [(values, known)]
    while not levels[-1][1].all():
        levels.append(_coarser(*levels[-1]))
    surface = levels[-1][0]
    for finer, fixed in reversed(levels[:-1]):
        surface = _finer(surface, finer, fixed)
        _relax(surface, fixed, _SWEEPS, _OVER)
    return surface


@njit(cache=True, nogil=True)
def _coarser(values: Any, known: Any) -> Any:
    """Mean of the known of each 2 x 2 cells, and whether there is one."""
    rows, columns = (values.shape[0] + 1) // 2, (values.shape[1] + 1) // 2
    out, found = np.full((rows, columns), np.nan, np.float32), np.zeros((rows, columns), np.bool_)
    for i in range(rows):
        for j in range(columns):
            total, count = 0.0, 0
            for a in range(2 * i, min(2 * i + 2, values.shape[0])):
                for b in range(2 * j, min(2 * j + 2, values.shape[1])):
                    if known[a, b]:
                        total += values[a, b]
                        count += 1
            if count:
                out[i, j], found[i, j] = total / count, True
    return out, found


@njit(cache=True, nogil=True)
def _finer(coarse: Any, values: Any, known: Any) -> Any:
    """Known cells, and between them the coarser surface, bilinear between centres."""
    rows, columns = values.shape
    out = np.empty((rows, columns), np.float32)
    last_i, last_j = coarse.shape[0] - 1, coarse.shape[1] - 1
    for i in range(rows):
        a = i // 2
        a2 = min(max(a + (1 if i % 2 else -1), 0), last_i)
        for j in range(columns):
            if known[i, j]:
                out[i, j] = values[i, j]
                continue
            b = j // 2
            b2 = min(max(b + (1 if j % 2 else -1), 0), last_j)
            near = 0.75 * coarse[a, b] + 0.25 * coarse[a, b2]
            far = 0.75 * coarse[a2, b] + 0.25 * coarse[a2, b2]
            out[i, j] = 0.75 * near + 0.25 * far
    return out


@njit(cache=True, nogil=True)
def _relax(surface: Any, fixed: Any, sweeps: int, over: float) -> None:
    """Red-black over-relaxation of the free cells in place; no slope across the edge."""
    rows, columns = surface.shape
    for sweep in range(2 * sweeps):
        for i in range(rows):
            for j in range((i + sweep) % 2, columns, 2):
                if fixed[i, j]:
                    continue
                total, count = 0.0, 0
                if i > 0:
                    total += surface[i - 1, j]
                    count += 1
                if i < rows - 1:
                    total += surface[i + 1, j]
                    count += 1
                if j > 0:
                    total += surface[i, j - 1]
                    count += 1
                if j < columns - 1:
                    total += surface[i, j + 1]
                    count += 1
                if count:
                    surface[i, j] += over * (total / count - surface[i, j])
