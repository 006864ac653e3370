"""The adjustment: Gauss-Newton from coarse voxels to fine ones, with a prior of errors that wander, and the posterior of the last step."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from groundproc.adjustment.batch import DEFLATION
from groundproc.adjustment.factors import Factor, Unknowns
from groundproc.adjustment.solve import Problem, problem
from groundproc.strips.correction import Correction
from groundproc.strips.options import AUTO, FREE, StripOptions
from groundproc.strips.rows import ROUGHNESS_M, Bordered, bordered

Array = npt.NDArray[np.float64]

DRAWS: Final = 24
"""Draws from the posterior that the sigmas are from: right to a seventh."""
COARSEST_M: Final = 16.0
_TOLD: Final = 0.5
"""A constant is estimated where the strips leave less than this part of its prior sigma."""


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


@dataclass(slots=True)
class Linear:
    """The linear problem of a step with its border."""

    base: Problem
    rows: Bordered
    border: Array
    block: Array
    factors: list[Factor]
    gradient: Array

    @classmethod
    def of(cls, rows: Bordered, factors: list[Factor], unknowns: Unknowns) -> "Linear":
        """Set it up."""
        base = problem(rows.rows, factors, unknowns, DEFLATION)
        gradient = base.gradient.copy()
        gradient[unknowns.path_size :] += rows.projected.T @ rows.rows.residual_m / DEFLATION
        made = cls(base, rows, rows.border / DEFLATION, rows.block / DEFLATION, factors, gradient)
        base.factor = _Blocks(
            base.factor, made.block + base.normal[unknowns.path_size :, unknowns.path_size :].toarray()
        )
        return made

    def solve(self, right: Array, enough: float = 1e-5) -> tuple[Array, int]:
        """Normal matrix x = right."""
        return _Solver(self).solve(right, enough)

    def draws(self, count: int, seed: int = 1) -> Array:
        """Draws from the posterior about the solution, shape (count, unknowns)."""
        rng = np.random.default_rng(seed)
        weight = self.rows.rows.weight
        found = np.empty((count, len(self.gradient)))
        for i in range(count):
            noise = np.where(weight > 0, rng.standard_normal(len(weight)) / np.sqrt(np.maximum(weight, 1e-30)), 0.0)
            right = self.rows.right(noise) / np.sqrt(DEFLATION)
            for factor in self.factors:
                right += factor.matrix.T @ (rng.standard_normal(len(factor.sigma)) / factor.sigma)
            found[i], _ = self.solve(right, 1e-3)
        return found

    def covariance_of_constants(self) -> Array:
        """Exactly, shape (m, m): columns of the inverse."""
        count = len(self.block)
        start = len(self.gradient) - count
        columns = np.empty((count, count))
        for i in range(count):
            right = np.zeros(len(self.gradient))
            right[start + i] = 1.0
            columns[i] = self.solve(right, 1e-6)[0][start:]
        return np.asarray(0.5 * (columns + columns.T))


class _Blocks:
    """Preconditioner: that of the splines, and the constants' own block."""

    def __init__(self, splines: Any, block: Array) -> None:
        self._splines, self._block = splines, np.linalg.inv(block)

    def solve(self, right: Array) -> Array:
        """Apply it."""
        out = np.asarray(self._splines.solve(right))
        if count := len(self._block):
            out[-count:] = self._block @ right[-count:]
        return out


class _Solver(Problem):
    """The conjugate gradients of `Problem` with the border added."""

    def __init__(self, linear: Linear) -> None:
        base = linear.base
        super().__init__(base.rows, base.deflation, base.normal, base.gradient, base.factor)
        self._linear = linear

    def apply(self, vector: Array) -> Array:
        """The whole normal matrix times a vector."""
        out = super().apply(vector)
        border, block = self._linear.border, self._linear.block
        if count := len(block):
            out[: len(border)] += border @ vector[-count:]
            out[-count:] += border.T @ vector[: len(border)] + block @ vector[-count:]
        return out


@dataclass(slots=True)
class Adjusted:
    """What came of it.

    Attributes
    ----------
    correction : Correction
    linear : Linear or None
        None where there was no plane to go by.
    constants : dict
        For each: value, sigma, and whether it is estimated or held.
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
        draws = self.linear.draws(DRAWS)
        size = (intervals + 3) * 6
        splines = draws[:, :size].reshape(DRAWS, -1, 6)
        at_knots = (splines[:, :-2] + 4.0 * splines[:, 1:-1] + splines[:, 2:]) / 6.0
        shift = self.linear.rows.names["shift_m"]
        at_knots[:, :, 3:] += draws[:, None, size:][:, :, shift]
        return np.asarray(np.sqrt(np.mean(np.square(at_knots), axis=0)))


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
        "boresight_rad": np.deg2rad(options.boresight_sigma_deg), "lever_m": options.lever_sigma_m, "shift_m": sigmas.position_m,
    }  # fmt: skip
    work = _Work(clusters, control_sigma_m, sigmas, options, prior)
    edges = [start_m]
    while edges[-1] > 1.01 * voxel_m:
        edges.append(max(edges[-1] / 2.0, voxel_m))
    log: list[dict[str, float]] = []
    steps = [(edge, False) for edge in edges] + [(voxel_m, True)] * 2
    linear, sigma = None, {}
    for edge, cut in steps:
        correction, linear = work.step(correction, edge, cut, free, log)
    if linear is not None and free:
        sigma = _constant_sigmas(linear)
        held = [n for n in free if choice[n] == AUTO and (sigma[n] > _TOLD * prior[n]).all()]
        if held:
            free = [name for name in free if name not in held]
            zero = {name: -getattr(correction, name) for name in held}
            correction = correction.changed(np.zeros_like(correction.coefficients), zero)
            for edge, cut in [(voxel_m, True)] * 2:
                correction, linear = work.step(correction, edge, cut, free, log)
            sigma |= _constant_sigmas(linear) if linear is not None else {}
    # the posterior is of where the last step arrived
    if linear is not None:
        _, linear = work.step(correction, voxel_m, True, free, [])
    constants = {}
    for name in ("boresight_rad", "lever_m"):
        state = "estimated" if name in free and linear is not None else "held"
        constants[name] = {
            "state": state, "value": getattr(correction, name), "sigma": sigma.get(name, np.full(3, prior[name])),
            "prior_sigma": prior[name],
        }  # fmt: skip
    return Adjusted(correction, linear, constants, log)


def _constant_sigmas(linear: Linear) -> dict[str, Array]:
    deviation = np.sqrt(np.diag(linear.covariance_of_constants()))
    return {name: deviation[place] for name, place in linear.rows.names.items()}


@dataclass(slots=True)
class _Work:
    """What every step needs."""

    clusters: npt.NDArray[np.void]
    control_sigma_m: Array
    sigmas: Sigmas
    options: StripOptions
    prior: dict[str, float]

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
            unknowns.add(name, np.full(3, self.prior[name]))
        factors = [
            wandering(correction, unknowns, self.sigmas, self.options),
            constant_prior(correction, unknowns),
        ]
        linear = Linear.of(rows, factors, unknowns)
        x, count = linear.solve(-linear.gradient)
        change = x[: unknowns.path_size].reshape(-1, 6)
        cost, used = rows.rows.cost()
        log.append(
            {
                "voxel_m": voxel_m, "planes": len(rows.rows.first) - 1, "rows": len(rows.rows), "used": used, "steps": count,
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
