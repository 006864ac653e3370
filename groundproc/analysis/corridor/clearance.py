"""How far points are from the nearest wire."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial import cKDTree

from groundproc.analysis.corridor.catenary import Catenary

Array = npt.NDArray[np.float64]

_STEP_M: Final = 0.5
"""Between vertices of a wire: chords of so much deviate from a curve of a = 100 m by 0.3 mm."""


class Clearance:
    """Distances to wires.

    Parameters
    ----------
    wires : sequence of Catenary
    """

    def __init__(self, wires: Sequence[Catenary]) -> None:
        lines = [each.places(_STEP_M) for each in wires]
        self._vertices = np.concatenate(lines) if lines else np.empty((0, 3))
        self._wire = np.repeat(np.arange(len(lines)), [len(each) for each in lines])
        self._tree = cKDTree(self._vertices) if lines else None

    def of(self, xyz_m: Array, farthest_m: float = np.inf) -> tuple[Array, npt.NDArray[np.int64]]:
        """Distance to the nearest wire and its number, shape (n,) each; NaN and -1 without any, or none within a distance."""
        out, wire = np.full(len(xyz_m), np.nan), np.full(len(xyz_m), -1, np.int64)
        if self._tree is not None:
            near = np.asarray(self._tree.query(xyz_m, distance_upper_bound=farthest_m)[1], np.int64)
            some = np.flatnonzero(near < len(self._vertices))
            wire[some] = self._wire[near[some]]
            out[some] = _to_segments(xyz_m[some], near[some], self._vertices, self._wire)
        return out, wire


@njit(cache=True, nogil=True)
def _to_segments(places: Any, near: Any, vertices: Any, wire: Any) -> Any:
    """Distance to the segments on both sides of the nearest vertex."""
    out = np.empty(len(places))
    for n in range(len(places)):
        i, best = near[n], np.inf
        for a, b in ((i - 1, i), (i, i + 1)):
            if a < 0 or b >= len(vertices) or wire[a] != wire[b]:
                continue
            top, length = 0.0, 0.0
            for k in range(3):
                e = vertices[b, k] - vertices[a, k]
                top += (places[n, k] - vertices[a, k]) * e
                length += e * e
            t = min(max(top / length, 0.0), 1.0) if length > 0.0 else 0.0
            total = 0.0
            for k in range(3):
                total += (places[n, k] - vertices[a, k] - t * (vertices[b, k] - vertices[a, k])) ** 2
            best = min(best, total)
        out[n] = np.sqrt(best)
    return out
