"""The best views of each point, kept while images go by, and what they agree on."""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.imagery.painting.visibility import Seen
from groundproc.numerics.robust import MAD_TO_SIGMA

MOST: Final = 5
"""Views of a point that are kept."""
NOBODY: Final = np.uint16(65535)
"""Stands for no image."""
_BEYOND: Final = 3.0
"""Sigmas from the median of its views at which a view is voted out: something passed by."""
_FLOOR: Final = 0.04
"""Share of the full scale that views differ by anyway: slopes in the light, and pixels that are not the same."""


class Views(NamedTuple):
    """Views of points, best first.

    Attributes
    ----------
    image : ndarray of uint16, shape (n, MOST)
        Number of the image; `NOBODY` where there are fewer.
    weight : ndarray of float32, shape (n, MOST)
    value : ndarray, shape (n, MOST, planes)
    total : ndarray of uint8, shape (n,)
        How many images saw it, 255 at most.
    """

    image: npt.NDArray[np.uint16]
    weight: npt.NDArray[np.float32]
    value: npt.NDArray[Any]
    total: npt.NDArray[np.uint8]


def insert(views: Views, picture: npt.NDArray[Any], seen: Seen, weight: npt.NDArray[np.float32], image: int) -> None:
    """Give points what a picture, shape (height, width, planes), shows there, between pixels by bilinear interpolation.

    Of two views of one weight that of the lower number goes first: the order in which images come does not matter.
    """
    _insert(views, picture, seen.number, seen.pixel, weight, np.uint16(image))


def blend(
    views: Views,
    gain: npt.NDArray[np.float32],
    full: float,
    least: int,
    differ: float | None = None,
    little: float = 0.0,
) -> npt.NDArray[np.float32]:
    """What the views of each point agree on.

    Parameters
    ----------
    views : Views
    gain : ndarray of float32, shape (images, planes)
        Factor that brings each image to the common exposure.
    full : float
        Full scale of the numbers.
    least : int
        Views that a point needs.
    differ : float, optional
        What views of one thing differ by anyway; default: a share of the full scale.
    little : float
        Views that weigh less than this share of the best one have no say: many that show a place badly would outvote it.

    Returns
    -------
    ndarray of float32, shape (n, planes)
        Not a number where there are fewer.
    """
    out = np.full((len(views.total), views.value.shape[2]), np.nan, np.float32)
    _blend(views, gain, (_FLOOR * full if differ is None else differ, least, little), out)
    return out


def sampled(picture: npt.NDArray[Any], pixel: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """What a picture, shape (height, width, planes), shows at places, shape (n, 2), between its pixels: shape (n, planes)."""
    out = np.empty((len(pixel), picture.shape[2]))
    _sampled(picture, pixel, out)
    return np.rint(out) if np.issubdtype(picture.dtype, np.integer) else out


@njit(cache=True, nogil=True)
def _sampled(picture: Any, pixel: Any, out: Any) -> None:
    height, width, planes = picture.shape
    for i in range(len(pixel)):
        corner = _corner(pixel[i, 0], pixel[i, 1], width, height)
        for plane in range(planes):
            out[i, plane] = _between(picture, plane, corner)


@njit(cache=True, nogil=True, inline="always")
def _corner(u: float, v: float, width: int, height: int) -> tuple[int, int, int, int, float, float]:
    """Rows above and below a place, columns left and right, and how far it is from the first of each.

    Beyond the middles of the outermost pixels it is taken to be there.
    """
    u, v = min(max(np.float64(u), 0.0), width - 1.0), min(max(np.float64(v), 0.0), height - 1.0)
    column, row = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
    return row, min(row + 1, height - 1), column, min(column + 1, width - 1), u - column, v - row


@njit(cache=True, nogil=True, inline="always")
def _between(picture: Any, plane: int, corner: Any) -> float:
    """Bilinear interpolation."""
    row, below, column, beside, a, b = corner
    upper = (1.0 - a) * picture[row, column, plane] + a * picture[row, beside, plane]
    lower = (1.0 - a) * picture[below, column, plane] + a * picture[below, beside, plane]
    return float((1.0 - b) * upper + b * lower)


@njit(cache=True, nogil=True)
def _insert(views: Any, picture: Any, number: Any, pixel: Any, weight: Any, image: Any) -> None:
    height, width, planes = picture.shape
    images, weights, values, total = views.image, views.weight, views.value, views.total
    most = images.shape[1]
    for i in range(len(number)):
        point = number[i]
        if total[point] < 255:
            total[point] += 1
        place = most
        while place > 0:
            other = images[point, place - 1]
            better = weight[i] > weights[point, place - 1]
            equal = weight[i] == weights[point, place - 1] and image < other
            if other != 65535 and not better and not equal:
                break
            place -= 1
        if place == most:
            continue
        for later in range(most - 1, place, -1):
            images[point, later], weights[point, later] = images[point, later - 1], weights[point, later - 1]
            for plane in range(planes):
                values[point, later, plane] = values[point, later - 1, plane]
        images[point, place], weights[point, place] = image, weight[i]
        corner = _corner(pixel[i, 0], pixel[i, 1], width, height)
        for plane in range(planes):
            values[point, place, plane] = _between(picture, plane, corner)


@njit(cache=True, nogil=True)
def _median(values: Any, count: int) -> float:
    """Of the first so many, which are sorted."""
    for i in range(1, count):
        value, j = values[i], i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value
    half = count // 2
    return float(values[half] if count % 2 else 0.5 * (values[half - 1] + values[half]))


@njit(cache=True, nogil=True)
def _vote(balanced: Any, count: int, floor: float, kept: Any, sorted_: Any) -> None:
    """Which of so many views, shape (count, planes), are near the median in every plane; all where none is."""
    kept[:count] = True
    for plane in range(balanced.shape[1]):
        sorted_[:count] = balanced[:count, plane]
        middle = _median(sorted_, count)
        for view in range(count):
            sorted_[view] = abs(balanced[view, plane] - middle)
        limit = _BEYOND * max(MAD_TO_SIGMA * _median(sorted_, count), floor)
        for view in range(count):
            if abs(balanced[view, plane] - middle) > limit:
                kept[view] = False
    if not kept[:count].any():
        kept[:count] = True


@njit(cache=True, nogil=True)
def _blend(views: Any, gain: Any, terms: Any, out: Any) -> None:
    floor, least, little = terms
    images, weights, values, total = views.image, views.weight, views.value, views.total
    most, planes = values.shape[1], values.shape[2]
    balanced, sorted_, kept = np.empty((most, planes)), np.empty(most), np.empty(most, np.bool_)
    for point in range(len(total)):
        count = min(total[point], most)
        if count < max(least, 1):
            continue
        while weights[point, count - 1] < little * weights[point, 0]:
            count -= 1
        kept[:] = True
        for view in range(count):
            for plane in range(planes):
                balanced[view, plane] = values[point, view, plane] * gain[images[point, view], plane]
        if count >= 3:
            _vote(balanced, count, floor, kept, sorted_)
        _mean(balanced, weights, kept, count, point, out)


@njit(cache=True, nogil=True)
def _mean(balanced: Any, weights: Any, kept: Any, count: int, point: int, out: Any) -> None:
    """Weighted mean of the views of a point that are kept."""
    for plane in range(out.shape[1]):
        weight, total = 0.0, 0.0
        for view in range(count):
            if kept[view]:
                weight += weights[point, view]
                total += weights[point, view] * balanced[view, plane]
        out[point, plane] = total / weight
