"""Shapes as triangles: every function returns corners, shape (n, 3, 3), in metres; nothing here knows of materials."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float] | Array


def quad(corner: Vector, side_a: Vector, side_b: Vector) -> Array:
    """A parallelogram from one corner and two sides; its normal is side_a x side_b."""
    corner, a, b = (np.asarray(v, np.float64) for v in (corner, side_a, side_b))
    return np.array([[corner, corner + a, corner + a + b], [corner, corner + a + b, corner + b]])


def box(low: Vector, high: Vector) -> Array:
    """An upright box between two corners."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    x, y, z = np.diag(high - low)
    faces = [(low, y, x), (low, x, z), (low, z, y), (high, -x, -y), (high, -z, -x), (high, -y, -z)]
    return np.concatenate([quad(*face) for face in faces])


def prism(start: Vector, end: Vector, radius_m: float, sides: int = 6) -> Array:
    """A bar from start to end with a regular cross section, open at its ends."""
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    across = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = radius_m * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across))
    following = np.roll(ring, -1, axis=0)
    return np.concatenate([quad(start + ring[i], following[i] - ring[i], end - start) for i in range(sides)])


def height_grid(x_m: Array, y_m: Array, z_m: Array) -> Array:
    """A surface over a regular grid, z_m of shape (len(y_m), len(x_m))."""
    points = np.stack([*np.meshgrid(x_m, y_m), z_m], axis=-1)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    triangles = np.stack([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)])
    return np.asarray(triangles.reshape(-1, 3, 3))


def leaves(centre: Vector, radii: Vector, count: int, size_m: float, rng: np.random.Generator) -> Array:
    """Triangles of random attitude in an ellipsoid, denser towards its skin as a crown is."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    position = np.asarray(centre) + direction * np.asarray(radii) * rng.random((count, 1)) ** 0.25
    return np.asarray(position[:, None] + rng.normal(scale=size_m / 2, size=(count, 3, 3)))


def catenary(start: Vector, end: Vector, sag_m: float, radius_m: float, segments: int = 24) -> Array:
    """A wire that hangs between two points (a parabola, which a taut catenary is to a millimetre)."""
    share = np.linspace(0.0, 1.0, segments + 1)[:, None]
    points = np.asarray(start) + (np.asarray(end) - np.asarray(start)) * share
    points[:, 2] -= 4 * sag_m * (share * (1 - share))[:, 0]
    return np.concatenate([prism(points[i], points[i + 1], radius_m, 3) for i in range(segments)])


def placed(triangles: Array, at: Vector, heading_deg: float = 0.0) -> Array:
    """A shape turned clockwise (seen from above) about its origin and moved to a place."""
    angle = np.radians(-heading_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return np.asarray(triangles @ turn.T + np.asarray(at))
