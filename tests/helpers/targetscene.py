"""What an HDL-32E sees of survey targets: its footprint, noise of range and strength, on panels, balls and ground of known place.

Nothing here is the project's: beams are met by hand, so that what finds targets is judged by another hand.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Texture = Callable[[Array, Array], Array]
"""Reflectance at places u, v of a surface, shape (n,)."""

DIVERGENCE_RAD = 2.79e-3
RANGE_NOISE_M = 0.015
STRENGTH_NOISE = 0.15
RAYS = 19


@dataclass(frozen=True)
class Panel:
    """A flat rectangle, or with an infinite half width the ground.

    Attributes
    ----------
    centre_m : ndarray, shape (3,)
    axes : ndarray, shape (3, 3)
        Columns u, v, normal.
    half_m : float
    texture : Texture
    """

    centre_m: Array
    axes: Array
    half_m: float
    texture: Texture

    def met(self, origin: Array, way: Array) -> tuple[Array, Array]:
        """Range and strength of rays, shape (n,); an infinite range where they miss."""
        normal = self.axes[:, 2]
        slant = way @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = ((self.centre_m - origin) @ normal) / slant
        place = (origin + reach[:, None] * way - self.centre_m) @ self.axes[:, :2]
        hit = (reach > 0.0) & (np.abs(place) <= self.half_m).all(axis=1)
        return np.where(hit, reach, np.inf), np.where(hit, self.texture(place[:, 0], place[:, 1]) * np.abs(slant), 0.0)


@dataclass(frozen=True)
class Ball:
    """A sphere of one colour."""

    centre_m: Array
    radius_m: float
    reflectance: float

    def met(self, origin: Array, way: Array) -> tuple[Array, Array]:
        """Range and strength of rays, shape (n,)."""
        to = self.centre_m - origin
        along = np.einsum("ij,ij->i", to, way)
        under = self.radius_m**2 - (np.einsum("ij,ij->i", to, to) - along**2)
        hit = under > 0.0
        reach = along - np.sqrt(np.maximum(under, 0.0))
        normal = (origin + reach[:, None] * way - self.centre_m) / self.radius_m
        cosine = np.abs(np.einsum("ij,ij->i", normal, way))
        return np.where(hit, reach, np.inf), np.where(hit, self.reflectance * cosine, 0.0)


def ground(texture: Texture) -> Panel:
    """Level ground at height 0."""
    return Panel(np.zeros(3), np.eye(3), np.inf, texture)


def axes_of(tilt_rad: float, azimuth_rad: float, spin_rad: float) -> Array:
    """Axes of a panel that leans by `tilt` towards `azimuth` and is turned in its plane."""

    def about_z(angle: float) -> Array:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    lean = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return about_z(azimuth_rad) @ lean @ about_z(spin_rad)


def board(size_m: float, dark: float = 0.05, bright: float = 0.8) -> Texture:
    """Four squares, two bright and two dark, `size_m` over all; outside: dark grey."""

    def texture(u: Array, v: Array) -> Array:
        inside = np.maximum(np.abs(u), np.abs(v)) <= size_m / 2.0
        return np.where(inside, np.where(u * v > 0.0, bright, dark), 0.25)

    return texture


def cross(length_m: float, width_m: float, back: float = 0.1, bright: float = 0.8) -> Texture:
    """A bright cross with arms of `length_m` from end to end."""

    def texture(u: Array, v: Array) -> Array:
        short, long = np.minimum(np.abs(u), np.abs(v)), np.maximum(np.abs(u), np.abs(v))
        return np.where((short <= width_m / 2.0) & (long <= length_m / 2.0), bright, back)

    return texture


def disc(diameter_m: float, back: float = 0.1, bright: float = 0.8) -> Texture:
    """A bright disc."""
    return lambda u, v: np.where(np.hypot(u, v) <= diameter_m / 2.0, bright, back)


def placed(texture: Texture, place: Sequence[float], spin_rad: float) -> Texture:
    """A texture about another place of the surface, turned."""
    c, s = np.cos(spin_rad), np.sin(spin_rad)
    return lambda u, v: texture(c * (u - place[0]) + s * (v - place[1]), -s * (u - place[0]) + c * (v - place[1]))


def seen(
    surfaces: Sequence[Panel | Ball],
    per_m2: float,
    rng: np.random.Generator,
    height_m: float = 30.0,
    half_m: float = 2.0,
) -> tuple[Array, Array]:
    """Points, shape (n, 3), and their intensities from 0 to 255, of a square about the origin as a flight overhead sees it.

    The footprint's rays lie within the full divergence; of what they meet, the nearest half metre makes the echo.
    """
    count = rng.poisson(per_m2 * (2.0 * half_m) ** 2)
    aim = np.column_stack([rng.uniform(-half_m, half_m, (count, 2)), np.zeros(count)])
    # two strips of flight, one to each side, and what lies ahead and behind
    side = np.where(rng.random(count) < 0.5, -0.3, 0.3) * height_m + rng.normal(0.0, 0.05 * height_m, count)
    origin = np.column_stack([side, rng.uniform(-0.6, 0.6, count) * height_m, np.full(count, height_m)])
    axis = aim - origin
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    right = np.cross(axis, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1)[:, None]
    up = np.cross(right, axis)
    ring = np.sqrt((np.arange(RAYS) + 0.5) / RAYS) * DIVERGENCE_RAD / 2.0
    turn = np.arange(RAYS) * np.pi * (3.0 - np.sqrt(5.0))
    reach, strength = np.full((count, RAYS), np.inf), np.zeros((count, RAYS))
    for k in range(RAYS):
        way = axis + ring[k] * (np.cos(turn[k]) * right + np.sin(turn[k]) * up)
        way /= np.linalg.norm(way, axis=1)[:, None]
        for surface in surfaces:
            distance, back = surface.met(origin, way)
            nearer = distance < reach[:, k]
            reach[nearer, k], strength[nearer, k] = distance[nearer], back[nearer]
    first = reach.min(axis=1)
    used = np.where(reach <= first[:, None] + 0.5, strength, 0.0)
    total = used.sum(axis=1)
    back = total > 0.0
    distance = (used * np.where(np.isfinite(reach), reach, 0.0)).sum(axis=1)[back] / total[back]
    distance += rng.normal(0.0, RANGE_NOISE_M, len(distance))
    value = 100.0 * total[back] / RAYS * np.clip(1.0 + STRENGTH_NOISE * rng.standard_normal(len(distance)), 0.05, None)
    return origin[back] + distance[:, None] * axis[back], np.clip(np.rint(value), 0, 255)
