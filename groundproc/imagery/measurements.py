"""Measurements of people and of the machine as one table of image points, with the points' names."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groundproc.imagery.bundle.block import ImagePoints
from groundproc.imagery.tables import Marks

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Tracks:
    """Matches of the machine, over several images each.

    Attributes
    ----------
    image, point : ndarray of int64, shape (n,)
        Points are numbered from 0.
    pixel : ndarray, shape (n, 2)
    sigma_px : ndarray, shape (n,)
    """

    image: Ints
    point: Ints
    pixel: Array
    sigma_px: Array


@dataclass(frozen=True, slots=True)
class Measurements:
    """Image points of all origins.

    Attributes
    ----------
    points : ImagePoints
        In the order of points.
    names : tuple of str
        Of the points; those of the machine are called tie1, tie2, ...
    matched : ndarray of bool, shape (n,)
        Which the machine found.
    strangers : tuple of str
        Images that stand in a table and are none of the block's.
    """

    points: ImagePoints
    names: tuple[str, ...]
    matched: Mask
    strangers: tuple[str, ...] = ()


def rows_of(names: Sequence[str], wanted: Sequence[str]) -> dict[str, int]:
    """Place of each wanted name among others: as it stands, else by its last part, else without its ending, where one alone fits."""
    found = {name: number for number, name in enumerate(names)}
    out = {name: found[name] for name in wanted if name in found}
    for key in (_last, _stem):
        by_key: dict[str, list[int]] = {}
        for number, name in enumerate(names):
            by_key.setdefault(key(name), []).append(number)
        for name in wanted:
            alike = by_key.get(key(name), [])
            if name not in out and len(alike) == 1:
                out[name] = alike[0]
    return out


def _last(name: str) -> str:
    return name.rsplit("/", 1)[-1]


def _stem(name: str) -> str:
    return _last(name).rsplit(".", 1)[0]


def gather(images: Sequence[str], marks: Sequence[Marks], tracks: Tracks | None) -> Measurements:
    """Put tables and matches together; marks of images that are none of the block's are left out and named."""
    names: dict[str, int] = {}
    strangers: list[str] = []
    image, point, pixel, sigma, matched = [], [], [], [], []
    for table in marks:
        rows = rows_of(images, tuple(dict.fromkeys(table.image)))
        strangers += [name for name in dict.fromkeys(table.image) if name not in rows]
        kept = np.array([name in rows for name in table.image])
        image.append(np.array([rows[name] for name in table.image if name in rows], np.int64))
        own = [name for name, keep in zip(table.point, kept, strict=True) if keep]
        point.append(np.array([names.setdefault(name, len(names)) for name in own], np.int64))
        pixel.append(table.pixel[kept])
        sigma.append(table.sigma_px[kept])
        matched.append(np.zeros(int(kept.sum()), np.bool_))
    labels = list(names)
    if tracks is not None and len(tracks.image):
        image.append(tracks.image)
        point.append(tracks.point + len(labels))
        pixel.append(tracks.pixel)
        sigma.append(tracks.sigma_px)
        matched.append(np.ones(len(tracks.image), np.bool_))
        labels += [f"tie{number + 1}" for number in range(int(tracks.point.max()) + 1)]
    if not image:
        none = np.empty(0, np.int64)
        return Measurements(_points(none, none, np.empty((0, 2)), np.empty(0)), (), np.empty(0, np.bool_))
    order = np.lexsort((np.concatenate(image), np.concatenate(point)))
    arrays = [np.concatenate(part)[order] for part in (image, point, pixel, sigma)]
    points = _points(arrays[0], arrays[1], arrays[2], arrays[3])
    return Measurements(points, tuple(labels), np.concatenate(matched)[order], tuple(dict.fromkeys(strangers)))


def _points(image: Ints, point: Ints, pixel: Array, sigma_px: Array) -> ImagePoints:
    return ImagePoints(image, point, pixel, sigma_px, np.ones(len(image)))
