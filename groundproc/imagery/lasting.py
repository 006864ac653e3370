"""Errors of a trajectory last: poses seconds apart are off alike, and a hundred of them say little more than one.

How long is told by the block: held by its images and hardly by the trajectory, it is rigid, and the trajectory's departures from it follow
each other where errors last. With the correlation r from one station to the next, variances are multiplied by (1 + r) / (1 - r), which the
mean of an autoregressive process of first order has (spectrum at frequency zero). Independent errors stay as they are.
"""

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.imagery.bundle.block import Block, PosePriors
from groundproc.imagery.bundle.observed import pose_residuals
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]

LOOSE: Final = 100.0
"""What variances are multiplied by while the block tells."""
MOST: Final = 0.95
LEAST_STATIONS: Final = 8


def loosened(priors: PosePriors, place: Array | float, turn: Array | float) -> PosePriors:
    """Observed poses with the variances of places and turns multiplied, all alike or each by its own, shape (k,)."""
    count = len(priors)
    scale = np.sqrt(np.stack([np.broadcast_to(place, count)] * 3 + [np.broadcast_to(turn, count)] * 3, axis=1))
    finite = np.isfinite(priors.covariance)
    spread = np.where(finite, priors.covariance, 0.0) * (scale[:, :, None] * scale[:, None, :])
    return replace(priors, covariance=np.where(finite, spread, priors.covariance))


def factors(block: Block, stated: PosePriors) -> tuple[Array, Array]:
    """What variances of places and of turns are to be multiplied by, shape (k,) each.

    Parameters
    ----------
    block : Block
        Adjusted with loosened poses.
    stated : PosePriors
        With the variances as the trajectory states them.
    """
    count = len(stated)
    if count < LEAST_STATIONS:
        return np.ones(count), np.ones(count)
    order = np.argsort(block.stations.time_ns[stated.station], kind="stable")
    off = pose_residuals(block, stated) / np.sqrt(np.diagonal(stated.covariance, axis1=1, axis2=2))
    place, turn = off[:, :3], off[:, 3:]
    return _factor(place[order]) * np.ones(count), _factor(turn[order]) * np.ones(count)


def _factor(series: Array) -> float:
    """(1 + r) / (1 - r) of series, shape (n, m), side by side; 1 where r is what independent deviates have by chance."""
    centred = series - np.median(series, axis=0)
    # a wild pose is not what lasts
    limit = 4.0 * robust.MAD_TO_SIGMA * np.maximum(np.median(np.abs(centred), axis=0), 1e-12)
    centred = np.clip(centred, -limit, limit)
    square = float(np.square(centred).sum())
    if square == 0.0:
        return 1.0
    ratio = float((centred[1:] * centred[:-1]).sum()) / square
    chance = 2.0 / np.sqrt(series.size)
    ratio = min(max(ratio, 0.0), MOST) if ratio > chance else 0.0
    return (1.0 + ratio) / (1.0 - ratio)
