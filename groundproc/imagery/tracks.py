"""Matches of pairs joined to tracks: one point in many images."""

from collections.abc import Iterable
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from groundproc.imagery.measurements import Tracks
from groundproc.imagery.ties import Features

Ints = npt.NDArray[np.int64]

MOST_PER_IMAGE: Final = 1500


def tracks_of(features: list[Features | None], matches: Iterable[tuple[int, int, Ints]]) -> Tracks:
    """Join matches; tracks that meet an image twice are left out, and of many in one image the longest are kept, spread over it.

    Parameters
    ----------
    features : list of Features
        None for images without.
    matches : iterable
        Two images and the numbers of features that belong together, shape (n, 2).
    """
    starts = np.concatenate([[0], np.cumsum([0 if one is None else len(one.pixel) for one in features])]).astype(
        np.int64
    )
    first, second = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for a, b, found in matches:
        first.append(starts[a] + found[:, 0])
        second.append(starts[b] + found[:, 1])
    i, j = np.concatenate(first), np.concatenate(second)
    total = int(starts[-1])
    graph = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    image = np.repeat(np.arange(len(features)), np.diff(starts))
    node = np.unique(np.concatenate([i, j]))
    label, image = label[node], image[node]
    pair = label.astype(np.int64) * len(features) + image
    _, counts = np.unique(pair, return_counts=True)
    doubled = np.unique(np.unique(pair)[counts > 1] // len(features))
    good = ~np.isin(label, doubled)
    node, label, image = node[good], label[good], image[good]
    kept = _thinned(features, node - starts[image], image, label)
    node, label, image = node[kept], label[kept], image[kept]
    _, point = np.unique(label, return_inverse=True)
    pixel = np.empty((len(node), 2))
    sigma = np.empty(len(node))
    for number, one in enumerate(features):
        own = image == number
        if one is not None and own.any():
            pixel[own], sigma[own] = one.pixel[node[own] - starts[number]], one.sigma_px[node[own] - starts[number]]
    return Tracks(image, point.astype(np.int64), pixel, sigma)


def _thinned(features: list[Features | None], feature: Ints, image: Ints, label: Ints) -> npt.NDArray[np.bool_]:
    """Measurements whose track is among those wanted by some image that it is in; a track stays whole."""
    length = np.bincount(label)
    wanted = np.zeros(len(length), np.bool_)
    for number, one in enumerate(features):
        own = np.flatnonzero(image == number)
        if one is None or not len(own):
            continue
        if len(own) <= MOST_PER_IMAGE:
            wanted[label[own]] = True
            continue
        place = one.pixel[feature[own]]
        across = 20
        cell = ((place - place.min(axis=0)) / np.ptp(place, axis=0) * across).astype(np.int64).clip(0, across - 1)
        key = cell[:, 1] * across + cell[:, 0]
        order = np.lexsort((-length[label[own]], key))
        rank = np.empty(len(own), np.int64)
        rank[order] = np.arange(len(own)) - np.searchsorted(key[order], key[order])
        wanted[label[own[np.argsort(rank, kind="stable")[:MOST_PER_IMAGE]]]] = True
    return np.asarray(wanted[label])
