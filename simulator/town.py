"""Nine blocks of houses with streets between them, and fields beside: for long flights, strips and drives."""

from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from simulator.buildings import Windows, add_car, add_house, add_tree
from simulator.meshes import box, height_grid, prism, quad
from simulator.moving import Tracks, over_ground
from simulator.parts import Parts, World
from simulator.route import Route

Array = npt.NDArray[np.float64]
Point = tuple[float, float, float]

_ACROSS_M: Final = (-135.0, -45.0, 45.0, 135.0)
"""Where the streets that go north lie in x."""
_ALONG_M: Final = (-105.0, -35.0, 35.0, 105.0)
"""Where the streets that go east lie in y."""
_HALF_STREET_M: Final = 3.5
_EDGE_M: Final = (-170.0, -140.0, 170.0, 220.0)
"""West, south, east and north end of the fine ground."""
_LANE_M: Final = 1.6


def _on_street(x_m: Array, y_m: Array, margin_m: float = 0.0) -> npt.NDArray[np.bool_]:
    half = _HALF_STREET_M - margin_m
    inside = (np.abs(x_m) < _ACROSS_M[-1] + half) & (np.abs(y_m) < _ALONG_M[-1] + half)
    on = np.zeros(np.shape(x_m), np.bool_)
    for middle in _ACROSS_M:
        on |= np.abs(x_m - middle) < half
    for middle in _ALONG_M:
        on |= np.abs(y_m - middle) < half
    return np.asarray(on & inside)


def town_height(x_m: Array, y_m: Array) -> Array:
    """Height of the town's ground: 40 cm over 200 m; beside the streets 12 cm over 20 m and 5 cm over 7 m; shape as given [m]."""
    x_m, y_m = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
    wide = 0.4 * np.sin(2 * np.pi * x_m / 210.0 + 0.7) * np.cos(2 * np.pi * y_m / 190.0 - 0.3)
    narrow = 0.12 * np.sin(2 * np.pi * x_m / 20.0 + 0.4) * np.cos(2 * np.pi * y_m / 23.0)
    narrow += 0.05 * np.sin(2 * np.pi * (x_m + 0.6 * y_m) / 7.0)
    return np.asarray(wide + np.where(_on_street(x_m, y_m), -0.1, narrow))


def _at(x_m: float, y_m: float, above_m: float = 0.0) -> Array:
    return np.array([x_m, y_m, float(town_height(np.array(x_m), np.array(y_m))) + above_m])


def _add_ground(parts: Parts, rng: np.random.Generator) -> None:
    west, south, east, north = _EDGE_M
    x, y = np.arange(west, east + 0.5), np.arange(south, north + 0.5)
    grid_x, grid_y = np.meshgrid(x, y)
    street = _on_street(grid_x, grid_y)
    z = town_height(grid_x, grid_y) + np.where(street, 0.0, rng.normal(scale=0.015, size=grid_x.shape))
    crop_m = np.zeros(z.shape)
    for first, last, high_m in ((118.0, 140.0, 0.5), (150.0, 172.0, 0.15), (182.0, 204.0, 0.9)):
        crop_m[(grid_y > first) & (grid_y < last) & (np.abs(grid_x) < 150.0)] = high_m
    z += crop_m * rng.uniform(0.92, 1.0, z.shape)
    triangles = height_grid(x, y, z)
    middle = triangles.mean(axis=1)
    on_street = _on_street(middle[:, 0], middle[:, 1], 0.7)
    field = np.tile(((crop_m[:-1, :-1] > 0) & (crop_m[1:, 1:] > 0)).ravel(), 2)
    parts.add("street", "asphalt", triangles[on_street])
    parts.add("crop", "crop", triangles[field])
    parts.add("grass", "grass", triangles[~on_street & ~field])
    far_m = 500.0
    for low, high in (
        ((-far_m, -far_m), (far_m, south)),
        ((-far_m, north), (far_m, far_m)),
        ((-far_m, south), (west, north)),
        ((east, south), (far_m, north)),
    ):
        size = np.subtract(high, low)
        parts.add("far ground", "soil", quad((*low, -0.6), (size[0], 0, 0), (0, size[1], 0)))


