"""Gauss-Newton steps of the adjustment.

Conjugate gradients solve the sum of two normal matrices: the lidar's, which is only applied, and the sparse one of all
other observations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import splu

from groundproc.estimation.adjustment.coarse import Coarse, coarse_of
from groundproc.estimation.observations.planes import Rows
from groundproc.estimation.observations.rows import Factor, Unknowns, normal_equations
from groundproc.estimation.odometry.spline import Path
from groundproc.machine.readahead import both
from groundproc.numerics.planeproducts import ABREAST

Array = npt.NDArray[np.float64]

SHARE: Final = 0.7
"""Part of the lidar's information on fast motion that is left when the planes are unknowns too, roughly: it makes the preconditioner."""
MOST_STEPS: Final = 80
ENOUGH: Final = 0.01
"""The iteration ends where what is missing is less than this in the cost: no function of the unknowns is then further than 0.1 of its own
sigma from the exact solution (Cauchy and Schwarz, in the norm of the normal matrix)."""
DELAY_STEPS: Final = 3
"""What the last so many steps gained is what was missing before them, and more than is missing after (Strakos and Tichy 2002)."""


class Factorisation(Protocol):
    """What a sparse factorisation is used for here."""

    def solve(self, right: Array) -> Array:
        """The factored matrix's inverse times a vector."""


@dataclass(slots=True)
class Problem:
    """The linear problem of one Gauss-Newton step.

    Attributes
    ----------
    rows : Rows
    deflation : float
        What the lidar's information is divided by: neighbouring clusters share their errors.
    normal : csc_matrix
        Of everything else.
    gradient : ndarray
        Half the gradient of the whole cost.
    factor : Factorisation
        Of everything else and a share of the lidar's information with the planes fixed: the preconditioner's fine part.
    coarse : Coarse
        Its coarse part.
    wide : Wide, optional
        Rows that are in the gradient and not in `normal`.
    """

    rows: Rows
    deflation: float
    normal: sparse.csr_matrix
    gradient: Array
    factor: Factorisation
    coarse: Coarse
    wide: "Wide | None" = None

    def apply(self, vector: Array) -> Array:
        """The whole normal matrix times a vector."""
        return self._with_others(vector, self.rows.apply(vector[: self.rows.size]))

    def apply_all(self, vectors: Array) -> Array:
        """The same of several vectors, shape (unknowns, m)."""
        return self._with_others(vectors, self.rows.apply_all(vectors[: self.rows.size]))

    def _with_others(self, vector: Array, of_lidar: Array) -> Array:
        """The whole normal matrix times vectors, of what that of the lidar makes of them."""
        out = self.normal @ vector
        if self.wide is not None:
            out += self.wide.rows.T @ (self.wide.rows @ vector)
        out[: self.rows.size] += of_lidar / self.deflation
        return np.asarray(out)

    def solve(self, right: Array, enough: float = ENOUGH, share: float = 0.0) -> tuple[Array, int]:
        """Normal matrix x = right, by preconditioned conjugate gradients; and the steps it took.

        Until less than `enough` is missing in the cost, or less than a `share` of the whole.
        """
        x, r = np.zeros_like(right), right.copy()
        z = self.near(r)
        p, rz = z.copy(), float(r @ z)
        gains: list[float] = []
        for step in range(1, MOST_STEPS + 1):
            if rz <= 0.0:  # solved to the last digit
                return x, step - 1
            image = self.apply(p)
            alpha = rz / float(p @ image)
            x += alpha * p
            r -= alpha * image
            gains.append(alpha * rz)
            if step >= DELAY_STEPS and sum(gains[-DELAY_STEPS:]) < max(enough, share * sum(gains)):
                return x, step
            z = self.near(r)
            before, rz = rz, float(r @ z)
            p = z + (rz / before) * p
        return x, MOST_STEPS

    def solve_all(self, rights: Array, enough: float = ENOUGH, share: float = 0.0) -> Array:
        """`solve` of several right sides, shape (unknowns, m), each by itself and four side by side: the rows are read once for these."""
        if rights.shape[1] > ABREAST:
            groups = [rights[:, i : i + ABREAST] for i in range(0, rights.shape[1], ABREAST)]
            return np.concatenate([self.solve_all(some, enough, share) for some in groups], axis=1)
        found = np.zeros_like(rights)
        going = np.arange(rights.shape[1])
        x, r = np.zeros_like(rights), rights.copy()
        z = self.near(r)
        p, rz = z.copy(), (r * z).sum(axis=0)
        gains: list[Array] = []
        for step in range(1, MOST_STEPS + 1):
            if step >= 1 + DELAY_STEPS:
                done = sum(gains[-DELAY_STEPS:]) < np.maximum(enough, share * sum(gains))
                done |= rz <= 0.0
            else:
                done = rz <= 0.0  # solved to the last digit
            if done.any():
                found[:, going[done]] = x[:, done]
                left = ~done
                going, x, r, z, p, rz = going[left], x[:, left], r[:, left], z[:, left], p[:, left], rz[left]
                gains = [gain[left] for gain in gains]
                if not len(going):
                    return found
            image = self.apply_all(p)
            alpha = rz / (p * image).sum(axis=0)
            x += alpha * p
            r -= alpha * image
            gains.append(alpha * rz)
            z = self.near(r)
            before, rz = rz, (r * z).sum(axis=0)
            p = z + (rz / before) * p
        found[:, going] = x
        return found

    def near(self, right: Array) -> Array:
        """The preconditioner: nearly the inverse times a vector, or times several, shape (unknowns, m)."""
        found = self.factor.solve(right) + self.coarse.solve(right)
        return np.asarray(found if self.wide is None else self.wide.bordered(found))


