"""Where the errors of a solution come from: the middle of the sandwich N^-1 (S S^T) N^-1.

The normal matrix N weighs rows as if they were independent, but their errors are not. Where a surface is no plane, or
has an edge, the error is in all rows of its voxel and of its neighbours. The gyro's noise between two knots is in all
returns of that moment, and no spline follows it. What the model of an inertial unit lacks lasts for seconds. `Noise`
is S: it turns independent numbers of size one, several for each source, into the effect of that source on the
gradient.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import sparse

from flightlog import frames
from groundproc.estimation.adjustment.straining import of_source
from groundproc.estimation.observations.planes import Rows
from groundproc.estimation.observations.rows import PRIOR, Errors, Factor
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.numerics.splines import basis

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.int32]

LASTING_ROWS: Final = 20
"""Rows on end (of a tenth of a second each) whose errors are taken to go together: what lasts longer is found as a bias or a scale."""
NONE_STRAINED: Final[Mapping[str, Array]] = {}
PATCH_M: Final = 4.0
"""Edge of the cubes within which what a surface is not goes together: with larger ones the spread of simulated flights grows no more."""


@dataclass(slots=True)
class Noise:
    """The sources of errors of one linear problem.

    Attributes
    ----------
    rows : Rows
    deflation : float
        What the lidar's information is divided by in the normal matrix.
    off_m : ndarray, shape (rows,)
        Distances from the voxels' mean planes at the solution: they are the errors, with a sign for each patch (wild bootstrap by groups).
    patch : ndarray of int32, shape (rows,)
        Number of the patch of surface that each row is of.
    step : ndarray of int32, shape (rows,)
        Grid step that each row's cluster lies in.
    mats : ndarray, shape (grid, 3, 3)
        Local from sensor.
    follow : csr_matrix, shape (grid, grid)
        From a course over the grid to what a spline of the path follows of it.
    walk_rad : float
        Noise of the carrying gyro's turn over a grid step.
    carrier : Carrier or None
        Its factor.
    others : csr_matrix, shape (m, unknowns)
        Rows of the other factors, each for an error of size one.
    anchors : csr_matrix, shape (k, unknowns)
        The same of what says where the whole lies, and of the priors.
    strain : dict of str to ndarray
        How many times more than stated the errors of sources of positions are, east, north, up (`straining`); in `anchors` already.
    """

    rows: Rows
    deflation: float
    off_m: Array
    patch: Numbers
    step: Numbers
    mats: Array
    follow: sparse.csr_matrix
    walk_rad: float
    carrier: "Carrier | None"
    others: sparse.csr_matrix
    anchors: sparse.csr_matrix
    strain: dict[str, Array] = field(default_factory=dict)

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """How many numbers each source takes: a sign for a patch, turns of grid steps about three axes, rows of factors and anchors."""
        patches = int(self.patch.max(initial=-1)) + 1
        return patches, 3 * self.follow.shape[0], self.others.shape[0], self.anchors.shape[0]

    def numbers(self, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
        """Independent numbers of size one, as many as each source takes: those of a draw."""
        patches, turns, others, anchors = self.sizes
        of_anchors = rng.standard_normal(anchors)
        signs = rng.choice([-1.0, 1.0], patches)
        return signs, rng.standard_normal(turns), rng.standard_normal(others), of_anchors

    def drawn(self, signs: Array, turns: Array, others: Array, anchors: Array) -> tuple[Array, Array]:
        """What they make of the gradient, shape (unknowns,), and the part of it that is the anchors'."""
        anchored = self.anchors.T @ anchors
        return self.gradient(signs, turns, others, np.zeros(len(anchors))) + anchored, anchored

    def gradient(self, signs: Array, turns: Array, others: Array, anchors: Array) -> Array:
        """S times a vector, given in its parts."""
        course = np.cumsum(self.walk_rad * turns.reshape(-1, 3), axis=0)
        followed = self.follow @ course
        in_body = np.einsum("nji,nj->ni", self.mats, course - followed)
        errors = np.empty(len(self.off_m))
        _errors(self.rows.jacobian, in_body, self.step, self.off_m, signs, self.patch, errors)
        right: Array = np.array(self.others.T @ others + self.anchors.T @ anchors, np.float64)
        right[: self.rows.size] += self.rows.spread(errors) / self.deflation
        if self.carrier is not None:
            right = right + self.carrier.gradient(followed)
        return np.asarray(right)

    def seen(self, vector: Array) -> Array:
        """S^T times a vector of unknowns: what each of the independent numbers does to the linear function that it stands for."""
        patches, _, _, _ = self.sizes
        by_row = self.rows.seen(vector[: self.rows.size])
        by_row /= self.deflation
        grid = self.follow.shape[0]
        signs, in_body = np.zeros(patches), np.zeros((grid, 3))
        _collect(self.rows.jacobian, by_row, self.step, self.off_m, self.patch, in_body, signs)
        moments = np.einsum("nij,nj->ni", self.mats, in_body)
        followed = 0.0 if self.carrier is None else self.carrier.seen(vector, grid)
        course = moments + self.follow.T @ (followed - moments)
        turns = self.walk_rad * np.cumsum(course[::-1], axis=0)[::-1]
        return np.concatenate([signs, turns.ravel(), self.others @ vector, self.anchors @ vector])


