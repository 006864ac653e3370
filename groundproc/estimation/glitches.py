"""Positions that jump away and come back: a receiver's glitch, told from a shift that lasts.

An innovation gate over the whole flight at once. Between two fixes the vehicle moves by its velocity; what a step has beyond that
is a jump, and the sum of the jumps so far is the level of a fix. The fixes of the level that most of them share are right. Others
are a glitch where the positions come back to that level, or where they stand alone for a few seconds at either end. A shift that
lasts and is never taken back is kept, because nothing contradicts it.
"""

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from groundproc.numerics import robust

Array = npt.NDArray[np.float64]

GATE_M: Final = 10.0
"""A step may miss what the velocity explains by this much; receivers and filters correct themselves by a few metres."""
GATE_SIGMAS: Final = 8.0
"""Or by so many standard deviations of all steps, for receivers that are noisier."""
ACCELERATION_M_S2: Final = 20.0
"""What a vehicle may do between two fixes without being seen."""
ALIKE: Final = 0.2
"""Two levels are the same if they differ by less than this share of the jump between them: positions move on while they are off."""
LASTING_S: Final = 10.0
"""A shift at the beginning or the end counts as one from here on."""
_WINDOW: Final = 9
"""Steps in the running median that stands in for a velocity."""


@dataclass(frozen=True, slots=True)
class Judged:
    """Which fixes hold.

    Attributes
    ----------
    kept : ndarray of bool, shape (n,)
    farthest_m : float
        Largest distance of one that does not from where it should have been.
    shifts : tuple of (float, float)
        Time [s] and size [m] of the jumps between fixes that were kept.
    """

    kept: npt.NDArray[np.bool_]
    farthest_m: float = 0.0
    shifts: tuple[tuple[float, float], ...] = ()


def judge(time_s: Array, enu_m: Array, velocity_m_s: Array | None) -> Judged:
    """Tell glitches from positions.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Increasing.
    enu_m : ndarray, shape (n, 3)
    velocity_m_s : ndarray, shape (n, 3), or None
        As stated; where it does not explain the motion, the median of the steps around is used.
    """
    if len(time_s) < 3:
        return Judged(np.ones(len(time_s), np.bool_))
    missed, size, gate = _missed(time_s, enu_m, velocity_m_s)
    jumps = np.flatnonzero(size > gate)
    if not len(jumps):
        return Judged(np.ones(len(time_s), np.bool_))
    levels = np.concatenate([np.zeros((1, 3)), np.cumsum(missed[jumps], axis=0)])
    first, last = np.append(0, jumps + 1), np.append(jumps, len(time_s) - 1)
    tolerance = gate[jumps].max()
    counts = last - first + 1
    support = [int(counts[_alike(levels, level, tolerance)].sum()) for level in levels]
    at_main = _alike(levels, levels[int(np.argmax(support))], tolerance)
    holds = at_main.copy()
    right = np.flatnonzero(at_main)
    for i in np.flatnonzero(~at_main):
        contradicted = right[0] < i < right[-1]
        holds[i] = not contradicted and time_s[last[i]] - time_s[first[i]] >= LASTING_S
    off_m = np.linalg.norm(levels - levels[right[0]], axis=1)
    kept_parts = np.flatnonzero(holds)
    shifts = [
        (float(time_s[first[b]]), float(np.linalg.norm(levels[b] - levels[a])))
        for a, b in itertools.pairwise(kept_parts)
        if at_main[a] != at_main[b] or not at_main[a]
    ]
    kept = np.repeat(holds, counts)
    return Judged(kept, float(off_m[~holds].max(initial=0.0)), tuple(shifts))


def _missed(time_s: Array, enu_m: Array, velocity_m_s: Array | None) -> tuple[Array, Array, Array]:
    """What each step has beyond the velocity, shape (n - 1, 3) [m], its size, and the gate for it."""
    passed = np.diff(time_s)[:, None]
    steps = np.diff(enu_m, axis=0)
    speed = median_filter(steps / passed, size=(_WINDOW, 1), mode="mirror")
    if velocity_m_s is not None:
        stated = 0.5 * (velocity_m_s[1:] + velocity_m_s[:-1])
        # zeros of a receiver without velocity explain less than the steps themselves
        left, left_stated = (np.median(np.linalg.norm(steps - v * passed, axis=1)) for v in (speed, stated))
        speed = stated if left_stated <= 2.0 * left else speed
    missed = steps - speed * passed
    spread = float(np.linalg.norm(robust.sigma_of_columns(missed, np.median(missed, axis=0))))
    gate = max(GATE_M, GATE_SIGMAS * spread) + 0.5 * ACCELERATION_M_S2 * np.square(passed[:, 0])
    calm = np.linalg.norm(missed, axis=1) <= gate
    if calm.any() and not calm.all():
        # where positions jump about, so do the speeds between them: those before and after count
        middle_s = 0.5 * (time_s[1:] + time_s[:-1])
        around = np.stack([np.interp(middle_s[~calm], middle_s[calm], axis[calm]) for axis in speed.T], axis=1)
        missed[~calm] = steps[~calm] - around * passed[~calm]
    return missed, np.linalg.norm(missed, axis=1), gate


def _alike(levels: Array, level: Array, tolerance_m: float) -> npt.NDArray[np.bool_]:
    """Which levels are the same as one, shape (n,)."""
    apart = np.linalg.norm(levels - level, axis=1)
    return np.asarray(apart <= max(tolerance_m, ALIKE * float(apart.max())))
