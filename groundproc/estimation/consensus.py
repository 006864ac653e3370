"""Fixes that drift away and come back, found by a witness that knows how the vehicle moved between them.

A witness (the lidar's path, a stated velocity) says what lies between two fixes. The rest of their difference is the
change of the fixes' own error, and of the witness's. Both change slowly: of errors that last a minute, little is new
from one second to the next. The longest chain of seconds whose steps are all explained in this way is right, even if
it is interrupted; the other seconds drifted away. Steps are examined over one second, and also from some and from many
seconds before, because a slow drift hides in small steps. A second that can be reached only by strained steps counts
against its chain.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

POSITION_TAU_S: Final = np.array([60.0, 60.0, 300.0])
POSITION_WHITE_M: Final = 0.1
"""Errors of a GNSS receiver that smooths last for a minute, those of a height that the barometer carries for longer (east, north, up);
a tenth of a metre is new each second."""
GATE_SIGMAS: Final = 5.0
"""A step may be off by so many of its sigmas."""
EASY: Final = 0.36
"""A step whose square is below this share of the gate's (three of five sigmas) does not count as leading away."""
LOOKED_BACK_S: Final = (4.0, 16.0)
"""From so long ago a step is looked at too."""
LONGEST_S: Final = 600.0
"""A chain is not interrupted for longer."""
FEWEST: Final = 5
"""Seconds below which no chain is longer than another."""


@dataclass(frozen=True, slots=True)
class Steps:
    """How much may change between two moments, as it adds up.

    Attributes
    ----------
    sigma_m : ndarray, shape (n, k)
        Of the fixes' errors.
    tau_s : ndarray, shape (k,)
        How long they last.
    drift_m2 : ndarray, shape (n,)
        Variance that the witness has gained since the first moment [m^2].
    loose_m : ndarray, shape (n, m)
        The part of the difference that depends on an unknown value (a bearing, a delay), for one sigma of that value.
    """

    sigma_m: Array
    tau_s: Array
    drift_m2: Array
    loose_m: Array

    def variance(self, time_s: Array, i: int, before: Ints) -> Array:
        """Variance of the step to moment i from others before, shape (b, k)."""
        keep = np.exp(-(time_s[i] - time_s[before])[:, None] / self.tau_s)
        now, then = self.sigma_m[i], self.sigma_m[before]
        walked = now**2 + then**2 - 2.0 * keep * now * then + 2.0 * POSITION_WHITE_M**2
        loose = np.square(self.loose_m[i] - self.loose_m[before]).sum(axis=1)
        return np.asarray(walked + (self.drift_m2[i] - self.drift_m2[before] + loose)[:, None])


def agreeing(time_s: Array, off_m: Array, steps: Steps) -> Mask:
    """Which fixes belong to the longest chain, shape (n,).

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Increasing.
    off_m : ndarray, shape (n, k)
        Fixes less the witness's way.
    steps : Steps
        Where the fixes' scatter from second to second is larger than it says, that counts.
    """
    second = np.unique(np.floor(time_s - time_s[0]).astype(np.int64), return_inverse=True)[1] if len(time_s) else None
    if second is None or second[-1] + 1 < FEWEST:
        return np.ones(len(time_s), np.bool_)
    count = np.bincount(second).astype(np.float64)

    def mean(values: Array) -> Array:
        columns = [np.bincount(second, column) / count for column in values.reshape(len(values), -1).T]
        return np.stack(columns, axis=1)

    seconds_s, off = mean(time_s)[:, 0], mean(off_m)
    whole = Steps(mean(steps.sigma_m), steps.tau_s, mean(steps.drift_m2)[:, 0], mean(steps.loose_m))
    return np.asarray(_longest(seconds_s, off, whole)[second])


def _longest(time_s: Array, off_m: Array, steps: Steps) -> Mask:
    """The longest chain of moments, shape (n,)."""
    count = len(time_s)
    one = np.concatenate([steps.variance(time_s, i, np.array([i - 1])) for i in range(1, count)])
    scatter = robust.sigma(np.ravel(np.diff(off_m, axis=0) / np.sqrt(one)), 0.0)
    gate2 = np.square(GATE_SIGMAS * max(1.0, scatter))
    worth, previous = np.ones(count), np.full(count, -1)
    back = np.full((count, 1 + len(LOOKED_BACK_S)), -1)

    def strain(i: int, before: Ints) -> Array:
        """Square of the step to i from others, in units of the gate, shape (b,): no more than 1 is explained; 0 where there is none."""
        there = np.maximum(before, 0)
        share = np.square(off_m[i] - off_m[there]) / (gate2 * steps.variance(time_s, i, there))
        share = np.where((share > 1.0).any(axis=1), np.inf, share.sum(axis=1))
        return np.asarray(np.where(before < 0, 0.0, share))

    for i in range(1, count):
        before = np.arange(int(np.searchsorted(time_s, time_s[i] - LONGEST_S)), i)
        strained = strain(i, before)
        for column in range(1, 1 + len(LOOKED_BACK_S)):
            strained += strain(i, back[before, column])
        # of equal ones the last: it leaves out nothing in between
        reached = (worth[before] + 1.0 - strained)[::-1]
        best = int(np.argmax(reached))
        if reached[best] > 1.0:
            previous[i], worth[i] = before[len(before) - 1 - best], reached[best]
        back[i] = _looked_back(time_s, previous, i)
    kept = np.zeros(count, np.bool_)
    i = int(np.argmax(worth))
    while i >= 0:
        kept[i] = True
        i = int(previous[i])
    # a second that the chain passed by for little, near both its neighbours, did not walk away
    inside = np.flatnonzero(kept)
    for left in np.flatnonzero(~kept).tolist():
        after = int(np.searchsorted(inside, left))
        if 0 < after < len(inside):
            to, on = strain(left, inside[[after - 1]]), strain(int(inside[after]), np.array([left]))
            kept[left] = max(float(to[0]), float(on[0])) <= EASY
    return kept


def _looked_back(time_s: Array, previous: Ints, i: int) -> Ints:
    """Moment i itself, and those of its chain from which a following step is looked at; -1 where it is too short."""
    found, at = [i], i
    for back_s in LOOKED_BACK_S:
        while at >= 0 and time_s[i] - time_s[at] < back_s - 1.5:
            at = int(previous[at])
        found.append(at)
    return np.array(found)


def doubt(time_s: Array, off_m: Array, kept: Mask) -> Array:
    """Variance of the place of the whole, shape (k,) [m^2], from a shift at either end that is never taken back.

    Nobody can tell which side of such a shift is wrong: each is right with a likelihood that is its share of the time.
    Fixes that come back to where they were are not in doubt.
    """
    if kept.all() or not kept.any():
        return np.zeros(off_m.shape[1])
    inside = np.flatnonzero(kept)
    middle = np.median(off_m[kept], axis=0)
    variance = np.zeros(off_m.shape[1])
    for part in (slice(0, inside[0]), slice(inside[-1] + 1, len(kept))):
        if len(time_s[part]):
            share = np.ptp(time_s[part]) / max(np.ptp(time_s), 1e-9)
            variance += share * np.square(np.median(off_m[part], axis=0) - middle)
    return variance
