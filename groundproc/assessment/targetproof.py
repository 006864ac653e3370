"""Whether what was fitted as a flat target is one.

It has to explain most of what its points show, each of its parts has to be there and bright or dark as it should be, what it leaves
unexplained has to be noise, and nothing that is painted on roads may explain the same as well.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.special import ndtr

from groundproc.assessment import patternfit
from groundproc.assessment.patternfit import BLUR, HALF, TURN, WIDTH, Fit, U, V
from groundproc.assessment.patterns import BOARD, CROSS, DISC, RIVALS, TARGETS, Pattern, turned

Array = npt.NDArray[np.float64]

TOLD: Final = {BOARD.name: 0.7, CROSS.name: 0.6, DISC.name: 0.7}
"""Share of the variance that a target has to explain. Of a cross less is bright, so noise takes more; one square of a board is a disc of
0.6, and ground of many shades has boards of 0.65."""
_FEWEST_OF_BOARD: Final = 30
"""Points of a board: on fewer, grounds of spots look like one."""
_SAME_SHADE: Final = 0.25
"""Of the contrast: opposite squares differ by less, and by no more than noise and a tenth of the contrast (gloss, dirt)."""
_DIRT: Final = 0.1
_SURE: Final = 0.9
"""From which on a cross is no disc, nor a disc a cross: none explains so much of the other."""
_CLEAR: Final = 0.2
"""Of the way from dark to bright, by which each part has to lie on its side of the middle."""
_BETTER: Final = 6.0
"""BIC by which a target has to be better than what it might be instead: odds of twenty (Kass and Raftery 1995, "strong")."""
_ALIKE: Final = 0.6
"""Mean square between neighbours over that between any two points: 1 for noise, less where there is more to see than the target."""
_FOR_RIVALS: Final = 400
"""Points by which a target is told from what it might be instead."""


def why_not(pattern: Pattern, u: Array, v: Array, value: Array, found: Fit) -> str | None:
    """What speaks against a candidate, in words; None where nothing does.

    Parameters
    ----------
    pattern : Pattern
    u, v : ndarray, shape (n,)
        Places of its points in the plane [m].
    value : ndarray, shape (n,)
        Their intensities.
    found : Fit
        Of the pattern to these points.
    """
    least = TOLD[pattern.name]
    if found.told < least:
        return f"it explains {found.told:.0%} of what the intensities show, expected {least:.0%} or more"
    if pattern is BOARD and len(u) < _FEWEST_OF_BOARD:
        return f"{len(u)} points lie on it, expected {_FEWEST_OF_BOARD} or more"
    if pattern is BOARD and not _two_shades(u, v, value, found):
        return "opposite squares are not of one shade"
    if not _whole(pattern, u, v, value, found):
        return "a part of it is missing, or not as bright or dark as it should be"
    if not _plain(u, v, value, found):
        return "there is more to see than the target"
    rival = _better(pattern, u, v, value, found)
    return None if rival is None else f"{rival} explains the same as well"


def _two_shades(u: Array, v: Array, value: Array, found: Fit) -> bool:
    """Whether the squares of a board that lie across from each other are alike: slabs of many shades meet at four corners too."""
    x, y = turned(u, v, found.values)
    right, up = ndtr(x / found.values[BLUR]), ndtr(y / found.values[BLUR])
    squares = np.column_stack([(1.0 - right) * (1.0 - up), right * (1.0 - up), (1.0 - right) * up, right * up])
    root = np.sqrt(found.weight)
    design, shown = squares * root[:, None], value * root
    normal = design.T @ design
    if np.linalg.matrix_rank(normal) < 4:
        return False
    inverse = np.linalg.inv(normal)
    shade = inverse @ (design.T @ shown)
    variance = float(np.sum((shown - design @ shade) ** 2)) / max(len(u) - 4, 1)
    contrast = abs(found.bright - found.dark)
    for way in (np.array([1.0, 0.0, 0.0, -1.0]), np.array([0.0, 1.0, -1.0, 0.0])):
        apart, sigma = abs(float(way @ shade)), float(np.sqrt(variance * (way @ inverse @ way)))
        if apart > min(_SAME_SHADE * contrast, 3.0 * sigma + _DIRT * contrast):
            return False
    return True


def _whole(pattern: Pattern, u: Array, v: Array, value: Array, found: Fit) -> bool:
    """Whether every part of a target is there, and of the brightness it should have."""
    x, y = turned(u, v, found.values)
    half, width, blur = (float(found.values[k]) for k in (HALF, WIDTH, BLUR))
    # of the dark parts and of the bright ones: parts that need points, and how many of them may be without
    if pattern is BOARD:
        number = (x > 0).astype(int) + 2 * (y > 0)
        return _sides(found, value, [(number == k, k in (0, 3)) for k in range(4)], 3, 0)
    away, angle = np.hypot(x, y), np.arctan2(y, x)
    if pattern is DISC:
        ring = away > half + blur
        part = np.floor((angle + np.pi) / (np.pi / 4.0)).astype(int) % 8
        return _sides(found, value, [(ring & (part == k), False) for k in range(8)], 1, 1) and _sides(
            found, value, [(away < max(half - 0.5 * blur, 0.5 * half), True)], 4, 0
        )
    quarter = np.floor((angle + np.pi / 4.0) / (np.pi / 2.0)).astype(int) % 4
    short, far = np.minimum(np.abs(x), np.abs(y)), np.maximum(np.abs(x), np.abs(y))
    if not 1.6 * width < half:
        return False
    arm = (short <= width) & (far > width) & (far < half)
    end = (short <= width) & (far > half + blur)
    notch = (short > width + blur) & (away < half)
    between = np.floor((angle + np.pi) / (np.pi / 2.0)).astype(int) % 4
    return (
        _sides(found, value, [(arm & (quarter == k), True) for k in range(4)], 2, 0)
        and _sides(found, value, [(end & (quarter == k), False) for k in range(4)], 1, 1)
        and _sides(found, value, [(notch & (between == k), False) for k in range(4)], 2, 0)
    )


def _sides(
    found: Fit, value: Array, parts: list[tuple[npt.NDArray[np.bool_], bool]], fewest: int, missing: int
) -> bool:
    """Whether each part has points enough, and their mean lies on its side of the middle between dark and bright."""
    contrast = found.bright - found.dark
    for part, figure in parts:
        if int(part.sum()) < fewest:
            missing -= 1
            if missing < 0:
                return False
            continue
        level = (float(value[part].mean()) - found.dark) / contrast
        clear = (level - 0.5) * (1.0 if figure else -1.0)
        as_fitted = abs(level - float(found.share[part].mean())) <= _CLEAR
        if clear <= 0.0 or not (clear >= _CLEAR or as_fitted):
            return False
    return True


def _plain(u: Array, v: Array, value: Array, found: Fit) -> bool:
    """Whether what is left is noise: of neighbours no more alike than of any two points (after von Neumann 1941)."""
    left = (value - found.dark - (found.bright - found.dark) * found.share) * np.sqrt(found.weight)
    _, two = cKDTree(np.column_stack([u, v])).query(np.column_stack([u, v]), 2)
    nearest = np.asarray(two)
    return float(np.mean((left - left[nearest[:, 1]]) ** 2)) > 2.0 * _ALIKE * float(np.var(left))


def _better(pattern: Pattern, u: Array, v: Array, value: Array, found: Fit) -> str | None:
    """What is no such target and explains the same points nearly as well."""
    if len(u) > _FOR_RIVALS:
        step = -(-len(u) // _FOR_RIVALS)
        u, v, value = u[::step], v[::step], value[::step]
        found = patternfit.fit(pattern, u, v, value, found.values, found.weight[::step])
    own = found.bic()
    others = [each for each in TARGETS if each is not pattern and each is not BOARD]
    for rival in (*RIVALS, *others):
        if pattern is not BOARD and rival in others and found.told > _SURE:
            continue
        # another kind of target has its centre at the same place: the likelier one will do
        margin = 0.0 if rival in others else _BETTER
        if _rival(rival, u, v, value, found) < own + margin:
            return f"{'an' if rival.name[0] in 'aeiou' else 'a'} {rival.name}"
    return None


def _rival(rival: Pattern, u: Array, v: Array, value: Array, found: Fit) -> float:
    """BIC of a rival, from the best of several starts."""
    middle_u, middle_v = float(np.median(u)), float(np.median(v))
    size = float(np.hypot(u - middle_u, v - middle_v).max())
    starts = [
        patternfit.first({
            U: middle_u + r * size * np.cos(a), V: middle_v + r * size * np.sin(a), TURN: t, WIDTH: w * size, HALF: 0.5 * size,
            BLUR: found.values[BLUR],
        })
        for r, a in ((0.0, 0.0), *((0.4, k * np.pi / 4.0) for k in range(8)))
        for t in np.arange(8) * np.pi / 4.0
        for w in (0.1, 0.25)
    ]  # fmt: skip
    costs = [_cost(rival, u, v, value, found.weight, start) for start in starts]
    best = np.argsort(costs)[:2]
    return min(patternfit.fit(rival, u, v, value, starts[k], found.weight).bic() for k in best)


def _cost(pattern: Pattern, u: Array, v: Array, value: Array, weight: Array, values: Array) -> float:
    share = pattern.at(u, v, values)
    total = weight.sum()
    mean_s, mean_v = float(weight @ share) / total, float(weight @ value) / total
    ds, dv = share - mean_s, value - mean_v
    return float(weight @ dv**2 - (weight @ (ds * dv)) ** 2 / max(weight @ ds**2, 1e-12))
