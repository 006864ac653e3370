"""How well images foretell each other: what all others say of the points of one, against what that one shows."""

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from groundproc.imagery.painting.block import Layer
from groundproc.imagery.painting.views import NOBODY, Views

_MOST_POINTS: Final = 40_000
_POINTS_AN_IMAGE: Final = 1000
"""More of them than `_MOST_POINTS` where there are many images."""
_FEWEST: Final = 100
"""Points by which an image is judged."""


class Score(NamedTuple):
    """How far off, rms, in percent of the full scale.

    Attributes
    ----------
    bands : dict of str to float
        Over all images.
    images : dict of str to float
        Over all bands: each image foretold by the others.
    """

    bands: dict[str, float]
    images: dict[str, float]


def score(layer: Layer, views: Views, factor: npt.NDArray[np.float32]) -> Score:
    """Hold each image out in turn, and foretell what it shows by the mean of the other views of its points.

    Parameters
    ----------
    layer : Layer
    views : Views
    factor : ndarray of float32, shape (images, planes)
        Brings the images to one exposure.
    """
    several = np.flatnonzero(views.total >= 2)
    if not len(several):
        return Score({}, {})
    several = several[:: max(1, len(several) // max(_MOST_POINTS, _POINTS_AN_IMAGE * len(layer.images)))]
    image, value = views.image[several], np.asarray(views.value[several], np.float64)
    there = image != NOBODY
    balanced = value * np.where(there[..., None], factor[np.where(there, image, 0)], 0.0)
    others = there.sum(axis=1) - 1
    told = (balanced.sum(axis=1, keepdims=True) - balanced) / np.maximum(others, 1)[:, None, None]
    square = ((told - balanced)[there] / layer.full * 100.0) ** 2
    owner = image[there].astype(np.int64)
    count = np.bincount(owner, minlength=len(layer.images))
    total = np.bincount(owner, square.mean(axis=1), len(layer.images))
    return Score(
        {band: float(np.sqrt(square[:, plane].mean())) for plane, band in enumerate(layer.bands)},
        {
            one.name: float(np.sqrt(total[number] / count[number]))
            for number, one in enumerate(layer.images)
            if count[number] >= _FEWEST
        },
    )


def worst(images: Mapping[str, float]) -> str:
    """The image that is foretold worst; empty where none was."""
    return max(images, key=lambda name: (images[name], name), default="")
