"""Clouds of places with known truth, made without flying: points drawn from surfaces, for what is judged on clouds alone.

x east, y north, z up, metres. Random numbers come from the seed alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

GROUND, TREE, SHRUB, ROOF, WALL, NOISE = 2, 5, 3, 6, 60, 7
"""What a point was drawn from."""


@dataclass(frozen=True, slots=True)
class House:
    """A house with a gable roof.

    Attributes
    ----------
    x, y, turn_rad : float
        Of its middle, and of its length from the east.
    length_m, width_m : float
    eaves_m, rise_m : float
        Height of the eaves above the ground at its middle, and of the ridge above them; 0 is a flat roof.
    """

    x: float
    y: float
    turn_rad: float
    length_m: float
    width_m: float
    eaves_m: float
    rise_m: float

    def along(self, xy: Array) -> tuple[Array, Array]:
        """Coordinates along length and width, from the middle."""
        dx, dy = xy[:, 0] - self.x, xy[:, 1] - self.y
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return c * dx + s * dy, c * dy - s * dx

    def corners(self) -> Array:
        """Shape (4, 2)."""
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        u = np.array([1, 1, -1, -1]) * self.length_m / 2
        v = np.array([1, -1, -1, 1]) * self.width_m / 2
        return np.stack([self.x + c * u - s * v, self.y + s * u + c * v], axis=1)


@dataclass(frozen=True, slots=True)
class Tree:
    """A stem and a crown, an ellipsoid; a dead tree has branches in place of leaves."""

    x: float
    y: float
    height_m: float
    crown_m: float
    dead: bool = False


@dataclass(frozen=True, slots=True)
class Place:
    """A cloud and what is true of it.

    Attributes
    ----------
    xyz : ndarray, shape (n, 3)
    kind : ndarray of uint8, shape (n,)
    ground : callable
        Height of the ground at places, shape (n, 2) -> (n,).
    houses, trees : list
    """

    xyz: Array
    kind: npt.NDArray[np.uint8]
    ground: Callable[[Array], Array]
    houses: list[House] = field(default_factory=list)
    trees: list[Tree] = field(default_factory=list)


def rolling(xy: Array) -> Array:
    """A valley side with a bank of 1.5 m across it."""
    x, y = xy[:, 0], xy[:, 1]
    bank = 1.5 / (1.0 + np.exp(-(y - 60.0 - 6.0 * np.sin(x / 17.0)) / 0.7))
    return np.asarray(100.0 + 0.08 * x + 3.0 * np.sin(x / 40.0) * np.cos(y / 35.0) + bank)


def village(seed: int = 0, side_m: float = 120.0, per_m2: float = 20.0, noise_m: float = 0.03) -> Place:
    """Houses, trees, shrubs and stray points on a valley side."""
    rng = np.random.default_rng(seed)
    houses = _houses(rng, side_m)
    trees = _trees(rng, side_m, houses, 40, (5.0, 16.0))
    xy = rng.uniform(0, side_m, (int(side_m**2 * per_m2), 2))
    z, kind = rolling(xy), np.full(len(xy), GROUND, np.uint8)
    keep = np.ones(len(xy), np.bool_)
    for house in houses:
        u, v = house.along(xy)
        on = (np.abs(u) <= house.length_m / 2) & (np.abs(v) <= house.width_m / 2)
        base = _base(house)
        z[on] = base + house.eaves_m + house.rise_m * (1.0 - np.abs(v[on]) / (house.width_m / 2))
        kind[on] = ROOF
    for tree in trees:
        under = (np.hypot(xy[:, 0] - tree.x, xy[:, 1] - tree.y) < tree.crown_m) & (kind == GROUND)
        keep &= ~under | (rng.random(len(xy)) < 0.35)
    parts, kinds = [np.column_stack([xy, z])[keep]], [kind[keep]]
    for house in houses:
        parts.append(_walls(rng, house, per_m2))
        kinds.append(np.full(len(parts[-1]), WALL, np.uint8))
    for tree in trees:
        parts.append(tree_points(rng, tree, float(rolling(np.array([[tree.x, tree.y]]))[0]), per_m2))
        kinds.append(np.full(len(parts[-1]), TREE, np.uint8))
    parts.append(_shrubs(rng, side_m, per_m2, houses))
    kinds.append(np.full(len(parts[-1]), SHRUB, np.uint8))
    xyz, kind = np.concatenate(parts), np.concatenate(kinds)
    xyz[:, 2] += rng.normal(0, noise_m, len(xyz))
    stray = rng.uniform((0, 0, -1), (side_m, side_m, 1), (24, 3))
    stray[:, 2] = rolling(stray[:, :2]) + np.where(stray[:, 2] < 0, -6.0, 45.0) + rng.normal(0, 1, len(stray))
    return Place(
        np.concatenate([xyz, stray]), np.append(kind, np.full(len(stray), NOISE, np.uint8)), rolling, houses, trees
    )


def wood(seed: int = 0, side_m: float = 100.0, per_m2: float = 100.0, spacing_m: float = 6.0) -> Place:
    """Trees that stand some metres apart, one in fifteen dead, seen from above by a scanner that also sees stems."""
    rng = np.random.default_rng(seed)
    trees: list[Tree] = []
    for x, y in rng.uniform(0, side_m, (int(4 * side_m**2 / spacing_m**2), 2)):
        if all(np.hypot(x - t.x, y - t.y) > spacing_m * 0.9 for t in trees):
            height = float(rng.uniform(9, 24))
            trees.append(
                Tree(
                    float(x),
                    float(y),
                    height,
                    float(np.clip(0.14 * height + rng.normal(0, 0.2), 1.2, 3.5)),
                    bool(rng.random() < 1 / 15),
                )
            )
    xy = rng.uniform(0, side_m, (int(side_m**2 * per_m2 * 0.35), 2))
    parts = [np.column_stack([xy, rolling(xy)])]
    kinds = [np.full(len(xy), GROUND, np.uint8)]
    for tree in trees:
        parts.append(tree_points(rng, tree, float(rolling(np.array([[tree.x, tree.y]]))[0]), per_m2))
        kinds.append(np.full(len(parts[-1]), TREE, np.uint8))
    xyz = np.concatenate(parts)
    xyz[:, 2] += rng.normal(0, 0.03, len(xyz))
    return Place(xyz, np.concatenate(kinds), rolling, [], trees)


def tree_points(rng: np.random.Generator, tree: Tree, base_m: float, per_m2: float) -> Array:
    """Points of a tree: mostly of the upper outside of its crown, some within, some of the stem."""
    area = np.pi * tree.crown_m**2
    count = max(int(area * per_m2 * (0.25 if tree.dead else 0.8)), 8)
    half = min(0.35 * tree.height_m, 2.2 * tree.crown_m)
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    way[:, 2] = np.where(rng.random(count) < 0.8, np.abs(way[:, 2]), way[:, 2])
    far = np.ones((count, 1)) - np.abs(rng.normal(0, 0.5 if tree.dead else 0.12, (count, 1)))
    crown = way * far * (tree.crown_m, tree.crown_m, half) + (tree.x, tree.y, base_m + tree.height_m - half)
    tall = rng.uniform(0.2, tree.height_m - half, max(int(per_m2 * 0.35 * tree.height_m * 0.3), 4))
    turn = rng.uniform(0, 2 * np.pi, len(tall))
    radius = 0.012 * tree.height_m
    stem = np.stack([tree.x + radius * np.cos(turn), tree.y + radius * np.sin(turn), base_m + tall], axis=1)
    return np.concatenate([crown, stem])


def _base(house: House) -> float:
    return float(rolling(np.array([[house.x, house.y]]))[0])


def _houses(rng: np.random.Generator, side_m: float) -> list[House]:
    found: list[House] = []
    for number in range(200):
        if len(found) == 9:
            break
        x, y = rng.uniform(12, side_m - 12, 2)
        if all(np.hypot(x - h.x, y - h.y) > 22 for h in found):
            rise = 0.0 if number % 3 == 0 else float(rng.uniform(1.5, 3.5))
            found.append(
                House(float(x), float(y), float(rng.uniform(0, np.pi)), float(rng.uniform(9, 16)), float(rng.uniform(7, 10)),
                      float(rng.uniform(3.0, 5.5)), rise)
            )  # fmt: skip
    return found


def _trees(
    rng: np.random.Generator, side_m: float, houses: list[House], count: int, tall: tuple[float, float]
) -> list[Tree]:
    found: list[Tree] = []
    while len(found) < count:
        x, y = rng.uniform(3, side_m - 3, 2)
        height = float(rng.uniform(*tall))
        crown = float(np.clip(0.17 * height, 1.2, 3.0))
        if all(np.hypot(x - h.x, y - h.y) > h.length_m / 2 + crown + 2 for h in houses) and all(
            np.hypot(x - t.x, y - t.y) > t.crown_m + crown for t in found
        ):
            found.append(Tree(float(x), float(y), height, crown))
    return found


def _walls(rng: np.random.Generator, house: House, per_m2: float) -> Array:
    """Points of the walls, a third as dense as the ground."""
    corners, parts = house.corners(), []
    base = _base(house)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        count = int(length * house.eaves_m * per_m2 / 3)
        xy = a + rng.random((count, 1)) * (b - a)
        low = rolling(xy)
        parts.append(np.column_stack([xy, low + rng.random(count) * np.maximum(base + house.eaves_m - low, 0.1)]))
    return np.concatenate(parts)


def _shrubs(rng: np.random.Generator, side_m: float, per_m2: float, houses: list[House]) -> Array:
    parts = [np.empty((0, 3))]
    for x, y in rng.uniform(3, side_m - 3, (60, 2)):
        if any(np.hypot(x - h.x, y - h.y) < h.length_m for h in houses):
            continue
        count = int(np.pi * per_m2)
        way = rng.normal(size=(count, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        size = rng.uniform(0.7, 1.2)
        parts.append(way * (0.9, 0.9, 0.4 * size) * rng.random((count, 1)) ** 0.3 + (x, y, 0.0))
        parts[-1][:, 2] = rolling(parts[-1][:, :2]) + 0.6 * size + parts[-1][:, 2]
    return np.concatenate(parts)


def with_vehicles(xyz: Array, above_m: Array, seed: int, count: int) -> tuple[Array, Array]:
    """A cloud seen from above, with boxes of the size of cars in the way of some pulses.

    Points below the top of a box and above its area are lifted onto it; its front is lower. The top is parallel to the ground under it.

    Parameters
    ----------
    xyz : ndarray, shape (n, 3)
    above_m : ndarray, shape (n,)
        Heights above a smooth ground.
    seed, count : int

    Returns
    -------
    xyz : ndarray, shape (n, 3)
    boxes : ndarray, shape (count, 6)
        Middle east and north, turn from east [rad], length, width, height.
    """
    rng = np.random.default_rng(seed)
    low, high = xyz[:, :2].min(axis=0) + 6.0, xyz[:, :2].max(axis=0) - 6.0
    boxes: list[tuple[float, ...]] = []
    while len(boxes) < count:
        x, y = rng.uniform(low, high)
        if all(np.hypot(x - b[0], y - b[1]) > 9.0 for b in boxes):
            boxes.append((x, y, rng.uniform(0, np.pi), rng.uniform(4, 4.8), rng.uniform(1.7, 2), rng.uniform(1.4, 1.9)))
    out = xyz.copy()
    for x, y, turn, length, width, height in boxes:
        near = np.flatnonzero(np.abs(xyz[:, :2] - (x, y)).max(axis=1) < 4.0)
        d = xyz[near, :2] - (x, y)
        design = np.column_stack([np.ones(len(d)), d])
        ground = design @ np.linalg.lstsq(design, xyz[near, 2] - above_m[near], rcond=None)[0]
        u, v = d @ [np.cos(turn), np.sin(turn)], d @ [-np.sin(turn), np.cos(turn)]
        hit = (np.abs(u) < length / 2) & (np.abs(v) < width / 2) & (above_m[near] < height)
        top = np.where(u > length / 4, 0.6 * height, height)
        out[near[hit], 2] = (ground + top + rng.normal(0, 0.03, len(near)))[hit]
    return out, np.array(boxes)
