"""Positions that jump away and come back: a receiver's glitch, as opposed to a shift that lasts.

This is an innovation gate over the whole flight at once. Between two fixes the vehicle moves by its velocity. The rest
of a step is a jump, and the sum of the jumps so far is the level of a fix. The fixes of the level that most of them
share are right. Others are a glitch if the positions come back to that level, or if they stand alone for a few seconds
at either end of the flight. A shift that lasts and is never taken back is kept, because nothing contradicts it.
"""

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label, median_filter

from groundproc.estimation import consensus
from groundproc.estimation.felt import FORCE_M_S2, UNKNOWN_M2_S2, Felt
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

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
SPEED_M_S: Final = 0.3
SPEED_S: Final = 1.5
"""Error of a receiver's velocity, and how long it lasts (1 sigma)."""
BENDING_M_S2: Final = 3.0
"""What a vehicle's acceleration changes by between two fixes (1 sigma): a way from two velocities does not know it."""
AGE_S: Final = 0.2
"""By how much positions are older than the velocity beside them (1 sigma)."""
HEADING: Final = 0.15
"""How far an autopilot's heading is off [rad]: forces are turned by it (1 sigma)."""
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


def judge(
    time_s: Array, enu_m: Array, velocity_m_s: Array | None, sigma_m: Array | None = None, forces: Felt | None = None
) -> Judged:
    """Tell glitches, and what walks away and comes back, from positions.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Increasing.
    enu_m : ndarray, shape (n, 3)
    velocity_m_s : ndarray, shape (n, 3), or None
        As stated; where it does not explain the motion, the median of the steps around is used.
    sigma_m : ndarray, shape (n, 3), optional
        As stated; without, slow walks are not looked for.
    forces : Felt, optional
        How the accelerometers say that the velocity changed.
    """
    if len(time_s) < 3:
        return Judged(np.ones(len(time_s), np.bool_))
    found = _jumps(time_s, enu_m, velocity_m_s)
    if velocity_m_s is None or sigma_m is None or not _explains(time_s, enu_m, velocity_m_s):
        return found
    here = found.kept
    speed, drift, unfelt = velocity_m_s[here], np.zeros(int(here.sum())), np.zeros(int(here.sum()), np.bool_)
    if forces is not None:
        speed, drift, unfelt = _as_felt(
            time_s[here], speed, Felt(forces.velocity_m_s[here], forces.unknown_m2_s2[here])
        )
    walked, farthest_m = _walks(time_s[here], enu_m[here], speed, sigma_m[here], drift)
    walked |= _beside(unfelt, walked)
    kept = here.copy()
    kept[here] = ~walked
    return Judged(kept, max(found.farthest_m, farthest_m), found.shifts)


def _beside(unfelt: Mask, walked: Mask) -> Mask:
    """Runs of one or the other that hold some of the second: who walks away goes there at a speed that nobody felt."""
    number, _ = label(unfelt | walked)
    return np.asarray((number > 0) & np.isin(number, number[walked]))


def _as_felt(time_s: Array, velocity_m_s: Array, forces: Felt) -> tuple[Array, Array, Mask]:
    """Velocities, those bridged that change as nothing was felt, shape (n, 3); the variance that this adds to the way; which they are."""
    count = len(time_s)
    off = velocity_m_s - forces.velocity_m_s
    loose = np.column_stack([FORCE_M_S2 * time_s, HEADING * forces.velocity_m_s[:, :2]])
    steps = consensus.Steps(np.full((count, 3), SPEED_M_S), np.full(3, SPEED_S), forces.unknown_m2_s2, loose)
    kept = consensus.agreeing(time_s, off, steps)
    bridged = forces.velocity_m_s + np.stack([np.interp(time_s, time_s[kept], axis) for axis in off[kept].T], axis=1)
    away_s = np.abs(time_s[:, None] - time_s[kept]).min(axis=1) if not kept.all() else np.zeros(count)
    passed = np.diff(time_s, prepend=time_s[0])
    unknown = np.diff(forces.unknown_m2_s2, prepend=forces.unknown_m2_s2[0]) > 0.0
    gained = np.where(
        kept, 0.0, np.where(unknown, UNKNOWN_M2_S2, 2.0 * np.square(FORCE_M_S2 * away_s) * passed * SPEED_S)
    )
    return np.where(kept[:, None], velocity_m_s, bridged), np.cumsum(gained), ~kept


def _walks(time_s: Array, enu_m: Array, velocity_m_s: Array, sigma_m: Array, drift_m2: Array) -> tuple[Mask, float]:
    """Which positions walk away from the way that velocities tell, shape (n,), and how far; `drift_m2` is what more the way may drift."""
    passed = np.diff(time_s)
    way = np.zeros_like(enu_m)
    way[1:] = np.cumsum(0.5 * (velocity_m_s[1:] + velocity_m_s[:-1]) * passed[:, None], axis=0)
    gained = 2.0 * SPEED_M_S**2 * SPEED_S * passed + np.square(BENDING_M_S2 * passed**2 / 12.0)
    drift = drift_m2 + np.concatenate([[0.0], np.cumsum(gained)])
    off = enu_m - way
    kept = consensus.agreeing(
        time_s, off, consensus.Steps(sigma_m, consensus.POSITION_TAU_S, drift, AGE_S * velocity_m_s)
    )
    walked = ~kept
    inside = np.flatnonzero(kept)
    for end in (slice(0, inside[0]), slice(inside[-1] + 1, len(kept))):
        if len(time_s[end]) and np.ptp(time_s[end]) >= LASTING_S:
            walked[end] = False  # nothing contradicts it
    if not walked.any():
        return walked, 0.0
    right = np.stack([np.interp(time_s[walked], time_s[~walked], axis) for axis in off[~walked].T], axis=1)
    return walked, float(np.linalg.norm(off[walked] - right, axis=1).max())


def _jumps(time_s: Array, enu_m: Array, velocity_m_s: Array | None) -> Judged:
    """What jumps from one fix to the next, and comes back."""
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
    if velocity_m_s is not None and _explains(time_s, enu_m, velocity_m_s):
        speed = 0.5 * (velocity_m_s[1:] + velocity_m_s[:-1])
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


def _explains(time_s: Array, enu_m: Array, velocity_m_s: Array) -> bool:
    """Whether velocities are those of the positions: zeros of a receiver without explain less than the steps themselves."""
    passed, steps = np.diff(time_s)[:, None], np.diff(enu_m, axis=0)
    around = median_filter(steps / passed, size=(_WINDOW, 1), mode="mirror")
    stated = 0.5 * (velocity_m_s[1:] + velocity_m_s[:-1])
    left, left_stated = (np.median(np.linalg.norm(steps - v * passed, axis=1)) for v in (around, stated))
    return bool(left_stated <= 2.0 * left)


def _alike(levels: Array, level: Array, tolerance_m: float) -> Mask:
    """Which levels are the same as one, shape (n,)."""
    apart = np.linalg.norm(levels - level, axis=1)
    return np.asarray(apart <= max(tolerance_m, ALIKE * float(apart.max())))
