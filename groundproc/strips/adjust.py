"""The adjustment: Gauss-Newton from coarse voxels to fine ones, with a prior of errors that wander, and the posterior of the last step."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg import cho_solve, cholesky, solve_triangular

from groundproc.estimation.observations.lidar import DEFLATION
from groundproc.estimation.observations.rows import Factor, Unknowns
from groundproc.numerics.splines import AT_KNOT
from groundproc.strips.correction import Correction
from groundproc.strips.options import AUTO, FREE, StripOptions
from groundproc.strips.rows import ROUGHNESS_M, Bordered, bordered

Array = npt.NDArray[np.float64]

MOST_INTERVALS: Final = 660
"""Intervals between knots: 4000 unknowns, a matrix of 128 MB. Longer flights get knots farther apart."""
COARSEST_M: Final = 16.0
MOST_STEPS: Final = 8
SETTLED: Final = 0.02
"""Steps end where the last one changes less than this part of the prior sigmas."""
_TOLD: Final = 0.5
"""A component of a constant is estimated where the strips leave less than this part of its prior sigma."""
_HELD: Final = 1e-4
"""What is held may move by this part of its prior sigma: by nothing that counts."""


@dataclass(frozen=True, slots=True)
class Sigmas:
    """What is known before.

    Attributes
    ----------
    position_m, attitude_rad : float
        Of the trajectory.
    """

    position_m: float
    attitude_rad: float


class Linear:
    """The linear problem of a step, dense: the splines of a flight have some thousand unknowns, and every soft mode counts.

    Parameters
    ----------
    rows : Bordered
    factors : list of Factor
    """

    def __init__(self, rows: Bordered, factors: list[Factor]) -> None:
        self.names = rows.names
        matrix = rows.normal() / DEFLATION
        gradient = rows.right(rows.rows.residual_m) / DEFLATION
        for factor in factors:
            weighted = sparse.diags(1.0 / factor.sigma) @ factor.matrix
            product = (weighted.T @ weighted).tocoo()
            np.add.at(matrix, (product.row, product.col), product.data)
            gradient += weighted.T @ (factor.residual / factor.sigma)
        self._lower = cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)
        self.gradient = gradient

    def solve(self, right: Array) -> Array:
        """Normal matrix x = right."""
        return np.asarray(cho_solve((self._lower, True), right, check_finite=False))

    def sigma(self, functionals: Array) -> Array:
        """Posterior sigma of linear functions of the unknowns, shape (m,), given as columns, shape (unknowns, m)."""
        back = solve_triangular(self._lower, functionals, lower=True, check_finite=False)
        return np.asarray(np.sqrt(np.einsum("nm,nm->m", back, back)))

    def constant_sigmas(self) -> dict[str, Array]:
        """Posterior sigma of each constant, shape (3,) each."""
        size = len(self.gradient)
        start = size - 3 * len(self.names)
        columns = np.zeros((size, size - start))
        columns[start:] = np.eye(size - start)
        deviation = self.sigma(columns)
        return {name: deviation[place] for name, place in self.names.items()}


@dataclass(slots=True)
class Adjusted:
    """What came of it.

    Attributes
    ----------
    correction : Correction
    linear : Linear or None
        None where there was no plane to go by.
    constants : dict
        For each: value, sigma, and which components are estimated; the others are held, their sigma is what the strips would leave.
    log : list of dict
        Figures of each step.
    """

    correction: Correction
    linear: Linear | None
    constants: dict[str, dict[str, Any]]
    log: list[dict[str, float]] = field(default_factory=list)

    def sigma(self) -> Array:
        """Sigma of the splines at the knots, shape (intervals + 1, 6), the shift of the whole included."""
        intervals = self.correction.intervals
        if self.linear is None:
            return np.full((intervals + 1, 6), np.nan)
        size = (intervals + 3) * 6
        shift = self.linear.names["shift_m"]
        out = np.empty((intervals + 1, 6))
        for axis in range(6):
            columns = np.zeros((len(self.linear.gradient), intervals + 1))
            for j, weight in enumerate(AT_KNOT):
                columns[(np.arange(intervals + 1) + j) * 6 + axis, np.arange(intervals + 1)] = weight
            if axis >= 3:
                columns[size + shift.start + axis - 3] = 1.0
            out[:, axis] = self.linear.sigma(columns)
        return out


def adjust(
    clusters: npt.NDArray[np.void], control_sigma_m: Array, correction: Correction, voxel_m: float, start_m: float, sigmas: Sigmas,
    options: StripOptions, has_attitude: bool,
) -> Adjusted:  # fmt: skip
    """Find the correction.

    Parameters
    ----------
    clusters : ndarray of clusters.CLUSTER, in order of time
        Control points among them.
    control_sigma_m : ndarray, shape (n,)
        0 for what is none.
    correction : Correction
        To start from.
    voxel_m, start_m : float
        Finest voxels, and the first.
    sigmas : Sigmas
    options : StripOptions
    has_attitude : bool
        False: nothing can be said of the mount.
    """
    choice = {"boresight_rad": options.boresight, "lever_m": options.lever}
    free = [name for name, how in choice.items() if how in (AUTO, FREE) and has_attitude]
    prior = {
        "boresight_rad": np.full(3, np.deg2rad(options.boresight_sigma_deg)),
        "lever_m": np.full(3, options.lever_sigma_m),
        "shift_m": np.full(3, sigmas.position_m),
    }
    work = _Work(clusters, control_sigma_m, sigmas, options, prior | {})
    edges = [start_m]
    while edges[-1] > 1.01 * voxel_m:
        edges.append(max(edges[-1] / 2.0, voxel_m))
    log: list[dict[str, float]] = []
    for edge in edges:
        correction, _ = work.step(correction, edge, False, free, log)
    correction, linear = work.settle(correction, voxel_m, free, log)
    sigma = {} if linear is None else linear.constant_sigmas()
    told = {name: np.full(3, name in free and linear is not None) for name in choice}
    for name in free:
        if choice[name] == AUTO and name in sigma:
            told[name] = sigma[name] <= _TOLD * prior[name]
            work.prior[name] = np.where(told[name], prior[name], _HELD * prior[name])
    if not all(told[name].all() for name in free) and linear is not None:
        back = {name: np.where(told[name], 0.0, -getattr(correction, name)) for name in free}
        correction = correction.changed(np.zeros_like(correction.coefficients), back)
        correction, linear = work.settle(correction, voxel_m, free, log)
        again = {} if linear is None else linear.constant_sigmas()
        sigma = {name: np.where(told.get(name, True), again.get(name, value), value) for name, value in sigma.items()}
    constants = {
        name: {
            "estimated": told[name], "value": np.where(told[name], getattr(correction, name), 0.0),
            "sigma": sigma.get(name, prior[name]), "prior_sigma": prior[name],
        }
        for name in choice
    }  # fmt: skip
    return Adjusted(correction, linear, constants, log)


@dataclass(slots=True)
class _Work:
    """What every step needs."""

    clusters: npt.NDArray[np.void]
    control_sigma_m: Array
    sigmas: Sigmas
    options: StripOptions
    prior: dict[str, Array]

    def settle(
        self, correction: Correction, voxel_m: float, free: list[str], log: list[dict[str, float]]
    ) -> tuple[Correction, Linear | None]:
        """Steps with outliers cut until they change little; and the posterior about where they arrived."""
        for number in range(MOST_STEPS):
            correction, linear = self.step(correction, voxel_m, True, free, log)
            if linear is None:
                return correction, None
            moved = log[-1]["moved_m"] / self.sigmas.position_m
            turned = np.deg2rad(log[-1]["turned_deg"]) / self.sigmas.attitude_rad
            if number and max(moved, turned) < SETTLED:
                break
        _, linear = self.step(correction, voxel_m, True, free, [])
        return correction, linear

    def step(
        self, correction: Correction, voxel_m: float, cut: bool, free: list[str], log: list[dict[str, float]]
    ) -> tuple[Correction, Linear | None]:
        """One Gauss-Newton step."""
        constants = [*free, "shift_m"]
        # a surface departs from a plane by the more, the larger the voxel
        rough = max(ROUGHNESS_M, 0.01 * voxel_m)
        rows = bordered(self.clusters, correction, voxel_m, rough, cut, constants, self.control_sigma_m)
        if rows is None:
            return correction, None
        unknowns = Unknowns(correction.intervals)
        for name in constants:
            unknowns.add(name, self.prior[name])
        factors = [
            wandering(correction, unknowns, self.sigmas, self.options),
            constant_prior(correction, unknowns),
        ]
        linear = Linear(rows, factors)
        x = linear.solve(-linear.gradient)
        change = x[: unknowns.path_size].reshape(-1, 6)
        cost, used = rows.rows.cost()
        log.append(
            {
                "voxel_m": voxel_m, "planes": len(rows.rows.first) - 1, "rows": len(rows.rows), "used": used,
                "chi_square": cost / max(used, 1), "moved_m": float(np.sqrt(np.mean(np.square(change[:, 3:])) * 3.0)),
                "turned_deg": float(np.rad2deg(np.sqrt(np.mean(np.square(change[:, :3])) * 3.0))),
            }
        )  # fmt: skip
        named = {name: x[place] for name, place in unknowns.names.items()}
        return correction.changed(change, named), linear


def wandering(correction: Correction, unknowns: Unknowns, sigmas: Sigmas, options: StripOptions) -> Factor:
    """The prior of the splines: a Gauss-Markov process of second order (Matern 3/2), stationary, for each of the six.

    (d/dt + a)^2 c is white noise of density 4 a^3 sigma^2 with a = sqrt(3) / tau: slope and value wander, but not for ever. Taken at the
    knots, where its mean over an interval has the sigma sqrt(density / knots_s); the start is drawn from the process.
    """
    step = correction.knots_s
    knots = correction.intervals + 1
    value, slope, second = (
        np.array([1.0, 4.0, 1.0]) / 6.0,
        np.array([-0.5, 0.0, 0.5]) / step,
        np.array([1.0, -2.0, 1.0]) / step**2,
    )
    rows, columns, values, deviation = [], [], [], []
    row = 0
    for axis in range(6):
        rotation = axis < 3
        sigma = sigmas.attitude_rad if rotation else sigmas.position_m
        a = np.sqrt(3.0) / (options.attitude_time_s if rotation else options.position_time_s)
        stencils = [(second + 2.0 * a * slope + a * a * value, np.arange(knots), np.sqrt(4.0 * a**3 * sigma**2 / step))]
        stencils += [(value, np.zeros(1, int), sigma), (slope, np.zeros(1, int), a * sigma)]
        for stencil, at, deviates in stencils:
            for j in range(3):
                rows.append(row + np.arange(len(at)))
                columns.append((at + j) * 6 + axis)
                values.append(np.full(len(at), stencil[j]))
            deviation.append(np.full(len(at), deviates))
            row += len(at)
    matrix = sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(row, unknowns.size)
    )
    now = np.zeros(unknowns.size)
    now[: unknowns.path_size] = correction.coefficients.ravel()
    return Factor("wandering", matrix @ now, matrix, np.concatenate(deviation))


def constant_prior(correction: Correction, unknowns: Unknowns) -> Factor:
    """What was known of the constants."""
    places = np.concatenate([np.arange(p.start, p.stop) for p in unknowns.names.values()])
    matrix = sparse.csr_matrix(
        (np.ones(len(places)), (np.arange(len(places)), places)), shape=(len(places), unknowns.size)
    )
    residual = np.concatenate([getattr(correction, name) for name in unknowns.names])
    return Factor("constants", residual, matrix, np.concatenate([unknowns.sigma[n] for n in unknowns.names]))
