"""A lake with one shore: what a lidar hardly sees."""

import numpy as np

from simulator.buildings import add_house, add_tree
from simulator.meshes import box, prism, quad
from simulator.moving import Tracks, over_ground
from simulator.parts import Parts, World
from simulator.route import Route


def lake(rng: np.random.Generator) -> tuple[World, dict[str, Route], Tracks]:
    """Water to the horizon, a shore in the south with trees, a boathouse and a jetty; flown out of sight of land, or out and back."""
    parts = Parts()
    far_m = 500.0
    parts.add("water", "water", quad((-far_m, 0, 0), (2 * far_m, 0, 0), (0, 2 * far_m, 0)))
    parts.add("bank", "soil", quad((-far_m, -1.0, 0.8), (2 * far_m, 0, 0), (0, 1.0, -0.8)))
    parts.add("shore", "grass", quad((-far_m, -far_m, 0.8), (2 * far_m, 0, 0), (0, far_m - 1.0, 0)))
    for x in np.arange(-90.0, 91.0, 15.0):
        at = np.array([x, -22.0, 0.75]) + rng.uniform(-4, 4, 3) * [1, 1, 0]
        add_tree(parts, f"tree {x:.0f}", at, rng.uniform(6, 10), rng)
    house = Parts()
    add_house(house, "boathouse", (10.0, 6.0), 3.0, 4.8, None)
    parts.place(house, np.array([-12.0, -7.0, 0.8]), 8.0)
    parts.add("jetty", "wood", box((3.0, -1.0, 0.5), (5.0, 18.0, 0.7)))
    for y in np.arange(1.0, 18.0, 4.0):
        for x in (3.0, 5.0):
            parts.add("jetty piles", "wood", prism((x, y, -0.5), (x, y, 1.2), 0.1, 6))
    height = 4.0 + 3.0 * rng.random(5)
    square = [(-30.0, 160.0), (30.0, 160.0), (30.0, 220.0), (-30.0, 220.0)]
    around = tuple((x, y, float(z)) for (x, y), z in zip([*square, square[0]], height, strict=True))
    out = (
        (0.0, -10.0, 4.0),
        (0.0, 30.0, float(height[0])),
        (20.0, 170.0, float(height[1])),
        (-20.0, 170.0, float(height[2])),
    )
    walk = over_ground([(-40.0, -3.0), (40.0, -3.0), (40.0, -4.0), (-40.0, -4.0)], lambda x, _: np.full_like(x, 0.8))
    routes = {
        "open": Route(points_m=around, speed_m_s=5.0),
        "out": Route(points_m=(*out, (-20.0, 25.0, float(height[3]))), speed_m_s=7.0, loop_from=0),
    }
    return parts.world(), routes, Tracks(people=(walk,))
