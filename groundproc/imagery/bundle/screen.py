"""Adjustment with wrong observations found: measurements of others are believed unless gross, matches of the machine are not."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.imagery.bundle.block import LIDAR, Block, PointRows
from groundproc.imagery.bundle.covariance import Balance, Cofactors, balance, cofactors, traces
from groundproc.imagery.bundle.intersection import intersect
from groundproc.imagery.bundle.observed import pose_residuals, whitening
from groundproc.imagery.bundle.solve import Solved, image_residuals, normal_of, row_residuals, solve
from groundproc.imagery.bundle.unknowns import lay_out
from groundproc.imagery.rig import RigCamera
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Progress = Callable[[int, float], None]

GROSS: Final = 10.0
"""A measurement of others is a blunder beyond so many sigmas, or so many times what is usual where that is more."""
WRONG: Final = 4.0
"""A match of the machine is wrong beyond so many times what is usual."""
MOST_ROUNDS: Final = 8
LEAST_CHANGE: Final = 1e-4
"""Rounds end where less than this part of the measurements comes or goes."""
LEAST_ANGLE_RAD: Final = float(np.deg2rad(0.3))
"""Rays that meet under less do not make a point."""
ROUGH: Final = 1e-6
"""Part of the sum of squares at which steps end while weights still change."""
MOST_SOFT: Final = 12
SOFT_STEPS: Final = 5
_NORMAL: Final = 1.1774
"""Median length of two unit normals."""
_PRIOR_BEND: Final = 4.0
"""Distance of an observed pose [sigma] beyond which it loses weight (Huber)."""


@dataclass(frozen=True, slots=True)
class Adjusted:
    """A block adjusted, and what was left out.

    Attributes
    ----------
    solved : Solved
    found : Cofactors
    balance : Balance
    left_out : Mask, shape (n,)
        Of the measurements as they came.
    reasons : dict
        How many were left out, and why.
    sigma_px : float
        What the sigma of an image point was multiplied by.
    """

    solved: Solved
    found: Cofactors
    balance: Balance
    left_out: Mask
    reasons: dict[str, int]
    sigma_px: float


def adjust(
    block: Block, known: tuple[RigCamera, ...], matched: Mask, progress: Progress | None = None, begun: bool = False
) -> Adjusted:
    """Adjust, find what is wrong, and adjust again.

    Parameters
    ----------
    block : Block
        With all measurements at weight 1.
    known : tuple of RigCamera
    matched : ndarray of bool, shape (n,)
        Measurements that the machine found; the others come from people.
    progress : callable, optional
    begun : bool
        Whether the block was adjusted before: what is wrong shows at once.
    """
    if begun:
        block, _ = _screened(block, matched)
    block, factor = _without_single(block), 1.0
    if matched.any() and not begun:
        block = _led(block, known, matched, progress)
    solved = solve(block, known, progress, settled_at=ROUGH)
    for _ in range(MOST_ROUNDS):
        block, changed = _screened(solved.block, matched)
        block = _weighed_priors(_without_single(block))
        if changed < LEAST_CHANGE * len(matched) and np.array_equal(block.priors.weight, solved.block.priors.weight):
            break
        solved = solve(block, known, progress, settled_at=ROUGH)
    solved = solve(solved.block, known, progress)
    if matched.any():
        solved, factor = _scaled(solved, matched, progress)
    found = cofactors(solved)
    left_out = solved.block.measured.weight == 0.0
    return Adjusted(solved, found, balance(solved, found), left_out, _reasons(solved.block, matched), factor)


def distances(block: Block) -> tuple[Array, Mask]:
    """Length of each residual in sigmas, shape (n,), and whether its point is where the camera sees it."""
    residual, reached = image_residuals(block, lay_out(block))
    return np.linalg.norm(residual, axis=1) / block.measured.sigma_px, reached


def usual(distance: Array) -> float:
    """Sigma of residuals [their sigma], by their median."""
    return float(np.median(distance)) / _NORMAL if len(distance) else 1.0


def _led(block: Block, known: tuple[RigCamera, ...], matched: Mask, progress: Progress | None) -> Block:
    """A first solution that wrong matches do not lead astray: a few steps at a time, with weights that narrow (Geman & McClure)."""
    scale = np.inf
    for _ in range(MOST_SOFT):
        distance, reached = distances(block)
        seen = matched & reached
        now = max(usual(distance[seen]), 0.3) if seen.any() else 1.0
        if now > 0.9 * scale:
            break
        scale = now
        weight = np.where(matched, 1.0 / (1.0 + np.square(distance / (3.0 * scale))) ** 2, 1.0)
        block = replace(block, measured=replace(block.measured, weight=np.where(reached, weight, 0.0)))
        block = _without_single(block)
        block = solve(block, known, progress, SOFT_STEPS).block
    return block


def _screened(block: Block, matched: Mask) -> tuple[Block, int]:
    """Weights of 1, and 0 for what is behind its camera, gross or wrong; what fits again comes back. How many changed."""
    block = revived(block)
    measured = block.measured
    distance, reached = distances(block)
    by_hand, by_machine = reached & ~matched, reached & matched
    gross = by_hand & (distance > GROSS * max(1.0, usual(distance[by_hand & (measured.weight > 0.0)])))
    wrong = by_machine & (distance > WRONG * max(usual(distance[by_machine & (measured.weight > 0.0)]), 0.02))
    kept = reached & ~gross & ~wrong
    changed = int((kept != (measured.weight > 0.0)).sum()) + int(((measured.weight != 1.0) & kept).any()) * len(kept)
    weight = np.where(kept, 1.0, 0.0)
    return replace(block, measured=replace(measured, weight=weight), rows=_weighed_rows(block)), changed


def revived(block: Block) -> Block:
    """Points that nothing determines placed anew from where their images are now: what was left out may fit."""
    measured = block.measured
    used = np.bincount(measured.point[measured.weight > 0.0], minlength=len(block.points_m))
    asked = np.bincount(measured.point, minlength=len(block.points_m))
    lost = (used < 2) & (asked >= 2)
    if not lost.any():
        return block
    every = replace(block, measured=replace(measured, weight=np.ones(len(measured))))
    places, angle = intersect(every)
    found = lost & np.asarray(np.isfinite(places).all(axis=1)) & (angle > LEAST_ANGLE_RAD)
    return replace(block, points_m=np.where(found[:, None], places, block.points_m))


def _reasons(block: Block, matched: Mask) -> dict[str, int]:
    """How many measurements are left out, and why."""
    distance, reached = distances(block)
    out = block.measured.weight == 0.0
    used = ~out & reached
    alone = np.bincount(block.measured.point, minlength=len(block.points_m))[block.measured.point] < 2
    meant = out & reached & ~alone
    gross = meant & ~matched & (distance > GROSS * max(1.0, usual(distance[used & ~matched])))
    wrong = meant & matched & (distance > WRONG * max(usual(distance[used & matched]), 0.02))
    single = out & (alone | (reached & ~gross & ~wrong))
    counted = {"single": single, "behind": out & ~reached & ~alone, "gross": gross, "wrong": wrong}
    return {name: int(mask.sum()) for name, mask in counted.items()}


def _weighed_rows(block: Block) -> PointRows:
    """Lidar rows far from their surface lose weight: their point is not on it."""
    rows = block.rows
    if not (rows.source == LIDAR).any():
        return rows
    off = np.abs(row_residuals(block)) / rows.sigma_m
    lidar = rows.source == LIDAR
    scale = max(1.0, robust.sigma(off[lidar], 0.0))
    share = np.where(off <= 2.0 * scale, 1.0, 2.0 * scale / np.maximum(off, 1e-9))
    return replace(rows, weight=np.where(lidar, np.where(off > 4.0 * scale, 0.0, share), rows.weight))


def _weighed_priors(block: Block) -> Block:
    """Observed poses far from where the block puts them lose weight."""
    priors = block.priors
    if not len(priors):
        return block
    off = np.einsum("kij,kj->ki", whitening(priors.covariance), pose_residuals(block, priors))
    distance = np.sqrt(np.square(off).mean(axis=1))
    bend = _PRIOR_BEND * max(1.0, float(np.median(distance)))
    weight = np.where(distance <= bend, 1.0, bend / np.maximum(distance, 1e-9))
    return replace(block, priors=replace(priors, weight=np.round(weight, 2).astype(np.float64)))


def _without_single(block: Block) -> Block:
    """Leave out measurements of points that nothing else determines."""
    measured = block.measured
    known = tuple(block.rig.cameras)
    kept = normal_of(block, known, lay_out(block)).kept
    bad = ~kept.determined[measured.point] & (measured.weight > 0.0)
    weight = np.where(bad, 0.0, measured.weight)
    rows = block.rows
    seen = np.zeros(len(block.points_m), np.bool_)
    seen[measured.point[weight > 0.0]] = True
    return replace(
        block,
        measured=replace(measured, weight=weight),
        rows=replace(rows, weight=np.where(seen[rows.point], rows.weight, 0.0)),
    )


def _scaled(solved: Solved, matched: Mask, progress: Progress | None) -> tuple[Solved, float]:
    """The sigma of matches made what their residuals say, so that they weigh rightly against poses and control (variance components).

    Source: Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten (1979): v'Pv over the group's redundancy.
    """
    factor = 1.0
    for _ in range(3):
        block = solved.block
        found = cofactors(solved)
        counted = balance(solved, found)
        used = (block.measured.weight > 0.0) & matched
        told = sum(traces(solved, found))
        by_hand = 2 * int(((block.measured.weight > 0.0) & ~matched).sum())
        redundancy = 2 * int(used.sum()) - (counted.unknowns - told - by_hand * 0.5)
        square = float(np.square(distances(block)[0][used]).sum())
        if redundancy <= 0 or square <= 0.0:
            break
        share = float(np.sqrt(square / redundancy))
        factor *= share
        sigma = np.where(matched, block.measured.sigma_px * share, block.measured.sigma_px)
        solved = solve(replace(block, measured=replace(block.measured, sigma_px=sigma)), solved.known, progress)
        if abs(share - 1.0) < 0.02:
            break
    return solved, factor
