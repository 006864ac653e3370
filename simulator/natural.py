"""Meadow, bare field, crops, a slope with bushes and the bank of a lake: hardly a wall, and little that is a plane but the ground."""

import numpy as np
import numpy.typing as npt

from simulator.buildings import add_car, add_tree
from simulator.meshes import height_grid, prism, quad
from simulator.moving import Tracks, over_ground
from simulator.parts import Parts, World
from simulator.route import Route
from simulator.terrain import Relief, add_bush, add_plants, add_relief

Array = npt.NDArray[np.float64]
Place = tuple[World, dict[str, Route], Tracks]

_HALF_M = 90.0
_LINES = ((-42.0, -22.0), (40.0, -22.0), (40.0, -6.0), (-40.0, -6.0), (-40.0, 10.0), (40.0, 10.0))
"""Corner points of a survey in lines."""


def _away(rng: np.random.Generator, taken_m: list[Array], half_m: tuple[float, float], apart_m: float) -> Array:
    """A spot (east, north) so far from those taken, which it joins."""
    while True:
        spot: Array = rng.uniform(-1.0, 1.0, 2) * np.array(half_m)
        if all(np.linalg.norm(spot - other) > apart_m for other in taken_m):
            taken_m.append(spot)
            return spot


def _lines(
    relief: Relief, rng: np.random.Generator, low_m: float, high_m: float
) -> tuple[tuple[float, float, float], ...]:
    """The survey's corner points, each at a height of its own above the ground."""
    return relief.over(_LINES, rng.uniform(low_m, high_m, len(_LINES)))


def meadow(rng: np.random.Generator) -> Place:
    """Rough ground with tufts, a tree line in the north, five single trees and two cars; flown in lines, or after a hover of 10 s."""
    parts = Parts()
    relief = Relief.drawn(rng, ((40.0, 0.25), (9.0, 0.07), (2.5, 0.03)))
    add_relief(parts, relief, _HALF_M, 0.5, 0.025, rng)
    roots = rng.uniform(-65.0, 65.0, (5000, 2))
    roots = np.column_stack([roots, relief.height(*roots.T)])
    size = np.column_stack([rng.uniform(0.15, 0.5, len(roots)), rng.uniform(0.1, 0.45, len(roots))])
    add_plants(parts, "tufts", roots, size, 9, rng)
    for i, x in enumerate(np.arange(-75.0, 76.0, 7.5)):
        at = relief.at(x + rng.uniform(-3.0, 3.0), 46.0 + rng.uniform(-4.0, 4.0), -0.1)
        add_tree(parts, f"line tree {i}", at, rng.uniform(6.0, 13.0), rng, 900)
    taken: list[Array] = [np.array([-42.0, -22.0])]
    for i in range(5):
        x, y = _away(rng, taken, (50.0, 36.0), 14.0)
        add_tree(parts, f"tree {i}", relief.at(x, y, -0.1), rng.uniform(4.0, 8.0), rng)
    for i in range(2):
        x, y = _away(rng, taken, (38.0, 30.0), 8.0)
        add_car(parts, f"car {i}", relief.at(x, y), rng.uniform(0.0, 360.0))
    points = _lines(relief, rng, 8.0, 12.0)
    walk = over_ground([(-40.0, -26.0), (40.0, -26.0), (40.0, -27.0), (-40.0, -27.0)], relief.height)
    routes = {
        "lines": Route(points_m=points, speed_m_s=5.0, loop_from=0),
        "hover": Route(points_m=points, speed_m_s=5.0, loop_from=0, hold_s=11.0),
    }
    return parts.world(), routes, Tracks(people=(walk,))


def bare_field(rng: np.random.Generator) -> Place:
    """Ploughed ground and nothing else within reach: where a lidar tells height and tilt, and next to nothing of the way."""
    parts = Parts()
    relief = Relief.drawn(rng, ((60.0, 0.15), (12.0, 0.03)))
    add_relief(parts, relief, _HALF_M, 0.5, 0.02, rng, "soil")
    return (
        parts.world(),
        {"lines": Route(points_m=_lines(relief, rng, 9.0, 12.0), speed_m_s=5.0, loop_from=0)},
        Tracks(),
    )