@njit(cache=True, nogil=True)
def _errors(
    jacobian: Singles, in_body: Array, step: Numbers, off_m: Array, signs: Array, patch: Numbers, out: Array
) -> None:
    """Errors of rows: what the gyro turned between the knots, in the body, and what surfaces are not, by the signs of their patches."""
    for i in range(len(out)):
        turn = in_body[step[i]]
        out[i] = off_m[i] * signs[patch[i]] + (
            jacobian[i, 0] * turn[0] + jacobian[i, 1] * turn[1] + jacobian[i, 2] * turn[2]
        )


@njit(cache=True, nogil=True)
def _collect(
    jacobian: Singles, by_row: Array, step: Numbers, off_m: Array, patch: Numbers, in_body: Array, signs: Array
) -> None:
    """The transpose of it, added up."""
    for i in range(len(by_row)):
        signs[patch[i]] += by_row[i] * off_m[i]
        for c in range(3):
            in_body[step[i], c] += by_row[i] * jacobian[i, c]


@dataclass(slots=True)
class Carrier:
    """The factor of the gyro whose turns are the path's motion between knots: what the path follows of its noise is in its rows.

    Attributes
    ----------
    factor : Factor
    interval : ndarray of int64, shape (n,)
        Of each three rows.
    mats : ndarray, shape (n, 3, 3)
        Local from sensor at the interval's end.
    """

    factor: Factor
    interval: Ints
    mats: Array

    def gradient(self, followed: Array) -> Array:
        """What a course on the grid, about local axes, does to the gradient."""
        knots = followed[::STEPS]
        turn = (knots[1:] - knots[:-1])[self.interval]
        rows = np.einsum("nji,nj->ni", self.mats, turn).ravel()
        return np.asarray(self.factor.matrix.T @ (rows / self.factor.sigma**2))

    def seen(self, vector: Array, grid: int) -> Array:
        """The transpose of it, shape (grid, 3)."""
        rows = (self.factor.matrix @ vector / self.factor.sigma**2).reshape(-1, 3)
        turn = np.einsum("nij,nj->ni", self.mats, rows)
        found = np.zeros((grid, 3))
        np.add.at(found, (self.interval + 1) * STEPS, turn)
        np.add.at(found, self.interval * STEPS, -turn)
        return found


