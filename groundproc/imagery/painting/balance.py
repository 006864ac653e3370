"""Exposure and white balance: a factor for each image and plane, from points that several images see."""

from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.imagery.painting.views import NOBODY, Views

Gains = npt.NDArray[np.float32]

_MOST_POINTS: Final = 40_000
_POINTS_AN_IMAGE: Final = 1000
"""More of them than `_MOST_POINTS` where there are many images: of 1000 pairs that scatter by a tenth a factor is right to 0.3 %."""
_DARK: Final = 0.03
_BRIGHT: Final = 0.97
"""Shares of the full scale between which numbers follow the light."""
_PRIOR: Final = 0.5
"""Sigma of the logarithm of a factor: what cameras change their exposure by without being asked."""
_SCATTER: Final = 0.1
"""Of the logarithm of what two images show of one point."""
_ROUNDS: Final = 5


def gains(views: Views, images: int, full: float, measured: bool = False) -> Gains:
    """Factors that bring all images to one exposure, shape (images, planes); their mean of logarithms is 0.

    Least squares on the logarithms of what pairs of images show of one point, robust against what moved (Cauchy).

    Parameters
    ----------
    views : Views
    images : int
    full : float
        Full scale.
    measured : bool
        Numbers are those of a calibrated instrument: factors are 1.
    """
    planes = views.value.shape[2]
    out = np.ones((images, planes), np.float32)
    shared = np.flatnonzero(views.total >= 2)
    if measured or not len(shared):
        return out
    shared = shared[:: max(1, len(shared) // max(_MOST_POINTS, _POINTS_AN_IMAGE * images))]
    image, value = views.image[shared], np.asarray(views.value[shared], np.float64)
    for plane in range(planes):
        first, second, ratio = _pairs(image, value[:, :, plane], full)
        if len(ratio):
            out[:, plane] = np.exp(_solve(first, second, ratio, images))
    return out


def _pairs(
    image: npt.NDArray[np.uint16], value: npt.NDArray[np.float64], full: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Images of pairs of neighbouring views, and the logarithm of the second over the first."""
    firsts, seconds, ratios = [], [], []
    known = (image != NOBODY) & (value > _DARK * full) & (value < _BRIGHT * full)
    for view in range(image.shape[1] - 1):
        both = known[:, view] & known[:, view + 1]
        firsts.append(image[both, view].astype(np.int64))
        seconds.append(image[both, view + 1].astype(np.int64))
        ratios.append(np.log(value[both, view + 1] / value[both, view]))
    return np.concatenate(firsts), np.concatenate(seconds), np.concatenate(ratios)


def _solve(
    first: npt.NDArray[np.int64], second: npt.NDArray[np.int64], ratio: npt.NDArray[np.float64], images: int
) -> npt.NDArray[np.float64]:
    """Logarithms of the factors: factor of the first less that of the second is the ratio."""
    found: npt.NDArray[np.float64] = np.zeros(images)
    for _ in range(_ROUNDS):
        residual = (found[first] - found[second] - ratio) / _SCATTER
        weight = 1.0 / (1.0 + residual**2) / _SCATTER**2
        pairs = np.bincount(first * images + second, weight, images * images).reshape(images, images)
        pairs += pairs.T
        right = np.bincount(first, weight * ratio, images) - np.bincount(second, weight * ratio, images)
        normal = np.diag(pairs.sum(axis=1) + 1.0 / _PRIOR**2) - pairs
        found = np.asarray(np.linalg.solve(normal, right), np.float64)
    return np.asarray(found - found.mean())
