"""Houses, walls with recessed windows, and what stands around them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simulator.meshes import box, leaves, placed, prism, quad
from simulator.parts import Parts

Array = npt.NDArray[np.float64]
Frame = tuple[Array, Array, Array]
"""Of a wall: lower left corner seen from outside, unit vector to the right, unit vector outward. Up is up."""

RECESS_M = 0.15
ROOM_DEPTH_M = 4.0
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Windows:
    """A regular row or grid of windows in a wall."""

    columns: int
    rows: int
    width_m: float = 1.2
    height_m: float = 1.4
    sill_m: float = 1.0
    storey_m: float = 2.8

    def holes(self, length_m: float) -> Iterable[tuple[float, float, float, float]]:
        """Left, right, lower and upper edge of each window in the wall's plane."""
        pitch_m = length_m / self.columns
        for row in range(self.rows):
            for column in range(self.columns):
                left = (column + 0.5) * pitch_m - self.width_m / 2
                low = self.sill_m + row * self.storey_m
                yield left, left + self.width_m, low, low + self.height_m


def _plane(frame: Frame, left: float, right: float, low: float, high: float, outward_m: float = 0.0) -> Array:
    corner, along, out = frame
    return quad(corner + left * along + low * _UP + outward_m * out, (right - left) * along, (high - low) * _UP)


