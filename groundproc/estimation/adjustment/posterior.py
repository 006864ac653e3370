"""What a solution knows of itself: draws of its error, and covariances of quantities that depend on its unknowns."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.adjustment.noise import Noise
from groundproc.estimation.adjustment.solve import Problem
from groundproc.estimation.observations.rows import Unknowns
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.numerics.parts import at_once

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

WHOLE: Final = 1e-6
"""What the variance of the whole may lack [m^2, deg^2]."""
EXACT: Final = 1e-8
"""Of a covariance by weights no more than this share of the prior's variance is missing."""
ENOUGH_OF_DRAWS: Final = 1e-3
ENOUGH_OF_COLUMNS: Final = 3e-3
"""Share that may be missing: of a draw, as a share of all that it moves; of a column of the inverse, of the variance
that it stands for."""
AT_ONCE: Final = 1 << 16
"""Numbers of each column of a covariance that are multiplied at once."""
LEVER_M: Final = 10.0
"""How a turn counts against a shift where a path's own rigid part is told from it."""


@dataclass(slots=True)
class Spread:
    """Errors of a solution: draws, and columns for the part of their covariance that need not be drawn; each shape (n, unknowns).

    Attributes
    ----------
    whole : ndarray
        Draws.
    anchored : ndarray
        Of each draw, nearly the part that is the anchors': where the whole lies.
    columns : ndarray
        The covariance of `anchored` is the sum of their outer products.
    """

    whole: Array
    anchored: Array
    columns: Array

    def variance(self, of: Callable[[Array], Array]) -> Array:
        """Variance of linear functions of the unknowns, shape (...): what is known of it, and by draws what is not (control variates)."""
        known = np.zeros_like(of(self.whole[0]))
        for column in self.columns:
            known += np.square(of(column))
        left = np.zeros_like(known)
        for whole, anchored in zip(self.whole, self.anchored, strict=True):
            left += np.square(of(whole)) - np.square(of(anchored))
        return np.asarray(known + np.maximum(left / len(self.whole), 0.0))

    def moments(self, of: Callable[[Array], Array]) -> tuple[Array, Array]:
        """Covariance of linear functions of the unknowns, shape (n, k), as two parts of shape (n, k, k).

        The first is known exactly. The second is drawn: it is a difference, and by itself need not be a covariance.
        The diagonal of their sum is `variance` where that of the second is positive.
        """
        known = np.zeros_like(_outer(of(self.whole[0])))
        for column in self.columns:
            known += _outer(of(column))
        left = np.zeros_like(known)
        for whole, anchored in zip(self.whole, self.anchored, strict=True):
            left += _outer(of(whole)) - _outer(of(anchored))
        return known, left / len(self.whole)

    def without(self, unknowns: Sequence[slice]) -> "Spread":
        """The same as if some unknowns were known."""
        made = Spread(self.whole.copy(), self.anchored.copy(), self.columns.copy())
        for part in (made.whole, made.anchored, made.columns):
            for where in unknowns:
                part[:, where] = 0.0
        return made


def _outer(values: Array) -> Array:
    """Outer products of rows, shape (n, k), with themselves, shape (n, k, k)."""
    return np.asarray(values[:, :, None] * values[:, None, :])


