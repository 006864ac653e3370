"""Targets painted on something flat: a checkerboard of four squares, a cross, a disc.

Planes near the surveyed point are examined one after the other, the largest first, so that a panel that leans on the
ground is seen in its own plane. On each, patterns are searched for and fitted. A pattern is accepted as a target only
if it explains most of what the points show, if each of its parts is there and as bright or dark as it should be, and
if nothing that is painted on roads explains the same as well.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.assessment import patternfit, patternsearch
from groundproc.assessment.patternfit import BLUR, HALF, TURN, WIDTH, Fit, U, V
from groundproc.assessment.patterns import BOARD, CROSS, DISC, TARGETS, Pattern, turned
from groundproc.assessment.target import SEARCH_M, Target
from groundproc.assessment.targetproof import TOLD, why_not

Array = npt.NDArray[np.float64]

HALVES_M: Final = np.array([0.1, 0.12, 0.145, 0.175, 0.21, 0.25, 0.3, 0.36, 0.43, 0.52, 0.62])
"""Half sizes that are tried."""
REACH_M: Final = 1.3
OFF_M: Final = 0.05
"""Points so far from a plane are of it."""
_PLANES: Final = 3
_TRIALS: Final = 60
_FEWEST: Final = 25
_MOST: Final = 4000
_CANDIDATES: Final = 3
_USED: Final = 0.9
"""Of a board: its rim is half seen."""
_LESS: Final = 0.05
"""Share of the variance that a larger board may explain less, by chance."""
_NEARLY: Final = 0.2
"""Share of the variance by which a target has to explain more than a board that is not sure: one of its squares looks like a disc."""
_SHARP_M: Final = 0.03
_SHARP: Final = 1.0 / 6.0
"""Sigma of a centre, at most, by itself and in half a size: what is known no better is no target seen."""
_FOOTPRINT: Final = 0.05
"""Of the blur: by so much, one sigma, an echo of dark and bright together comes from the bright part, which noise does not tell."""
_KINDS: Final = {BOARD.name: patternsearch.BOARD, CROSS.name: patternsearch.CROSS, DISC.name: patternsearch.DISC}


@dataclass(frozen=True, slots=True)
class Plane:
    """A plane.

    Attributes
    ----------
    origin_m : ndarray, shape (3,)
    axes : ndarray, shape (3, 3)
        Columns u, v, normal.
    """

    origin_m: Array
    axes: Array

    def of(self, xyz_m: Array) -> Array:
        """Places u, v and off the plane, shape (n, 3)."""
        return np.asarray((xyz_m - self.origin_m) @ self.axes)


@dataclass(frozen=True, slots=True)
class Doubt:
    """What looked like a target and is taken for none.

    Attributes
    ----------
    kind : str
    told : float
        Share of the variance of the intensities that it would explain.
    why : str
    """

    kind: str
    told: float
    why: str


def find(
    place_m: Array, xyz_m: Array, intensity: Array, kinds: tuple[str, ...], size_m: float | None
) -> tuple[list[Target], list[Doubt]]:
    """Targets near a surveyed point, of the first plane that has one; and what was taken for none.

    Parameters
    ----------
    place_m : ndarray, shape (3,)
    xyz_m : ndarray, shape (n, 3)
    intensity : ndarray, shape (n,)
    kinds : tuple of str
        Names of `TARGETS` that are looked for.
    size_m : float or None
        Known diameter of discs and length of crosses.
    """
    near = np.linalg.norm(xyz_m - place_m, axis=1) <= REACH_M
    every, value = xyz_m[near] - place_m, intensity[near]
    left, doubts = every, []
    for _ in range(_PLANES):
        plane = largest(left)
        if plane is None:
            break
        if abs(plane.of(np.zeros((1, 3)))[0, 2]) <= SEARCH_M:
            on = np.abs(plane.of(every)[:, 2]) <= OFF_M
            found = _on_plane(plane, every[on], value[on], kinds, size_m)
            doubtful = [each for each in found if isinstance(each, Doubt)]
            # of a board that is not sure a square may still look like a disc
            board = max((each.told for each in doubtful if each.kind == BOARD.name), default=0.0)
            targets = [
                each
                for each in found
                if isinstance(each, Target) and (each.told >= board + _NEARLY or each.kind == BOARD.name)
            ]
            if targets:
                targets = [replace(each, centre_m=each.centre_m + place_m) for each in targets]
                return sorted(targets, key=lambda each: -each.told * each.points), []
            doubts += doubtful
        left = left[np.abs(plane.of(left)[:, 2]) > OFF_M]
    return [], doubts


def largest(xyz: Array) -> Plane | None:
    """The plane with most points (Fischler and Bolles 1981), about the place nearest to the origin."""
    if len(xyz) < _FEWEST:
        return None
    rng = np.random.default_rng(0)
    three = xyz[rng.integers(0, len(xyz), (_TRIALS, 3))]
    normal = np.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    length = np.linalg.norm(normal, axis=1)
    # three points on a line, or next to each other, tell none
    normal, three = normal[length > 0.02] / length[length > 0.02, None], three[length > 0.02]
    if not len(normal):
        return None
    off = np.abs(xyz @ normal.T - np.einsum("ij,ij->i", three[:, 0], normal))
    best = int(np.argmax((off <= OFF_M).sum(axis=0)))
    on = off[:, best] <= OFF_M
    return fitted(xyz[on]) if on.sum() >= _FEWEST else None


def fitted(xyz: Array) -> Plane:
    """The plane of least squares, robust against what lies off it; its origin is its place nearest to that of the points."""
    keep = np.ones(len(xyz), np.bool_)
    for _ in range(3):
        middle = xyz[keep].mean(axis=0)
        _, _, axes = np.linalg.svd(xyz[keep] - middle, full_matrices=False)
        normal = axes[2]
        off = (xyz - middle) @ normal
        keep = np.abs(off) <= 3.0 * max(float(np.sqrt(np.mean(off[keep] ** 2))), 2e-3)
    if normal[np.argmax(np.abs(normal))] < 0.0:
        normal = -normal
    u = np.cross(np.eye(3)[int(np.argmin(np.abs(normal)))], normal)
    u /= np.linalg.norm(u)
    return Plane(normal * (middle @ normal), np.column_stack([u, np.cross(normal, u), normal]))


def _on_plane(
    plane: Plane, xyz: Array, value: Array, kinds: tuple[str, ...], size_m: float | None
) -> list[Target | Doubt]:
    if len(xyz) < _FEWEST or np.ptp(value) == 0.0:
        return []
    found: list[Target | Doubt] = []
    for pattern in TARGETS:
        if pattern.name in kinds:
            found += _of_kind(pattern, plane, xyz, value, size_m)
    return found


def _of_kind(pattern: Pattern, plane: Plane, xyz: Array, value: Array, size_m: float | None) -> list[Target | Doubt]:
    sized = size_m is not None and pattern is not BOARD
    halves = np.array([0.5 * size_m]) if sized and size_m is not None else HALVES_M
    place = plane.of(xyz)
    step = -(-len(xyz) // _MOST)
    some = patternsearch.candidates(
        place[::step, 0], place[::step, 1], value[::step], _KINDS[pattern.name], halves, SEARCH_M, _CANDIDATES
    )
    found: list[Target | Doubt] = []
    for u, v, turn, half, _ in some:
        here = np.array([u, v])
        targets = [each for each in found if isinstance(each, Target)]
        if any(np.linalg.norm(plane.of(each.centre_m[None])[0, :2] - here) < 0.5 * each.size_m for each in targets):
            continue
        start = patternfit.first({U: u, V: v, TURN: turn, HALF: half, WIDTH: 0.25 * half})
        each = _confirmed(pattern, plane, xyz, value, start, fixed=(HALF,) if sized else ())
        if each is not None:
            found.append(each)
    return found


def _confirmed(
    pattern: Pattern, plane: Plane, xyz: Array, value: Array, start: Array, fixed: tuple[int, ...]
) -> Target | Doubt | None:
    """A candidate fitted in a plane of its own points; a doubt or nothing where it is no target."""
    half = float(start[HALF])
    for again in range(2):
        place = plane.of(xyz)
        close = _support(pattern, place, start, half)
        if close.sum() < _FEWEST - 5:
            return None
        found = patternfit.fit(pattern, place[close, 0], place[close, 1], value[close], start, fixed=fixed)
        centre = plane.origin_m + plane.axes[:, :2] @ found.values[[U, V]]
        half = float(found.values[HALF]) if pattern is not BOARD else half
        if again == 0:
            if found.told < 0.7 * TOLD[pattern.name]:
                return None
            around = np.linalg.norm(xyz - centre, axis=1) <= max(1.2 * half, 0.15)
            if around.sum() < 10:
                return None
            plane = fitted(xyz[around])
            if pattern is BOARD:
                half = _grown(half, place, value, found)
            start = found.values.copy()
            start[[U, V]] = plane.of(centre[None])[0, :2]
            start[TURN] = _same_turn(plane, place[close], found, xyz[close])
    u, v, shown = place[close, 0], place[close, 1], value[close]
    why = why_not(pattern, u, v, shown, found)
    if why is not None:
        return Doubt(pattern.name, found.told, why)
    found = patternfit.placed(found, u, v, shown, fixed)
    sigma, most = float(np.sqrt(np.diag(found.covariance_m2).max())), min(_SHARP_M, _SHARP * half)
    if sigma > most:
        why = f"its centre would be known to {1e3 * sigma:.0f} mm, expected {1e3 * most:.0f} mm or better"
        return Doubt(pattern.name, found.told, why)
    centre = plane.origin_m + plane.axes[:, :2] @ found.values[[U, V]]
    if np.linalg.norm(centre) > SEARCH_M:
        return None
    across = _off_sigma(plane, place, found.values[[U, V]], half)
    covariance = plane.axes[:, :2] @ found.covariance_m2 @ plane.axes[:, :2].T
    covariance += across**2 * np.outer(plane.axes[:, 2], plane.axes[:, 2])
    covariance += (_FOOTPRINT * found.values[BLUR]) ** 2 * np.eye(3)
    return Target(pattern.name, centre, covariance, 2.0 * half, int(close.sum()), found.told)


def _grown(half: float, place: Array, value: Array, found: Fit) -> float:
    """Half the size of a board, as far as its squares go on: the search prefers the part that is clearest."""
    u, v = turned(place[:, 0], place[:, 1], found.values)
    away, share = np.maximum(np.abs(u), np.abs(v)), BOARD.at(place[:, 0], place[:, 1], found.values)
    away[np.abs(place[:, 2]) > OFF_M] = np.inf

    def told(size: float) -> float:
        on = away <= _USED * size
        return float(np.corrcoef(share[on], value[on])[0, 1] ** 2)

    # beyond the rim less is told by the same squares; within it more, as fewer points lie on the lines between them
    least = told(half) - _LESS
    return max([half, *(float(wider) for wider in HALVES_M if wider > half and told(wider) >= least)])


def _same_turn(plane: Plane, place: Array, found: Fit, xyz: Array) -> float:
    """The turn of a pattern in another plane: by the way of its first axis."""
    solution, *_ = np.linalg.lstsq(
        np.column_stack([place[:, :2], np.ones(len(place))]), plane.of(xyz)[:, :2], rcond=None
    )
    way = np.array([np.cos(found.values[TURN]), np.sin(found.values[TURN])]) @ solution[:2]
    return float(np.arctan2(way[1], way[0]))


def _support(pattern: Pattern, place: Array, values: Array, half: float) -> npt.NDArray[np.bool_]:
    """Points that are to be explained: of a board its inner part, of the others what lies around them too."""
    u, v = turned(place[:, 0], place[:, 1], values)
    on = np.abs(place[:, 2]) <= OFF_M
    if pattern is BOARD:
        return np.asarray(on & (np.maximum(np.abs(u), np.abs(v)) <= _USED * half))
    return np.asarray(on & (np.hypot(u, v) <= 1.6 * half))


def _off_sigma(plane: Plane, place: Array, at: Array, half: float) -> float:
    """Sigma of the plane's height over a place of it."""
    near = (np.hypot(*(place[:, :2] - at).T) <= max(1.2 * half, 0.15)) & (np.abs(place[:, 2]) <= OFF_M)
    design = np.column_stack([np.ones(int(near.sum())), place[near, :2] - at])
    off = place[near, 2]
    variance = float(off @ off) / max(len(off) - 3, 1)
    return float(np.sqrt(variance * np.linalg.pinv(design.T @ design)[0, 0]))