def _wall_around(frame: Frame, length_m: float, height_m: float, windows: Windows) -> Array:
    """The wall's plane with its windows cut out: bands between the rows, and piers between the columns."""
    holes = list(windows.holes(length_m))
    pieces, floor = [], 0.0
    for row in range(windows.rows):
        in_row = holes[row * windows.columns : (row + 1) * windows.columns]
        low, high = in_row[0][2:]
        pieces.append(_plane(frame, 0.0, length_m, floor, low))
        edges = [0.0, *(edge for hole in in_row for edge in hole[:2]), length_m]
        pieces += [_plane(frame, a, b, low, high) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        floor = high
    pieces.append(_plane(frame, 0.0, length_m, floor, height_m))
    return np.concatenate(pieces)


def _reveals(frame: Frame, hole: tuple[float, float, float, float]) -> Array:
    """The four sides of a window's recess."""
    corner, along, out = frame
    left, right, low, high = hole
    depth = -RECESS_M * out
    points = [corner + u * along + v * _UP for u, v in ((left, low), (right, low), (right, high), (left, high))]
    return np.concatenate([quad(points[i], depth, points[(i + 1) % 4] - points[i]) for i in range(4)])


def add_wall(parts: Parts, name: str, frame: Frame, size_m: tuple[float, float], windows: Windows | None) -> None:
    """Add a wall of plaster; behind its windows there are glass and the back wall of a room."""
    length_m, height_m = size_m
    if windows is None:
        parts.add(name, "plaster", _plane(frame, 0.0, length_m, 0.0, height_m))
        return
    parts.add(name, "plaster", _wall_around(frame, length_m, height_m, windows))
    for hole in windows.holes(length_m):
        parts.add(f"{name} reveals", "plaster", _reveals(frame, hole))
        parts.add(f"{name} glass", "glass", _plane(frame, *hole, outward_m=-RECESS_M))
    parts.add(f"{name} indoors", "plaster", _plane(frame, 0.0, length_m, 0.0, height_m, -ROOM_DEPTH_M))


def add_house(
    parts: Parts, name: str, size_m: tuple[float, float], eaves_m: float, ridge_m: float, windows: Windows | None
) -> None:
    """Add a house centred on the origin with its ridge along x; windows in the two long walls."""
    length_m, width_m = size_m
    a, b = length_m / 2, width_m / 2
    x, y = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    add_wall(parts, f"{name} south", (-a * x - b * y, x, -y), (length_m, eaves_m), windows)
    add_wall(parts, f"{name} north", (a * x + b * y, -x, y), (length_m, eaves_m), windows)
    for side, sign in (("east", 1.0), ("west", -1.0)):
        corner = sign * (a * x - b * y)
        gable = np.array([[corner, corner + sign * width_m * y, sign * a * x]])
        gable[:, :2, 2], gable[:, 2, 2] = eaves_m, ridge_m
        wall = np.concatenate([quad(corner, sign * width_m * y, eaves_m * _UP), gable])
        parts.add(f"{name} {side}", "brick", wall)
    overhang = 0.5
    slope = (ridge_m - eaves_m) / b
    run = np.array([0, b + overhang, slope * (b + overhang)])
    for side, sign in (("south", 1.0), ("north", -1.0)):
        corner = np.array([-a - overhang, -sign * (b + overhang), eaves_m - slope * overhang])
        roof = quad(corner, (length_m + 2 * overhang) * x, run * [1, sign, 1])
        parts.add(f"{name} roof {side}", "roof_tile", roof)


def add_tree(parts: Parts, name: str, at: Array, height_m: float, rng: np.random.Generator, count: int = 1500) -> None:
    """Add a trunk and a crown of `count` leaves."""
    crown = np.array([0.28, 0.28, 0.34]) * height_m
    parts.add(f"{name} trunk", "bark", prism(at, at + np.array([0, 0, 0.65 * height_m]), 0.025 * height_m, 8))
    centre = at + np.array([0, 0, height_m - crown[2]])
    parts.add(f"{name} leaves", "leaf", leaves(centre, crown, count, 0.11, rng))


def add_car(parts: Parts, name: str, at: Array, heading_deg: float) -> None:
    """Add a car: body, cabin, wheels left out, and number plates that shine back."""
    body = np.concatenate([box((-0.85, -2.1, 0.25), (0.85, 2.1, 0.8)), box((-0.75, -1.3, 0.8), (0.75, 0.9, 1.42))])
    parts.add(f"{name} body", "car_paint", placed(body, at, heading_deg))
    plates = np.concatenate(
        [box((-0.26, -2.12, 0.45), (0.26, -2.1, 0.56)), box((-0.26, 2.1, 0.45), (0.26, 2.12, 0.56))]
    )
    parts.add(f"{name} plates", "retro", placed(plates, at, heading_deg))


def add_shelter(parts: Parts, name: str, at: Array, heading_deg: float) -> None:
    """Add a bicycle shelter: posts, a roof, a glass back wall, and racks of thin tube."""
    posts = [prism((x, y, 0), (x, y, 2.2), 0.04) for x in (-3.0, 0.0, 3.0) for y in (-1.0, 1.0)]
    racks = [prism((x, -0.6, 0.45), (x, 0.6, 0.45), 0.015, 4) for x in np.arange(-2.6, 2.7, 0.4)]
    racks += [prism((x, y, 0), (x, y, 0.45), 0.015, 4) for x in np.arange(-2.6, 2.7, 0.4) for y in (-0.6, 0.6)]
    metal = np.concatenate([*posts, *racks])
    parts.add(f"{name} frame", "metal", placed(metal, at, heading_deg))
    parts.add(f"{name} roof", "metal", placed(box((-3.3, -1.3, 2.2), (3.3, 1.3, 2.26)), at, heading_deg))
    parts.add(f"{name} glass", "glass", placed(quad((-3, 1, 0.2), (6, 0, 0), (0, 0, 1.9)), at, heading_deg))


def add_panel(parts: Parts, name: str, material: str, at: Array, facing_deg: float, tilt_deg: float = 0.0) -> None:
    """Add a reference panel of 1 m2 centred on `at`; its front looks towards a heading, tilted up."""
    tilt = np.radians(tilt_deg)
    up = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    shape = quad(np.array([0.5, 0.0, 0.0]) - up / 2, (-1.0, 0.0, 0.0), up)
    parts.add(name, material, placed(shape, at, facing_deg))