@dataclass(slots=True)
class Posterior:
    """The last step's linear problem: covariances come from it."""

    problem: Problem
    unknowns: Unknowns
    find_noise: Callable[[], Noise]
    _noise: Noise | None = None

    @property
    def noise(self) -> Noise:
        """Where errors come from."""
        if self._noise is None:
            found = self._noise = self.find_noise()
            self.find_noise = lambda: found  # what it was found from goes: clusters, and the other observations' rows
        return self._noise

    def figures(self) -> dict[str, float]:
        """Of the last step, for the report: how many times more than stated the errors of positions are, the largest."""
        return {"position_strain": max((float(times.max()) for times in self.noise.strain.values()), default=1.0)}

    def spread(self, count: int, seed: int = 1) -> Spread:
        """So many draws of the error of the solution, noise put through the same solution; and what need not be drawn."""
        rng = np.random.default_rng(seed)
        rights, of_anchors = np.empty((2, self.unknowns.size, count))
        noise = self.noise
        numbers = [noise.numbers(rng) for _ in range(count)]

        def draw(number: int) -> None:
            rights[:, number], of_anchors[:, number] = noise.drawn(*numbers[number])

        at_once(draw, count)
        whole = self.told(self.problem.solve_all(rights, 0.0, ENOUGH_OF_DRAWS)).T
        anchored = self.told(self.problem.coarse.solve(of_anchors)).T
        if self.problem.wide is not None:  # control holds the whole, and the coarse path does not know of it
            return Spread(whole, 0.0 * anchored, np.zeros((0, self.unknowns.size)))
        return Spread(whole, anchored, self.told(self.problem.coarse.spread_by(self.noise.anchors)).T)

    def told(self, x: Array) -> Array:
        """Solutions, shape (unknowns, ...), with the rigid part of the coefficients told by the whole's turn and shift.

        Only the sum of both is known.
        """
        rigid, whole = self.problem.coarse.rigid, self._whole()
        told = x.copy()
        common = self._common() @ x[: len(rigid)]
        told[: len(rigid)] -= rigid @ common
        told[whole] += common
        return told

    def _common(self) -> Array:
        """What is rigid in coefficients, shape (6, coefficients): a turn and a shift, by least squares."""
        rigid = self.problem.coarse.rigid
        weighed = rigid * np.tile([LEVER_M**2] * 3 + [1.0] * 3, len(rigid) // 6)[:, None]
        return np.asarray(np.linalg.solve(weighed.T @ rigid, weighed.T))

    def _whole(self) -> Ints:
        """Where the whole's turn and shift stand, shape (6,)."""
        names = self.unknowns.names
        return np.concatenate([np.arange(names[n].start, names[n].stop) for n in ("world.turn", "world.shift")])

    def covariance(self, names: Sequence[str]) -> Array:
        """Covariance of some globals, without drawing, shape (m, m); of the whole's turn and shift as `told`."""
        places = np.concatenate([np.arange(self.unknowns.names[n].start, self.unknowns.names[n].stop) for n in names])
        whole, common = self._whole(), self._common()
        rights = np.zeros((self.unknowns.size, len(places)))
        for i, place in enumerate(places):
            rights[place, i] = 1.0
            if place in whole:  # with what the path's coefficients have of it
                rights[: common.shape[1], i] = common[int(np.flatnonzero(whole == place)[0])]
        solved = self.problem.solve_all(rights, 0.0, ENOUGH_OF_COLUMNS)
        # hundreds of thousands of numbers for each global: they are kept in single precision, and multiplied in double
        seen = np.empty((len(places), sum(self.noise.sizes)), np.float32)
        columns, noise = np.ascontiguousarray(solved.T), self.noise

        def see(number: int) -> None:
            seen[number] = noise.seen(columns[number])

        at_once(see, len(columns))
        found = np.zeros((len(places), len(places)))
        for begin in range(0, seen.shape[1], AT_ONCE):
            some = seen[:, begin : begin + AT_ONCE].astype(np.float64)
            found += some @ some.T
        return found

    def datum(self) -> Array:
        """Covariance of the shift and of the turn about the origin that all of a path shares, shape (6, 6).

        Where the whole lies is the anchors' part, but how it leans is told by accelerometers, whose errors are none of theirs.
        """
        return self.covariance(("world.shift", "world.turn"))

    def weighed(self, names: Sequence[str]) -> Array:
        """Covariance of some globals were the rows' weights right, shape (m, m): columns of the normal matrix's inverse."""
        places = np.concatenate([np.arange(self.unknowns.names[n].start, self.unknowns.names[n].stop) for n in names])
        prior = np.concatenate([self.unknowns.sigma[n] for n in names])
        rights = np.zeros((self.unknowns.size, len(places)))
        # what is gained is then the variance, in the prior's
        rights[places, np.arange(len(places))] = 1.0 / prior
        columns = self.problem.solve_all(rights, EXACT)[places] * prior
        return np.asarray(0.5 * (columns + columns.T))


def whole_covariance(posterior: Posterior, path: Path) -> Array:
    """Covariance of the turn about the origin and the shift of a path as a whole, shape (6, 6).

    The world's unknowns share these with the spline, of whose coefficients the mean is taken: only the sum means anything.
    """
    unknowns = posterior.unknowns
    count = path.intervals + 3
    knots = np.clip(np.arange(-1, count - 1) * STEPS, 0, len(path.quat) - 1)
    asked = np.zeros((unknowns.size, 6))
    spline = asked[: unknowns.path_size].reshape(count, 6, 6)
    spline[:, :3, :3] = np.swapaxes(frames.mat_from_quat(path.quat[knots]), 1, 2) / count
    spline[:, 3:, 3:] = np.eye(3) / count
    x, y, z = path.position_m[knots].mean(axis=0)
    # the shift about the origin: what the middle moves by less what the turn moves it by
    spline[:, :3, 3:] = spline[:, :3, :3] @ -np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]).T
    asked[unknowns.names["world.turn"], :3] = np.eye(3)
    asked[unknowns.names["world.shift"], 3:] = np.eye(3)
    # in degrees and metres, so that what a solution may leave out is little of each
    scale = np.array([np.deg2rad(1.0)] * 3 + [1.0] * 3)
    found = asked.T @ (posterior.problem.solve_all(asked / scale, WHOLE) * scale)
    return np.asarray(0.5 * (found + found.T))


def joined(values: Sequence[Array], covariances: Sequence[Array], prior_sigma: Array) -> tuple[Array, Array]:
    """Weighted mean of estimates that all hold the same prior about zero, and its covariance: the prior is counted once."""
    information = [np.linalg.inv(covariance) for covariance in covariances]
    total = sum(information[1:], information[0]) - (len(information) - 1) * np.diag(prior_sigma**-2.0)
    right = sum((i @ v for i, v in zip(information, values, strict=True)), np.zeros(len(prior_sigma)))
    covariance: Array = np.asarray(np.linalg.inv(total), np.float64)
    return covariance @ right, covariance
