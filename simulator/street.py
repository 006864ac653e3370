"""A street between plain facades: nothing but parked cars tells how far one has come along it."""

import numpy as np

from simulator.buildings import add_car, add_wall
from simulator.meshes import quad
from simulator.moving import Tracks, flat, over_ground
from simulator.parts import Parts, World
from simulator.route import Route


def facades(rng: np.random.Generator) -> tuple[World, dict[str, Route], Tracks]:
    """Two plain walls of 600 m and cars parked along them, driven at 6 m/s with the lidar at the height of a car's roof."""
    parts = Parts()
    parts.add("street", "asphalt", quad((-320, -30, 0), (640, 0, 0), (0, 60, 0)))
    for name, side in (("north", 1.0), ("south", -1.0)):
        away = side * rng.uniform(8.5, 11.0)
        wall = (np.array([-side * 300.0, away, 0.0]), np.array([side, 0, 0]), np.array([0, -side, 0]))
        add_wall(parts, f"facade {name}", wall, (600.0, float(rng.uniform(9.0, 14.0))), None)
        x = -290.0
        while x < 290.0:
            add_car(
                parts, f"car {name} {x:.0f}", np.array([x, side * (abs(away) - 2.0), 0.0]), 90.0 + rng.uniform(-3, 3)
            )
            x += float(rng.choice([6.0, 7.5, 13.0, 22.0])) + rng.uniform(0.0, 2.0)
    points = ((-200.0, -1.5, 2.1), (200.0, -1.5, 2.1), (206.0, 1.0, 2.1), (200.0, 3.0, 2.1), (-200.0, 3.0, 2.1))
    route = Route(points_m=points, speed_m_s=6.0, loop_from=-1, kind="car")
    lanes = [(-280.0, -4.0), (280.0, -4.0), (280.0, 4.5), (-280.0, 4.5)]
    return parts.world(), {"street": route}, Tracks((over_ground(lanes, flat),))
