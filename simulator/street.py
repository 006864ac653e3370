"""Streets between plain facades: nothing but parked cars, or nothing at all, tells how far one has come along them."""

from typing import Final

import numpy as np

from simulator.buildings import add_car, add_house, add_tree, add_wall
from simulator.meshes import quad
from simulator.moving import Tracks, flat, over_ground
from simulator.parts import Parts, World
from simulator.route import Route

_SIDES: Final = (("north", 1.0), ("south", -1.0))
_ROUTE: Final = Route(
    points_m=((-200.0, -1.5, 2.1), (200.0, -1.5, 2.1), (206.0, 1.0, 2.1), (200.0, 3.0, 2.1), (-200.0, 3.0, 2.1)),
    speed_m_s=6.0,
    loop_from=-1,
    kind="car",
)
_BACK_TO_YARD: Final = Route(
    points_m=((-158.0, -1.5, 2.1), (150.0, -1.5, 2.1), (156.0, 1.0, 2.1), (150.0, 3.0, 2.1), (-158.0, 3.0, 2.1)),
    speed_m_s=12.0,
    loop_from=-1,
    kind="car",
)
_HOUSES: Final = (
    (-160.0, 20.0, 20.0, (12.0, 8.0)), (-150.0, -17.0, -35.0, (9.0, 7.0)), (-128.0, 26.0, 60.0, (8.0, 6.0)),
    (-182.0, -4.0, 80.0, (10.0, 7.0)), (-126.0, -24.0, 10.0, (7.0, 6.0)),
)  # fmt: skip
"""Of the yard: east, north [m], turn [deg], size [m]."""
_TRACKS: Final = Tracks((over_ground([(-280.0, -4.0), (280.0, -4.0), (280.0, 4.5), (-280.0, 4.5)], flat),))


def facades(rng: np.random.Generator) -> tuple[World, dict[str, Route], Tracks]:
    """Two plain walls of 600 m and cars parked along them, driven at 6 m/s with the lidar at the height of a car's roof."""
    parts = Parts()
    _add_street(parts)
    for name, side in _SIDES:
        away_m = _add_facade(parts, f"facade {name}", side, (8.5, 11.0), rng)
        x = -290.0
        while x < 290.0:
            add_car(parts, f"car {name} {x:.0f}", np.array([x, side * (away_m - 2.0), 0.0]), 90.0 + rng.uniform(-3, 3))
            x += float(rng.choice([6.0, 7.5, 13.0, 22.0])) + rng.uniform(0.0, 2.0)
    return parts.world(), {"street": _ROUTE}, _TRACKS


def empty_street(rng: np.random.Generator) -> tuple[World, dict[str, Route], Tracks]:
    """The walls of `facades` 28 to 34 m apart, without a single car: along the street nothing tells the way."""
    parts = Parts()
    _add_street(parts)
    for name, side in _SIDES:
        _add_facade(parts, f"facade {name}", side, (14.0, 17.0), rng)
    return parts.world(), {"street": _ROUTE}, _TRACKS


def yard_street(rng: np.random.Generator) -> tuple[World, dict[str, Route], Tracks]:
    """A yard of five houses, trees and a car, from which a street between plain facades leads away for 400 m; out and back again."""
    parts = Parts()
    _add_street(parts)
    for number, (x, y, turn_deg, size_m) in enumerate(_HOUSES):
        house = Parts()
        add_house(house, f"house {number}", size_m, 4.0, 6.5, None)
        parts.place(house, np.array([x, y, 0.0]), turn_deg)
    for number, (x, y) in enumerate(((-140.0, 13.0), (-137.0, -12.0), (-171.0, 11.0))):
        add_tree(parts, f"tree {number}", np.array([x, y, 0.0]), 6.0, rng, 400)
    add_car(parts, "car", np.array([-145.0, 8.0, 0.0]), 70.0)
    for name, side in _SIDES:
        begin = 300.0 if side < 0.0 else -110.0
        away = float(rng.uniform(14.0, 17.0))
        wall = (np.array([begin, side * away, 0.0]), np.array([side, 0, 0]), np.array([0, -side, 0]))
        add_wall(parts, f"facade {name}", wall, (410.0, float(rng.uniform(9.0, 14.0))), None)
    return parts.world(), {"back": _BACK_TO_YARD}, Tracks()


def _add_street(parts: Parts) -> None:
    parts.add("street", "asphalt", quad((-320, -30, 0), (640, 0, 0), (0, 60, 0)))


def _add_facade(parts: Parts, name: str, side: float, away_m: tuple[float, float], rng: np.random.Generator) -> float:
    """A plain wall on one side, somewhere between two distances from the street's middle; its own."""
    away = float(rng.uniform(*away_m))
    wall = (np.array([-side * 300.0, side * away, 0.0]), np.array([side, 0, 0]), np.array([0, -side, 0]))
    add_wall(parts, name, wall, (600.0, float(rng.uniform(9.0, 14.0))), None)
    return away
