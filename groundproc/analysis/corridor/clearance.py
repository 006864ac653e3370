"""How far points are from the nearest wire."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial import cKDTree

from groundproc.analysis.corridor.catenary import Catenary

Array = npt.NDArray[np.float64]

_STEP_M: Final = 0.1
"""Between vertices of a wire. The nearest vertex may be another wire's than the nearest place: from a metre away that is 1 mm, ..."""
_CLOSE_M: Final = 1.0
_VERTICES: Final = 8
"""... and nearer than that so many vertices are tried: of the next span, and of the others in a bundle."""


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
            away, near = self._tree.query(xyz_m, distance_upper_bound=farthest_m)
            some = np.flatnonzero(np.asarray(near, np.int64) < len(self._vertices))
            self._settle(xyz_m, some, np.asarray(near, np.int64)[some, None], out, wire)
            close = np.flatnonzero(away < _CLOSE_M)
            self._settle(xyz_m, close, self._tree.query(xyz_m[close], k=_VERTICES)[1], out, wire)
        return out, wire

    def _settle(self, xyz_m: Array, some: Any, near: Any, out: Array, wire: npt.NDArray[np.int64]) -> None:
        """Distances of some points, by their nearest vertices, shape (m, k)."""
        out[some], best = _to_segments(xyz_m[some], near, self._vertices, self._wire)
        wire[some] = self._wire[best]


@njit(cache=True, nogil=True)
def _to_segments(places: Any, near: Any, vertices: Any, wire: Any) -> Any:
    """Distance to the nearest of the segments on both sides of some vertices, and the vertex that it is at."""
    out, at = np.empty(len(places)), np.empty(len(places), np.int64)
    for n in range(len(places)):
        best, at[n] = np.inf, near[n, 0]
        for j in range(near.shape[1]):
            i = near[n, j]
            for a in range(max(i - 1, 0), i + 1):
                b = a + 1
                if i >= len(vertices) or b >= len(vertices) or wire[a] != wire[b]:
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
                if total < best:
                    best, at[n] = total, i
        out[n] = np.sqrt(best)
    return out, at
