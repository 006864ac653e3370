"""Errors of a trajectory last: poses seconds apart are off alike, and a hundred of them say little more than one.

How long errors last is found from the block. Held by its images and hardly by the trajectory, it is rigid, and the
trajectory's departures from it follow each other where errors last. They are modelled as a Markov process of first
order. Its time constant and size are the likeliest ones with everything else (poses, points, mounting and clocks)
integrated out (restricted likelihood, Patterson & Thompson 1971), which includes how well the images know the shape of
the block. Independent errors stay as they are.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, solve_triangular

from groundproc.imagery.bundle.block import Block, PosePriors
from groundproc.imagery.bundle.observed import add_dense, bare_rows, pose_residuals, what_is_new, whitening
from groundproc.imagery.bundle.screen import Adjusted

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

LOOSE: Final = 100.0
"""What variances are multiplied by while the block tells."""
LEAST_STATIONS: Final = 8
LONGEST_S: Final = 60.0
"""Errors that last longer are those of the block as a whole, and nothing in it tells them."""
TAUS: Final = 7
SIZES: Final = (1.0, 1.7, 3.0, 5.0, 9.0, 15.0, 25.0)
"""Time constants and multiples of variances that are tried."""
MOST_STATIONS: Final = 80
"""The first so many tell."""
MOST_KEPT: Final = 0.9999
DEPARTS: Final = 3.0
"""Sigmas, RMS, beyond which a trajectory departs from its block by more than errors that last explain."""
STATED: Final = float(np.log(2.0))
"""Sigma of the logarithm of the multiple: a trajectory's variances are as stated, to a factor of two or so, unless the images insist.

