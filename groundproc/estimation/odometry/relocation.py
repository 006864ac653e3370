"""One map laid on another, metres away: its place is searched within its sigma, and accepted only if it is the only one.

Coarse: every shift and heading within reach is tried on a grid that says which cubes hold what stands and which hold
ground (the idea of correlative matching, Olson 2009). Fine: from the best separate places, points are fitted to planes
with six unknowns, within a narrowing reach (`laying`).

A false place is worse than none. So four conditions must hold. Enough points of what stands lie on surfaces. Most of
what the other map could show is there. Every direction is observed (along a corridor one is not). And far more points
favour this place than any other a metre away (in a row of equal windows they do not).
"""

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.odometry.laying import INFLATION, Flags, Laid, Target
from groundproc.estimation.odometry.seeking import starts
from groundproc.estimation.odometry.surfaces import FILLED, GROUND, STANDING, Surfaces, thinned

Array = npt.NDArray[np.float64]

REACH_SIGMAS: Final = 3.5
MARGIN: Final = np.array([1.0, 1.0, 1.0, np.deg2rad(1.0)])
WIDEST: Final = np.array([60.0, 60.0, 45.0, np.deg2rad(15.0)])
"""How far east, north, up [m] and about the vertical [rad] a place is sought: so many sigmas and a margin. Where that is more than the
widest, the true place may lie outside, and nothing is sought."""
RADIUS_M: Final = 45.0
"""Of the map that is laid, what is so near to its middle."""
HIGHEST_M: Final = 80.0
"""What lies so far above or below is not looked at."""
APART_M: Final = 1.0
"""Places so far apart are two."""
FEWEST_ON: Final = 60
LEAST_SHARE: Final = 0.6
"""Of the points that could be shown, this share has to be there."""
SURER: Final = 2.5
"""Of the points that lie on surfaces at only one of two places, those of the better place have to prevail by so many
sigmas of chance (McNemar 1947)."""
HELD_M: Final = 0.1
HELD_RAD: Final = np.deg2rad(0.5)
"""How well the least observed direction has to be known."""
FLOOR: Final = np.repeat([np.deg2rad(0.05), 0.02], 3)
"""What is claimed of turn [rad] and shift [m] at best."""


def laid(given: Surfaces, other: Surfaces, about_m: Array, sigma: Array) -> Laid | None:
    """Lay what a map holds on another; None where it can lie nowhere, or not with certainty.

    Parameters
    ----------
    given, other : Surfaces
        On axes that differ by no more than what is sought.
    about_m : ndarray, shape (3,)
        Middle of the first, about which it turns.
    sigma : ndarray, shape (4,)
        Of east, north and up [m], and of the heading [rad].
    """
    reach = REACH_SIGMAS * sigma + MARGIN
    if (reach > WIDEST).any():
        return None
    mine = thinned(given.near(about_m, RADIUS_M))
    theirs = other.near(about_m, RADIUS_M + float(reach[:2].max()))
    theirs = theirs.of(np.abs(theirs.place_m[:, 2] - about_m[2]) < HIGHEST_M)
    if (mine.kind != GROUND).sum() < FEWEST_ON or np.isin(theirs.kind, (STANDING, FILLED)).sum() < FEWEST_ON:
        return None
    target = Target(theirs)
    found = [target.closest(mine, about_m, start) for start in starts(mine, theirs, about_m, reach)]
    return _chosen([each for each in found if each is not None], reach)


def _chosen(found: list[Laid], reach: Array) -> Laid | None:
    """The best place, where it passes all tests."""
    if not found:
        return None
    best = max(found, key=lambda each: int(each.on.sum()))
    others = [each for each in found if best.off(each, RADIUS_M / 3.0) > APART_M]
    surest = min((surer(best.on, each.on) for each in others), default=np.inf)
    sigma, on = np.sqrt(np.diag(best.covariance)), int(best.on.sum())
    good = (
        on >= FEWEST_ON
        and on >= LEAST_SHARE * best.known.sum()
        and surest > SURER
        and sigma[3:].max() < HELD_M
        and sigma[:3].max() < HELD_RAD
        and (np.abs(best.shift_m) <= reach[:3]).all()
    )
    return replace(best, covariance=best.covariance + np.diag(FLOOR**2), surer=surest) if good else None


def surer(one: Flags, other: Flags) -> float:
    """By how many sigmas of chance more points lie on surfaces at one of two places than at the other; neighbours share their errors."""
    for_one, for_other = int((one & ~other).sum()), int((other & ~one).sum())
    return (for_one - for_other) / float(np.sqrt(INFLATION * max(for_one + for_other, 1)))
