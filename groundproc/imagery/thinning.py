"""A block with part of its tie points: good enough to find its mounting and clocks, and how long a trajectory's errors last."""

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.imagery.bundle.block import Block
from groundproc.imagery.bundle.intersection import intersect
from groundproc.imagery.bundle.screen import LEAST_ANGLE_RAD

Mask = npt.NDArray[np.bool_]

OF_IMAGE: Final = 300
"""Tie points that an image has at least, where it has so many."""
_LEAST_GAIN: Final = 0.7


def thinned(block: Block, matched: Mask) -> Mask:
    """Measurements of the points that most images see, so that every image has `OF_IMAGE` of them; those of people all.

    Parameters
    ----------
    block : Block
    matched : ndarray of bool, shape (n,)
        Measurements that the machine found.
    """
    measured = block.measured
    ends = np.searchsorted(measured.point, np.arange(len(block.points_m) + 1))
    rays = np.diff(ends)
    order = np.random.default_rng(0).permutation(len(rays))
    order = order[np.argsort(-rays[order], kind="stable")]
    count = np.zeros(len(block.images), np.int64)
    chosen = np.zeros(len(rays), np.bool_)
    for point in order.tolist():
        own = measured.image[ends[point] : ends[point + 1]]
        if len(own) > 1 and count[own].min() < OF_IMAGE:
            chosen[point] = True
            count[own] += 1
    kept = chosen[measured.point] | ~matched
    return kept if kept.mean() < _LEAST_GAIN else np.ones(len(matched), np.bool_)


def renewed(block: Block) -> Block:
    """A block whose wrong matches get another chance, now that more of it is known."""
    return replace(block, measured=replace(block.measured, weight=np.ones(len(block.measured))))


def completed(adjusted: Block, whole: Block, matched: Mask, sigma_scale: float) -> Block:
    """The whole block where a part of it lies after its adjustment.

    Parameters
    ----------
    adjusted, whole : Block
        With part of the measurements, and with all of them as they were before.
    matched : ndarray of bool, shape (n,)
        Of the whole.
    sigma_scale : float
        What the sigma of matches was multiplied by.
    """
    measured = whole.measured
    sigma = np.where(matched, measured.sigma_px * sigma_scale, measured.sigma_px)
    block = replace(
        adjusted, measured=replace(measured, sigma_px=sigma, weight=np.ones(len(measured))), rows=whole.rows
    )
    places, angle = intersect(block)
    good = np.isfinite(places).all(axis=1) & (angle > LEAST_ANGLE_RAD)
    return replace(block, points_m=np.where(good[:, None], places, block.points_m))
