"""Targets of any kind near surveyed points: found by themselves, one or none."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.assessment import balls, flattargets
from groundproc.assessment.target import KINDS, SEARCH_M, SPHERE, Target

Array = npt.NDArray[np.float64]

REACH_M: Final = flattargets.REACH_M
"""Points so far from a surveyed point are looked at."""
_SAME_M: Final = 0.05
_CLEARER: Final = 2.0
"""By which one of two targets has to explain more, to be the one."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to look for.

    Attributes
    ----------
    kinds : sequence of str
        Of `target.KINDS`.
    size_m : float or None
        Diameter of discs and spheres, length of crosses, where it is known.
    """

    kinds: Sequence[str] = KINDS
    size_m: float | None = None


@dataclass(frozen=True, slots=True)
class Missing:
    """No target.

    Attributes
    ----------
    reason : str
    ambiguous : bool
        There are several: which of them was surveyed cannot be told, so that nothing should be said of the place.
    """

    reason: str
    ambiguous: bool = False


def find(place_m: Array, xyz_m: Array, intensity: Array | None, wanted: Wanted) -> Target | Missing:
    """The target near a surveyed point, or why there is none.

    Parameters
    ----------
    place_m : ndarray, shape (3,)
    xyz_m : ndarray, shape (n, 3)
    intensity : ndarray, shape (n,), or None
    wanted : Wanted
    """
    near = np.linalg.norm(xyz_m - place_m, axis=1) <= REACH_M
    if not near.any():
        return Missing(f"no point within {REACH_M:g} m")
    xyz = xyz_m[near]
    flat = tuple(kind for kind in wanted.kinds if kind != SPHERE)
    found: list[Target] = []
    doubts: list[flattargets.Doubt] = []
    if intensity is not None and flat:
        found, doubts = flattargets.find(place_m, xyz, intensity[near], flat, wanted.size_m)
    if not found and SPHERE in wanted.kinds:
        plane = flattargets.largest(xyz - place_m)
        on = np.zeros(len(xyz), np.bool_)
        if plane is not None:
            on = np.abs(plane.of(xyz - place_m)[:, 2]) <= flattargets.OFF_M
        ball = balls.find(place_m, xyz, on, wanted.size_m)
        found = [] if ball is None else [ball]
    return _one_of(found) if found else _none(doubts, intensity is None and bool(flat))


def _none(doubts: Sequence[flattargets.Doubt], unlit: bool) -> Missing:
    """Why there is none."""
    if unlit:
        return Missing("no target can be found: the points have no intensity")
    reason = f"no target found within {SEARCH_M:g} m"
    if doubts:
        best = max(doubts, key=lambda each: each.told)
        reason += f"; what may be a {best.kind} is not taken for one: {best.why}"
    return Missing(reason)


def _one_of(found: Sequence[Target]) -> Target | Missing:
    """The one that explains most, unless another elsewhere explains nearly as much."""
    best = found[0]
    for other in found[1:]:
        apart = float(np.linalg.norm(other.centre_m - best.centre_m))
        if apart < 0.5 * best.size_m and best.told >= other.told:
            # a square of a board is something of a disc
            continue
        if apart > _SAME_M and best.told * best.points < _CLEARER * other.told * other.points:
            return Missing(
                f"several targets within {SEARCH_M:g} m: a {best.kind} and a {other.kind}, {apart:.2f} m apart",
                ambiguous=True,
            )
    return best