def noise_of(
    rows: Rows,
    clusters: Clusters,
    path: Path,
    deflation: float,
    factors: Sequence[Factor],
    x: Array,
    strain: Mapping[str, Array] = NONE_STRAINED,
) -> Noise:
    """The sources of errors about a solution `x` of a problem that is linear about `path`; where no gyro carries it, none between knots."""
    step = np.empty(len(rows), np.int32)
    for _, part in rows.pieces():
        since = (clusters.time_ns[rows.cluster[part]] - path.start_ns) // path.step_ns
        step[part] = np.clip(since, 0, len(path.quat) - 2)
    mats = frames.mat_from_quat(path.quat)
    inside = step[rows.first[:-1]]
    place = np.einsum("nij,nj->ni", mats[inside], clusters.xyz_m[rows.cluster[rows.first[:-1]]])
    carrier, walk_rad, others, anchors = None, 0.0, [], []
    for factor in factors:
        whitened = sparse.diags(1.0 / factor.sigma) @ factor.matrix
        if factor.carrying is not None:
            interval, walk_rad = factor.carrying.interval, factor.carrying.walk_rad
            carrier = Carrier(factor, interval, mats[(interval + 1) * STEPS])
        elif factor.errors is Errors.LASTING:
            others.append(whitened * lasting(factor.residual / factor.sigma + whitened @ x))
        elif factor.name == PRIOR:  # that of the path is no knowledge, only a weak hold
            anchors.append(whitened[6 * (rows.intervals + 3) :])
        elif factor.errors is Errors.ANCHOR:
            anchors.append(sparse.diags(of_source(strain, factor)) @ whitened)
        else:
            others.append(whitened)
    none = sparse.csr_matrix((0, len(x)))
    return Noise(
        rows, deflation, rows.residual_m + rows.along(x[: rows.size]),
        np.repeat(_patches(place + path.position_m[inside]), np.diff(rows.first)), step, mats, followed(path),
        walk_rad, carrier,
        sparse.vstack([none, *others], format="csr"), sparse.vstack([none, *anchors], format="csr"),
        dict(strain),
    )  # fmt: skip


def _patches(place_m: Array) -> Numbers:
    """Number of the cube of `PATCH_M` that each place lies in, shape (n,)."""
    cube = np.floor(place_m / PATCH_M).astype(np.int64)
    return np.asarray(np.unique(cube, axis=0, return_inverse=True)[1], np.int32).ravel()


def lasting(whitened: Array) -> float:
    """Root of the power of residuals, three to a row, at low frequencies: 1 for white noise of the stated size, more where they last.

    From sums over `LASTING_ROWS` rows on end; not below that of the rows by themselves.
    """
    rows = whitened.reshape(-1, 3)
    power = float(np.mean(np.square(rows))) if len(rows) else 1.0
    blocks = len(rows) // LASTING_ROWS
    if blocks < 2:
        return float(np.sqrt(power))
    sums = rows[: blocks * LASTING_ROWS].reshape(blocks, LASTING_ROWS, 3).sum(axis=1) / np.sqrt(LASTING_ROWS)
    return float(np.sqrt(max(power, np.mean(np.square(sums)))))


def followed(path: Path) -> sparse.csr_matrix:
    """From a course on the grid to the spline near it, on the grid again: its values at the knots, cubics kept."""
    knots, grid = path.intervals + 1, len(path.quat)
    pick = sparse.csr_matrix((np.ones(knots), (np.arange(knots), np.arange(knots) * STEPS)), shape=(knots, grid))
    # straight beyond the ends, then the coefficients of a spline by their neighbours
    ends = sparse.csr_matrix(
        (
            [3.0, -2.0, 2.0, -1.0, -1.0, 2.0, -2.0, 3.0],
            (
                [0, 0, 1, 1, knots + 2, knots + 2, knots + 3, knots + 3],
                [0, 1, 0, 1, knots - 2, knots - 1, knots - 2, knots - 1],
            ),
        ),
        shape=(knots + 4, knots),
    )
    wider = sparse.eye(knots + 4, knots, k=-2) + ends
    coefficients = sparse.diags([-1.0 / 6.0, 8.0 / 6.0, -1.0 / 6.0], [0, 1, 2], shape=(knots + 2, knots + 4)) @ wider
    step = np.arange(grid)
    interval = np.minimum(step // STEPS, path.intervals - 1)
    weights = np.array([basis(k / STEPS) for k in range(STEPS + 1)])[step - STEPS * interval]
    values = sparse.csr_matrix(
        (weights.ravel(), (np.repeat(np.arange(grid), 4), (interval[:, None] + np.arange(4)).ravel())),
        shape=(grid, knots + 2),
    )
    return sparse.csr_matrix(values @ coefficients @ pick)
