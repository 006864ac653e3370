"""Gauss-Newton steps of the adjustment: conjugate gradients on the lidar's implicit normal matrix plus everybody else's sparse one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import splu

from groundproc.adjustment.factors import Factor, Unknowns, normal_equations
from groundproc.adjustment.planes import Rows, band_of

Array = npt.NDArray[np.float64]

SHARE: Final = 0.15
"""Part of the lidar's information that is left when the planes are unknowns too, roughly: it makes the preconditioner."""
MOST_STEPS: Final = 80
ENOUGH: Final = 1e-4
"""The iteration ends where a step lowers the cost by less than this share of all steps so far."""


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
        Of everything else and a share of the lidar's information: the preconditioner.
    """

    rows: Rows
    deflation: float
    normal: sparse.csr_matrix
    gradient: Array
    factor: Factorisation

    def apply(self, vector: Array) -> Array:
        """The whole normal matrix times a vector."""
        size = (self.rows.intervals + 3) * 6
        out = self.normal @ vector
        out[:size] += self.rows.apply(vector[:size]) / self.deflation
        return np.asarray(out)

    def solve(self, right: Array, enough: float = ENOUGH) -> tuple[Array, int]:
        """Normal matrix x = right, by preconditioned conjugate gradients; and the steps it took."""
        x, r = np.zeros_like(right), right.copy()
        z = self.factor.solve(r)
        p, rz = z.copy(), float(r @ z)
        gained = 0.0
        for step in range(1, MOST_STEPS + 1):
            image = self.apply(p)
            alpha = rz / float(p @ image)
            x += alpha * p
            r -= alpha * image
            gained += alpha * rz
            if alpha * rz < enough * gained:
                return x, step
            z = self.factor.solve(r)
            before, rz = rz, float(r @ z)
            p = z + (rz / before) * p
        return x, MOST_STEPS


def problem(rows: Rows, factors: Sequence[Factor], unknowns: Unknowns, deflation: float) -> Problem:
    """Set a step up."""
    normal, gradient = normal_equations(factors)
    gradient[: unknowns.path_size] += rows.gradient() / deflation
    band = _sparse_band(band_of(rows.blocks()) * (SHARE / deflation), unknowns.size)
    return Problem(
        rows,
        deflation,
        normal.tocsr(),
        gradient,
        splu(
            (normal + band).tocsc(), options={"SymmetricMode": True}, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0
        ),
    )


def _sparse_band(band: Array, size: int) -> sparse.csc_matrix:
    """Blocks, shape (intervals, 4, 4, 6, 6), at the coefficients of each interval."""
    intervals = len(band)
    start = 6 * np.arange(intervals)
    i, j, a, b = np.meshgrid(np.arange(4), np.arange(4), np.arange(6), np.arange(6), indexing="ij")
    row = start[:, None] + (6 * i + a).ravel()
    column = start[:, None] + (6 * j + b).ravel()
    return sparse.csc_matrix((band.reshape(intervals, -1).ravel(), (row.ravel(), column.ravel())), shape=(size, size))