def problem(rows: Rows, factors: Sequence[Factor], unknowns: Unknowns, deflation: float, path: Path) -> Problem:
    """Set a step up, linear about a path."""
    normal, gradient = normal_equations(factors)
    gradient[: rows.size] += rows.gradient() / deflation
    by_row = normal.T  # it is symmetric: the same arrays, by rows
    fine, coarse = both(lambda: _fine(rows, normal, deflation), lambda: coarse_of(rows, deflation, by_row, path))
    found = Problem(rows, deflation, by_row, gradient, fine, coarse)
    wide = [sparse.diags(1.0 / each.sigma) @ each.matrix for each in factors if each.wide]
    if wide:
        found.wide = Wide(sparse.vstack(wide, format="csr"), found)
    return found


def _fine(rows: Rows, normal: sparse.csc_matrix, deflation: float) -> Factorisation:
    """Factor everything else and a share of the lidar's information, its planes fixed."""
    size = normal.shape[0]
    band = _sparse_band(rows.band() * (SHARE / deflation), size)
    if rows.more:
        band = band + _sparse_corner(rows.corner / deflation, rows.path_size, size)
    band = (normal + band).tocsc()
    found: Factorisation = splu(
        band, options={"SymmetricMode": True}, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0
    )
    return found


class Wide:
    """Some rows that touch much of the path, added to a problem and to its preconditioner (Woodbury).

    Parameters
    ----------
    rows : csr_matrix, shape (m, unknowns)
        Of unit noise.
    problem : Problem
        Without them.
    """

    def __init__(self, rows: sparse.csr_matrix, problem: Problem) -> None:
        dense = rows.toarray()
        self.rows = rows
        self._columns = np.stack([problem.near(row) for row in dense], axis=1)
        self._small = np.linalg.inv(np.eye(len(dense)) + dense @ self._columns)

    def bordered(self, found: Array) -> Array:
        """What the preconditioner makes of a vector, of what it makes without these rows."""
        return np.asarray(found - self._columns @ (self._small @ (self.rows @ found)))


def _sparse_corner(corner: Array, start: int, size: int) -> sparse.csc_matrix:
    """A square block at its place in the whole matrix."""
    row, column = np.meshgrid(start + np.arange(len(corner)), start + np.arange(len(corner)), indexing="ij")
    return sparse.csc_matrix((corner.ravel(), (row.ravel(), column.ravel())), shape=(size, size))


def _sparse_band(band: Array, size: int) -> sparse.csc_matrix:
    """Blocks, shape (intervals, 4, 4, 6, 6), at the coefficients of each interval."""
    intervals = len(band)
    start = 6 * np.arange(intervals, dtype=np.int32)
    i, j, a, b = np.meshgrid(np.arange(4), np.arange(4), np.arange(6), np.arange(6), indexing="ij")
    row = start[:, None] + (6 * i + a).ravel().astype(np.int32)
    column = start[:, None] + (6 * j + b).ravel().astype(np.int32)
    return sparse.csc_matrix((band.reshape(intervals, -1).ravel(), (row.ravel(), column.ravel())), shape=(size, size))