A process ten times as large that lasts ten times as long changes from image to image like a small short one, and over some minutes of
flight nothing tells them apart. But the mean of the one is worth little, so that the block would hang on a few poses alone.
"""
BY_CHANCE: Final = 3.0
"""Logarithm of probability that a time constant and a size have to gain."""


@dataclass(frozen=True, slots=True)
class Lasting:
    """How the errors of a trajectory hang together.

    Attributes
    ----------
    place_s, turn_s : float
        Time constants; 0 for errors that are independent.
    place, turn : float
        What variances are multiplied by.
    """

    place_s: float = 0.0
    turn_s: float = 0.0
    place: float = 1.0
    turn: float = 1.0


HARDLY: Final = Lasting(place=LOOSE, turn=LOOSE)


def applied(block: Block, lasting: Lasting) -> Block:
    """The block with observed poses, as the trajectory states them, whose errors last."""
    priors = block.priors
    scale = np.sqrt([lasting.place] * 3 + [lasting.turn] * 3)
    finite = np.isfinite(priors.covariance)
    spread = np.where(finite, priors.covariance, 0.0) * (scale[:, None] * scale[None, :])
    priors = replace(priors, covariance=np.where(finite, spread, priors.covariance), before=None, keep=None)
    if lasting.place_s or lasting.turn_s:
        time_ns = block.stations.time_ns[priors.station]
        order = np.argsort(time_ns, kind="stable")
        before = np.full(len(priors), -1)
        before[order[1:]] = order[:-1]
        keep = _kept((time_ns - time_ns.min()) * 1e-9, before, lasting)
        priors = replace(priors, before=before, keep=keep)
    return replace(block, priors=priors)


def departures(block: Block, stated: PosePriors) -> dict[str, float]:
    """RMS of what a trajectory departs from an adjusted block by, as a whole apart: of place and of turn, in sigmas.

    Parameters
    ----------
    block : Block
    stated : PosePriors
        As the trajectory states them.

    How large errors are that last for long is hardly told by how they change, and the size of such a process is not this.
    """
    residual, found = pose_residuals(block, stated), {}
    for name, part in (("place", slice(0, 3)), ("turn", slice(3, 6))):
        lower = np.linalg.cholesky(stated.covariance[:, part, part])
        found[name] = float(np.sqrt(np.square(np.linalg.solve(lower, residual[:, part, None])).mean()))
    return found


def told_by(adjusted: Adjusted, stated: PosePriors) -> Lasting:
    """How long the trajectory's errors last, and how large they are.

    Parameters
    ----------
    adjusted : Adjusted
        With poses that are hardly believed.
    stated : PosePriors
        As the trajectory states them.
    """
    return likeliest(Told.of(adjusted, stated)) if len(stated) >= LEAST_STATIONS else Lasting()


def likeliest(told: "Told") -> Lasting:
    """What is likeliest by the poses and by the sigmas that they state; independent errors where that is as good, but for chance."""
    step_s = float(np.median(np.diff(told.time_s)))
    taus_s = [0.0, *np.geomspace(max(0.4 * step_s, 1e-3), max(LONGEST_S, step_s), TAUS).tolist()]
    best = Lasting()
    posterior = told.likelihood(best)
    for what in ("place", "turn", "place"):
        trials = [replace(best, **{what: size, f"{what}_s": tau_s}) for size, tau_s in itertools.product(SIZES, taus_s)]
        found = [told.likelihood(trial) - _unlikely(trial) for trial in trials]
        first = int(np.argmax(found))
        if found[first] > posterior + BY_CHANCE:
            best, posterior = trials[first], found[first]
    return best


@dataclass(frozen=True, slots=True)
class Told:
    """What the images say of stations and clocks, everything else integrated out, about an adjusted block.

    Attributes
    ----------
    time_s : ndarray, shape (k,)
        Of the observed poses, in order.
    residual, by, columns : ndarray, shape (k, 6), (k, 6, 7) and (k, 7)
        Their rows, in metres and radians.
    white : ndarray, shape (k, 6, 6)
        What makes independent errors of stated size unit ones.
    matrix, gradient : ndarray, shape (n, n) and (n,)
        Half the sum of squares of the image points is half of x' matrix x + gradient x.
    """

    time_s: Array
    residual: Array
    by: Array
    columns: Ints
    white: Array
    matrix: Array
    gradient: Array

    @classmethod
    def of(cls, adjusted: Adjusted, stated: PosePriors) -> "Told":
        """From a block adjusted with poses that are hardly believed, whose share is taken off again."""
        block, unknowns = adjusted.solved.block, adjusted.solved.unknowns
        time_ns = block.stations.time_ns[stated.station]
        chosen = np.argsort(time_ns, kind="stable")[:MOST_STATIONS]
        weight = np.sqrt(block.priors.weight)[:, None, None]
        loose, own = (
            (bare_rows(replace(block, priors=priors), unknowns), whitening(priors.covariance) * weight)
            for priors in (block.priors, stated)
        )
        used = np.unique(own[0][2][chosen])
        used = used[used >= 0]
        place = np.full(unknowns.size + 1, -1)
        place[used] = np.arange(len(used))
        made = [
            cls(
                (time_ns[chosen] - time_ns.min()) * 1e-9, residual[chosen], by[chosen], place[columns[chosen]], white[chosen],
                np.zeros((len(used), len(used))), np.zeros(len(used)),
            )
            for (residual, by, columns), white in (loose, own)
        ]  # fmt: skip
        matrix, gradient, _ = made[0].poses(Lasting())
        inverse = np.linalg.inv(adjusted.found.matrix[np.ix_(used, used)])
        return replace(made[1], matrix=_without_rounding(inverse - matrix, np.diag(inverse)), gradient=-gradient)

    def poses(self, lasting: Lasting) -> tuple[Array, Array, float]:
        """Normal matrix and gradient of observed poses, and the sum of their squares."""
        white = self.white / np.sqrt([lasting.place] * 3 + [lasting.turn] * 3)
        residual, by, columns = np.einsum("kij,kj->ki", white, self.residual), white @ self.by, self.columns
        before = np.arange(len(residual)) - 1
        if lasting.place_s or lasting.turn_s:
            residual, by, columns = what_is_new(before, _kept(self.time_s, before, lasting), residual, by, columns)
        matrix, gradient = np.zeros_like(self.matrix), np.zeros_like(self.gradient)
        add_dense(matrix, gradient, residual, by, columns)
        return matrix, gradient, float(np.square(residual).sum())

    def likelihood(self, lasting: Lasting) -> float:
        """Logarithm of the likelihood of the poses, but for what does not depend on how their errors last."""
        matrix, gradient, square = self.poses(lasting)
        lower, _ = cho_factor(matrix + self.matrix, lower=True)
        pulled = solve_triangular(lower, gradient + self.gradient, lower=True)
        count = len(self.time_s)
        kept = _kept(self.time_s, np.arange(count) - 1, lasting)[1:]
        spread = np.log(np.diag(lower)).sum() + 1.5 * count * np.log(lasting.place * lasting.turn)
        spread += 1.5 * np.log(1.0 - kept**2).sum()
        return float(0.5 * (pulled @ pulled - square) - spread)


def _unlikely(lasting: Lasting) -> float:
    """By how much less likely sizes are than those stated, before the images are asked: a logarithm."""
    return float(0.5 * np.square(np.log([lasting.place, lasting.turn]) / STATED).sum())


def _without_rounding(matrix: Array, scale: Array) -> Array:
    """A difference of normal matrices, of which nothing is negative but by rounding: a millionth, as one of them was inverted twice.

    `scale` is the diagonal of the larger one.
    """
    size = np.sqrt(scale)
    value, axis = np.linalg.eigh(matrix / np.outer(size, size))
    return np.asarray((axis * np.maximum(value, 0.0)) @ axis.T * np.outer(size, size))


def _kept(time_s: Array, before: Ints, lasting: Lasting) -> Array:
    """What is left of errors of place and turn at the pose before, shape (k, 2)."""
    since_s = np.where(before >= 0, time_s - time_s[before], np.inf)
    taus_s = (lasting.place_s, lasting.turn_s)
    keep = [np.exp(-since_s / tau_s) if tau_s else np.zeros(len(time_s)) for tau_s in taus_s]
    # two images at once have one error, but a pose that is quite the same would make the matrix singular
    return np.asarray(np.minimum(np.stack(keep, axis=1), MOST_KEPT))