def crops(rng: np.random.Generator) -> Place:
    """Rows of plants, a hedge along one side and one pole."""
    parts = Parts()
    relief = Relief.drawn(rng, ((50.0, 0.2), (10.0, 0.04)))
    add_relief(parts, relief, _HALF_M, 0.5, 0.02, rng, "soil")
    height_m, turn = rng.uniform(0.5, 1.0), rng.uniform(-0.3, 0.3)
    along, across = np.meshgrid(np.arange(-75.0, 75.0, 0.3), np.arange(-55.0, 30.0, 0.75))
    across = across + rng.normal(scale=0.03, size=across.shape)
    x = (np.cos(turn) * along - np.sin(turn) * across).ravel()
    y = (np.sin(turn) * along + np.cos(turn) * across).ravel()
    roots = np.column_stack([x, y, relief.height(x, y)])
    size = np.column_stack([np.full(len(x), 0.35), height_m * rng.uniform(0.8, 1.1, len(x))])
    add_plants(parts, "crops", roots, size, 4, rng, 0.14)
    x, y = rng.uniform(-70.0, 70.0, 2600), 38.0 + rng.uniform(-0.8, 0.8, 2600)
    hedge = np.column_stack([x, y, relief.height(x, y)])
    add_plants(parts, "hedge", hedge, np.tile([0.6, rng.uniform(1.6, 2.6)], (len(x), 1)), 9, rng, 0.12)
    foot = relief.at(float(rng.uniform(-25.0, 25.0)), float(rng.uniform(12.0, 30.0)), -0.3)
    parts.add("pole", "wood", prism(foot, foot + np.array([0.0, 0.0, 8.3]), 0.13, 8))
    return (
        parts.world(),
        {"lines": Route(points_m=_lines(relief, rng, 7.0, 10.0), speed_m_s=5.0, loop_from=0)},
        Tracks(),
    )


def slope(rng: np.random.Generator) -> Place:
    """A slope of 12 to 20 deg with bushes, flown along its contour lines."""
    parts = Parts()
    lean, course = np.tan(np.radians(rng.uniform(12.0, 20.0))), rng.uniform(-0.5, 0.5)
    relief = Relief.drawn(rng, ((35.0, 0.4), (8.0, 0.08)), (float(lean * np.sin(course)), float(lean * np.cos(course))))
    add_relief(parts, relief, _HALF_M, 0.5, 0.03, rng)
    taken: list[Array] = [np.array([-42.0, -22.0])]
    for i in range(60):
        x, y = _away(rng, taken, (70.0, 55.0), 3.5)
        add_bush(parts, f"bush {i}", relief.at(x, y), rng.uniform(0.8, 2.5), rng)
    return (
        parts.world(),
        {"lines": Route(points_m=_lines(relief, rng, 7.0, 11.0), speed_m_s=5.0, loop_from=0)},
        Tracks(),
    )


def bank(rng: np.random.Generator) -> Place:
    """Water to the horizon and one bank with tufts, reeds and a few bushes, flown along over the water."""
    parts = Parts()
    far_m = 300.0
    relief = Relief.drawn(rng, ((40.0, 0.15), (9.0, 0.06), (2.5, 0.03)), (0.0, -0.06))
    east, south = np.arange(-150.0, 150.5, 0.5), np.arange(-40.0, 0.5, 0.5)
    x, y = np.meshgrid(east, south)
    # the ground goes down into the water along a line that is not straight
    z = relief.height(x, y) + 0.35 + rng.normal(scale=0.02, size=x.shape)
    parts.add("ground", "grass", height_grid(east, south, z - np.where(y >= 0.0, 2.0, 0.0)))
    parts.add("water", "water", quad((-far_m, -20.0, 0.0), (2.0 * far_m, 0, 0), (0, far_m, 0)))
    for name, count, nearest_m, farthest_m, size_m in (
        ("tufts", 1500, -38.0, -3.0, (0.1, 0.4)),
        ("reeds", 700, -3.0, -0.3, (0.8, 1.6)),
    ):
        roots = np.column_stack([rng.uniform(-140.0, 140.0, count), rng.uniform(nearest_m, farthest_m, count)])
        roots = np.column_stack([roots, relief.height(*roots.T) + 0.3])
        size = np.column_stack([rng.uniform(0.2, 0.6, count), rng.uniform(*size_m, count)])
        add_plants(parts, name, roots, size, 9, rng)
    for i in range(14):
        x, y = rng.uniform((-120.0, -30.0), (120.0, -4.0)).tolist()
        add_bush(parts, f"bush {i}", relief.at(x, y, 0.3), rng.uniform(0.8, 2.2), rng)
    low, high = rng.uniform(5.0, 9.0, 2).tolist()
    points = ((-70.0, 7.0, low), (70.0, 9.0, high), (70.0, 15.0, high), (-70.0, 13.0, low))
    walk = over_ground([(-60.0, -20.0), (60.0, -20.0), (60.0, -21.0), (-60.0, -21.0)], relief.height)
    return (
        parts.world(),
        {"along": Route(points_m=points, speed_m_s=5.0, loop_from=0)},
        Tracks(people=(walk,)),
    )
