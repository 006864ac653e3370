"""A wooded slope with one hut: hardly a plane that is not the ground."""

from itertools import pairwise

import numpy as np
import numpy.typing as npt

from simulator.buildings import add_house, add_tree
from simulator.meshes import height_grid, quad
from simulator.moving import Tracks, over_ground
from simulator.parts import Parts, World
from simulator.route import Route

Array = npt.NDArray[np.float64]

_HALF_M = 80.0


def wood_height(x_m: Array, y_m: Array) -> Array:
    """Height of the slope: up to 15 deg towards the north, with humps of 80 cm over 25 m and 10 cm over 6 m; shape as given [m]."""
    x_m, y_m = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
    slope = 0.18 * y_m + 3.0 * np.sin(2 * np.pi * y_m / 220.0)
    humps = 0.8 * np.sin(2 * np.pi * x_m / 25.0 + 0.5) * np.cos(2 * np.pi * y_m / 31.0)
    return np.asarray(slope + humps + 0.1 * np.sin(2 * np.pi * (x_m - 0.5 * y_m) / 6.0))


def wood(rng: np.random.Generator) -> tuple[World, dict[str, Route], Tracks]:
    """Seventy trees on a rough slope with a hut, and a way round among them."""
    parts = Parts()
    axis = np.arange(-_HALF_M, _HALF_M + 0.25, 0.5)
    x, y = np.meshgrid(axis, axis)
    z = wood_height(x, y) + rng.normal(scale=0.02, size=x.shape)
    parts.add("floor", "grass", height_grid(axis, axis, z))
    parts.add("valley", "soil", quad((-400, -400, -20.0), (800, 0, 0), (0, 320, 0)))
    corners = [(-40.0, -30.0), (0.0, -38.0), (42.0, -25.0), (36.0, 20.0), (5.0, 34.0), (-38.0, 28.0)]
    way = np.array([*corners, corners[0]])
    share = np.linspace(0.0, 1.0, 20)[:, None]
    lane = np.concatenate([a + share * (b - a) for a, b in pairwise(way)])
    planted = 0
    while planted < 70:
        spot = rng.uniform(-70.0, 70.0, 2)
        if np.linalg.norm(lane - spot, axis=1).min() < 4.5:
            continue
        at = np.array([*spot, float(wood_height(spot[0], spot[1])) - 0.1])
        add_tree(parts, f"tree {planted}", at, rng.uniform(6.0, 12.0), rng, 700)
        planted += 1
    hut = Parts()
    add_house(hut, "hut", (6.0, 4.5), 2.4, 3.6, None)
    parts.place(hut, np.array([12.0, -4.0, float(wood_height(np.array(12.0), np.array(-4.0))) - 0.5]), 25.0)
    above = 4.0 + 6.0 * rng.random(len(corners))
    points = [
        (x, y, float(wood_height(np.array(x), np.array(y)) + h)) for (x, y), h in zip(corners, above, strict=True)
    ]
    route = Route(points_m=(*points, points[0]), speed_m_s=4.5)
    walk = over_ground([(-42.0, -33.0), (40.0, -28.0), (40.0, -29.5), (-42.0, -34.5)], wood_height)
    return parts.world(), {"round": route}, Tracks(people=(walk,))
