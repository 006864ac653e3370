"""What stands upright, seen from above: the distance of its points from those of the reference.

A ground model says little about a facade: on a wall 30 m away, a single laser line lies within 0.7 m of the ground. In
plan, all points of the wall lie on one line, whichever lasers hit it. The rings of the scanner, which move with the
aircraft, thus leave no pattern that the search could lock on to.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.int32]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class DistanceMap:
    """A square raster of the distance to the nearest occupied pixel, up to a limit.

    Attributes
    ----------
    pixel_m, limit_m : float
    distance_m : ndarray of float32, shape (n, n)
        `limit_m` where nothing is near.
    state : ndarray of uint8, shape (n, n)
        1: occupied.
    touched : ndarray of int32, shape (n * n,)
        Flat indices of the occupied pixels, the first `used[0]` of them.
    used : ndarray of int64, shape (1,)
    disc : ndarray, shape (k, 3)
        Row, column and distance of the pixels within the limit.
    """

    pixel_m: float
    limit_m: float
    distance_m: Floats
    state: npt.NDArray[np.uint8]
    touched: npt.NDArray[np.int32]
    used: npt.NDArray[np.int64]
    disc: Floats

    @classmethod
    def empty(cls, pixel_m: float, half_width_m: float, limit_m: float) -> "DistanceMap":
        """A map without anything in it."""
        n = 2 * int(np.ceil(half_width_m / pixel_m))
        reach = int(limit_m / pixel_m)
        rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        distance = np.hypot(rows, columns) * pixel_m
        near = distance < limit_m
        return cls(
            pixel_m,
            limit_m,
            np.full((n, n), limit_m, np.float32),
            np.zeros((n, n), np.uint8),
            np.empty(n * n, np.int32),
            np.zeros(1, np.int64),
            np.stack([rows[near], columns[near], distance[near]], axis=1).astype(np.float32),
        )


class Trimmed(NamedTuple):
    """Points of a revolution and where a trim places them: mat turned + base + shift, from the middle of a raster.

    Attributes
    ----------
    turned_m : ndarray of float32, shape (n, 3)
        From the INS to the point, east north up: what a trim of an angle turns.
    base_m : ndarray of float32, shape (n, 3)
        Where the INS was when the point was measured, from where it was at the revolution's middle.
    mat : ndarray of float32, shape (3, 3)
        Turn by the trims.
    shift_m : ndarray of float32, shape (3,)
        From the raster's middle to the INS at the revolution's middle, trims included.
    """

    turned_m: Floats
    base_m: Floats
    mat: Floats
    shift_m: Floats

    @classmethod
    def of(cls, turned_m: Floats, base_m: Floats, mat: Array, shift_m: Array) -> "Trimmed":
        """In single precision."""
        return cls(turned_m, base_m, mat.astype(np.float32), shift_m.astype(np.float32))


def occupy(target: DistanceMap, turned_m: Floats, base_m: Floats, mat: Array, shift_m: Array) -> None:
    """Mark the pixels of points; arguments as of `ground_model.add`."""
    _occupy(Trimmed.of(turned_m, base_m, mat, shift_m), target.pixel_m, target.state, target.touched, target.used)


def spread(target: DistanceMap) -> None:
    """Distances from the pixels that are marked."""
    _spread(target.distance_m, target.touched, target.used, target.disc)


def clear(target: DistanceMap) -> None:
    """Empty it."""
    _clear(target.distance_m, target.state, target.touched, target.used, target.disc, np.float32(target.limit_m))


def distance(target: DistanceMap, turned_m: Floats, base_m: Floats, mat: Array, shift_m: Array) -> float:
    """Sum of the squared distances of points [m2], those outside the map at the limit; arguments as of `ground_model.add`."""
    points = Trimmed.of(turned_m, base_m, mat, shift_m)
    return float(_distance(points, target.pixel_m, target.distance_m, target.limit_m))


@njit(cache=True, nogil=True, inline="always", fastmath=True)
def pixel_of(i: int, points: Trimmed, scale: Any, n: int) -> Any:
    """Flat index of the pixel that a point lies in, of a raster of n by n pixels, `scale` of them a metre; -1 outside."""
    turned, base, m, s = points.turned_m, points.base_m, points.mat, points.shift_m
    half = np.float32(0.5 * n)
    a, b, c = turned[i, 0], turned[i, 1], turned[i, 2]
    x = (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + base[i, 0] + s[0]) * scale + half
    y = (m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + base[i, 1] + s[1]) * scale + half
    at = -1
    if x >= np.float32(0.0) and y >= np.float32(0.0):
        column, row = int(x), int(y)
        if column < n and row < n:
            at = row * n + column
    return at


@njit(cache=True, nogil=True, fastmath=True)
def _occupy(points: Trimmed, pixel: float, state: npt.NDArray[np.uint8], touched: Pixels, used: Ints) -> None:
    n = state.shape[0]
    scale = np.float32(1.0 / pixel)
    flat = state.ravel()
    count = used[0]
    for i in range(len(points.turned_m)):
        at = pixel_of(i, points, scale, n)
        if at >= 0 and flat[at] == 0:
            flat[at] = 1
            touched[count] = at
            count += 1
    used[0] = count


@njit(cache=True, nogil=True)
def _spread(distances: Floats, touched: Pixels, used: Ints, disc: Floats) -> None:
    n = distances.shape[0]
    for k in range(used[0]):
        row, column = touched[k] // n, touched[k] % n
        for j in range(disc.shape[0]):
            r, c = row + int(disc[j, 0]), column + int(disc[j, 1])
            if 0 <= r < n and 0 <= c < n and disc[j, 2] < distances[r, c]:
                distances[r, c] = disc[j, 2]


@njit(cache=True, nogil=True)
def _clear(
    distances: Floats, state: npt.NDArray[np.uint8], touched: Pixels, used: Ints, disc: Floats, limit: np.float32
) -> None:
    n = distances.shape[0]
    flat = state.ravel()
    for k in range(used[0]):
        flat[touched[k]] = 0
        row, column = touched[k] // n, touched[k] % n
        for j in range(disc.shape[0]):
            r, c = row + int(disc[j, 0]), column + int(disc[j, 1])
            if 0 <= r < n and 0 <= c < n:
                distances[r, c] = limit
    used[0] = 0


@njit(cache=True, nogil=True, fastmath=True)
def _distance(points: Trimmed, pixel: float, distances: Floats, limit: float) -> float:
    n = distances.shape[0]
    scale = np.float32(1.0 / pixel)
    flat = distances.ravel()
    total = 0.0
    for i in range(len(points.turned_m)):
        at = pixel_of(i, points, scale, n)
        d = np.float64(flat[at]) if at >= 0 else limit
        total += d * d
    return total