def _add_block(parts: Parts, name: str, west_m: float, south_m: float, rng: np.random.Generator) -> None:
    """Four houses with gardens between two pairs of streets: 83 by 63 m from the south-west corner."""
    for i, (share_x, share_y) in enumerate(((0.25, 0.27), (0.75, 0.27), (0.25, 0.73), (0.75, 0.73))):
        size = (float(rng.uniform(11, 20)), float(rng.uniform(8, 11)))
        eaves = float(rng.choice([3.2, 6.0]))
        house = Parts()
        windows = Windows(int(size[0] // 3.2), 2 if eaves > 5 else 1)
        add_house(
            house, f"{name} house {i}", size, eaves, eaves + 0.5 * size[1] * float(rng.uniform(0.5, 0.9)), windows
        )
        plinth = np.array([size[0] / 2, size[1] / 2, 0.0])
        house.add(f"{name} plinths", "concrete", box(-plinth - [0, 0, 1.0], plinth))
        x = west_m + 90.0 * share_x + float(rng.uniform(-3, 3))
        y = south_m + 70.0 * share_y + float(rng.uniform(-2, 2))
        heading = float(rng.choice([0.0, 180.0]) + rng.uniform(-8, 8))
        parts.place(house, _at(x, y, 0.25), heading)
        if rng.random() < 0.6:
            shed = Parts()
            shed.add(f"{name} sheds", "wood", box((-1.5, -1.2, -0.5), (1.5, 1.2, 2.2)))
            beside = float(np.clip(x + 15.0 * float(rng.choice([-1, 1])), west_m + 8.0, west_m + 82.0))
            parts.place(shed, _at(beside, y + float(rng.uniform(-5, 5))), heading + 20.0)
    for i in range(5):
        x = west_m + float(rng.choice([9.0, 45.0, 81.0])) + float(rng.uniform(-1.5, 1.5))
        y = south_m + float(rng.uniform(10.0, 60.0))
        add_tree(parts, f"{name} tree {i}", _at(x, y, -0.05), float(rng.uniform(4.5, 8.0)), rng, 900)
    for post in np.arange(12.0, 78.1, 3.0):
        place = (west_m + float(post), south_m + 35.0)
        parts.add(f"{name} fence", "wood", prism(_at(*place, -0.3), _at(*place, 1.1), 0.04, 4))
        if post > 12.0:
            for rail_m in (0.45, 0.95):
                rail = prism(_at(place[0] - 3.0, place[1], rail_m), _at(*place, rail_m), 0.03, 4)
                parts.add(f"{name} fence", "wood", rail)
    for i in range(3):
        x = west_m + float(rng.uniform(12.0, 78.0))
        add_car(parts, f"{name} car {i}", _at(x, south_m + 4.6), 90.0 + float(rng.uniform(-3, 3)))
    for x in np.arange(18.0, 80.0, 27.0):
        foot, top = (_at(west_m + float(x), south_m + 65.0, above_m) for above_m in (-0.3, 5.0))
        parts.add("lamps", "metal", prism(foot, top, 0.06, 8))


def _barn(parts: Parts, rng: np.random.Generator) -> None:
    barn = Parts()
    add_house(barn, "barn", (26.0, 12.0), 4.5, 8.0, None)
    parts.place(barn, _at(float(rng.uniform(-60, 60)), 161.0, -0.2), float(rng.uniform(60, 120)))


def followed(corners: list[tuple[float, float]], heights_m: Array, step_m: float = 10.0) -> tuple[Point, ...]:
    """A way over the town's ground, closed: points every `step_m` with heights above ground that change from corner to corner."""
    points: list[Point] = []
    closed = [*corners, corners[0]]
    for i, (start, end) in enumerate(pairwise(closed)):
        length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
        low, high = float(heights_m[i]), float(heights_m[(i + 1) % len(corners)])
        for share in np.arange(0.0, 1.0, min(step_m / length, 1.0)):
            x, y = (float(a + share * (b - a)) for a, b in zip(start, end, strict=True))
            ground = float(_wide(x, y))
            points.append((x, y, ground + low + float(share) * (high - low)))
    return tuple(points)


def _wide(x_m: float, y_m: float) -> float:
    """The slow part of the relief, which streets follow."""
    return 0.4 * float(np.sin(2 * np.pi * x_m / 210.0 + 0.7) * np.cos(2 * np.pi * y_m / 190.0 - 0.3)) - 0.1


def _tour(first: int) -> list[tuple[float, float]]:
    """Corners of a round through all streets: to and fro eastward, then to and fro northward; begins at one of them."""
    a, b = _ACROSS_M, _ALONG_M
    rows = [(a[0], b[0]), (a[3], b[0]), (a[3], b[1]), (a[0], b[1]), (a[0], b[2]), (a[3], b[2]), (a[3], b[3])]
    columns = [(a[2], b[3]), (a[2], b[0]), (a[1], b[0]), (a[1], b[3]), (a[0], b[3])]
    corners = rows + columns
    return corners[first:] + corners[:first]


def _round(first: int, clockwise: bool) -> list[tuple[float, float]]:
    """Corners of a drive round the middle block and the one east of it, diagonally across no yard: four headings, in the right lane."""
    offset = -_LANE_M if clockwise else _LANE_M  # traffic keeps to the right
    a, b = _ACROSS_M, _ALONG_M
    west, east = a[1] - offset, a[3] + offset
    south, north = b[1] - offset, b[2] + offset
    corners = [(west, south), (east, south), (east, north), (west, north)]
    if clockwise:
        corners = corners[::-1]
    return corners[first:] + corners[:first]


def town(rng: np.random.Generator) -> tuple[World, dict[str, Route], Tracks]:
    """Nine blocks of four houses, streets, parked cars, trees, lamps and fences, and fields in the north, on undulating ground."""
    parts = Parts()
    _add_ground(parts, rng)
    for row, south in enumerate(_ALONG_M[:-1]):
        for column, west in enumerate(_ACROSS_M[:-1]):
            _add_block(parts, f"block {row}{column}", west, south, rng)
    _barn(parts, rng)
    start = int(rng.integers(12))
    tour = _tour(start)
    patrol = followed(tour, rng.uniform(5.5, 9.0, len(tour)), 15.0)
    first, clockwise = int(rng.integers(4)), bool(rng.random() < 0.5)
    around = _round(first, clockwise)
    drive = followed(around, np.full(4, 2.1))
    strips = []
    for i, y in enumerate(np.arange(10.0, 151.0, 20.0)):
        ends = (-90.0, 90.0) if i % 2 == 0 else (90.0, -90.0)
        height = float(rng.uniform(32.0, 50.0))
        strips += [(x, float(y), height) for x in ends]
    cross = [(-30.0, 155.0, 40.0), (-30.0, 5.0, 40.0), (0.0, 5.0, 45.0), (0.0, 155.0, 45.0)]
    # the other way round, so that traffic meets the drive in its own lane; and round the whole town
    outer = [(-136.6, -106.6), (136.6, -106.6), (136.6, 106.6), (-136.6, 106.6)]
    walks = [[(x + 4.4, -103.0), (x + 4.4, 103.0), (x + 5.2, 103.0), (x + 5.2, -103.0)] for x in _ACROSS_M]
    tracks = Tracks(
        cars=tuple(over_ground(way, town_height) for way in (_round(first, not clockwise), outer)),
        people=tuple(over_ground(way, town_height) for way in walks),
    )
    routes = {
        "patrol": Route(points_m=patrol, speed_m_s=5.0, loop_from=0),
        "drive": Route(points_m=drive, speed_m_s=6.0, loop_from=0, smooth_s=0.7, kind="car"),
        "strips": Route(points_m=(*strips, *cross), speed_m_s=9.0, loop_from=0, smooth_s=1.5),
    }
    return parts.world(), routes, tracks
