"""A street of house fronts, most of them plain, with kerbs, parked cars and lamp posts, as a car sees it from its roof."""

import numpy as np
import numpy.typing as npt

from simulator.buildings import Windows, add_wall
from simulator.meshes import box, placed, prism, quad
from simulator.moving import Tracks, over_ground
from simulator.parts import Parts, World
from simulator.route import Route

Array = npt.NDArray[np.float64]

_HALF_M = 210.0
_KERB_M = 0.12
_UP = np.array([0.0, 0.0, 1.0])
_CARS = (
    # sides of the body and of the roof: half width, rear, front, height; and where windscreen and rear window begin
    ((0.88, -2.15, 2.15, 0.85), (0.62, -1.35, 0.25, 1.43), (-1.95, 0.95)),
    ((0.86, -1.9, 1.9, 0.9), (0.62, -1.75, 0.3, 1.48), (-1.85, 0.85)),
    ((0.98, -2.6, 2.6, 1.05), (0.85, -2.55, 1.5, 2.05), (-2.58, 2.0)),
)
"""A saloon, a hatchback and a van."""


def _car(kind: int) -> Array:
    """A car that looks north: a body on wheels, and a cabin whose panes lean."""
    (half, rear, front, shoulder), (top_half, top_rear, top_front, top), (behind, ahead) = _CARS[kind]
    low = [(x, y, shoulder) for x, y in ((-half, behind), (half, behind), (half, ahead), (-half, ahead))]
    high = [
        (x, y, top)
        for x, y in ((-top_half, top_rear), (top_half, top_rear), (top_half, top_front), (-top_half, top_front))
    ]
    sides = []
    for i in range(4):
        a, b, c, d = (np.array(p) for p in (low[i], low[(i + 1) % 4], high[(i + 1) % 4], high[i]))
        sides += [[a, b, c], [a, c, d]]
    roof = [
        [np.array(high[0]), np.array(high[1]), np.array(high[2])],
        [np.array(high[0]), np.array(high[2]), np.array(high[3])],
    ]
    wheels = [
        box((x - 0.1, y - 0.3, 0.0), (x + 0.1, y + 0.3, 0.6))
        for x in (-half + 0.1, half - 0.1)
        for y in (rear + 0.8, front - 0.8)
    ]
    return np.concatenate([box((-half, rear, 0.28), (half, front, shoulder)), np.array(sides), np.array(roof), *wheels])


def _add_front(
    parts: Parts, name: str, left: Array, out: Array, wide_m: float, rng: np.random.Generator, plain: float
) -> None:
    """A house's front, its left lower corner as seen from the street; most have nothing on them, some windows or a door's niche."""
    along, height_m = np.cross(_UP, out), float(rng.uniform(7.0, 13.0))
    if rng.random() > plain:
        columns = max(int(wide_m / 3.2), 1)
        add_wall(parts, name, (left, along, out), (wide_m, height_m), Windows(columns, int((height_m - 0.6) / 2.8)))
        return
    door = float(rng.uniform(1.0, max(wide_m - 2.2, 1.1)))
    if rng.random() > plain:
        # a niche of a foot: the door, its two sides, the front beside and above it
        for start, end, low in ((0.0, door, 0.0), (door + 1.1, wide_m, 0.0), (door, door + 1.1, 2.2)):
            parts.add(
                name, "plaster", quad(left + start * along + low * _UP, (end - start) * along, (height_m - low) * _UP)
            )
        deep = -0.3 * out
        parts.add(f"{name} door", "wood", quad(left + door * along + deep, 1.1 * along, 2.2 * _UP))
        for side in (door, door + 1.1):
            parts.add(f"{name} door", "plaster", quad(left + side * along, deep, 2.2 * _UP))
    else:
        parts.add(name, "plaster", quad(left, wide_m * along, height_m * _UP))


def _add_side(parts: Parts, name: str, side: float, away_m: float, rng: np.random.Generator, plain: float) -> None:
    """All fronts along one side, with lanes between some of them."""
    out = np.array([0.0, -side, 0.0])
    along, at, number = np.cross(_UP, out), 0.0, 0
    corner = np.array([-_HALF_M * along[0], side * away_m, 0.0])
    while at < 2.0 * _HALF_M:
        wide_m = float(rng.uniform(8.0, 24.0))
        back_m = 0.0 if rng.random() < plain else float(rng.uniform(0.05, 0.4))
        left = corner + at * along - back_m * out
        _add_front(parts, f"front {name} {number}", left, out, wide_m, rng, plain)
        for end in (left, left + wide_m * along):
            parts.add(f"front {name} {number} side", "brick", quad(end, -7.0 * out, 8.0 * _UP))
        at, number = at + wide_m + (float(rng.uniform(2.0, 6.0)) if rng.random() < 0.1 else 0.0), number + 1


def _add_parked(parts: Parts, name: str, side: float, kerb_m: float, rng: np.random.Generator, apart_m: float) -> None:
    """Cars along the kerb, bumper to bumper here and with gaps there, and lamp posts on the pavement."""
    x, number = -_HALF_M + rng.uniform(2.0, 20.0), 0
    while x < _HALF_M - 5.0:
        kind = int(rng.choice(3, p=(0.45, 0.4, 0.15)))
        at = np.array([x, side * (kerb_m - rng.uniform(1.05, 1.3)), 0.0])
        parts.add(f"car {name} {number}", "car_paint", placed(_car(kind), at, 90.0 * side + rng.normal(scale=1.5)))
        x, number = x + 5.4 + float(rng.exponential(apart_m if rng.random() < 0.8 else 15.0)), number + 1
    for post in np.arange(-_HALF_M + rng.uniform(0.0, 30.0), _HALF_M, rng.uniform(26.0, 38.0)):
        foot = np.array([post, side * (kerb_m + 0.5), 0.0])
        parts.add(f"lamps {name}", "metal", prism(foot, foot + 6.0 * _UP, 0.07, 8))


def avenue(rng: np.random.Generator) -> tuple[World, dict[str, Route], Tracks]:
    """A street that runs as the seed has it, driven down at 7 m/s with the lidar at the height of a car's roof, and back."""
    street = Parts()
    fronts_m, plain = float(rng.uniform(8.5, 12.0)), float(rng.uniform(0.7, 1.0))
    kerb_m, apart_m = fronts_m - float(rng.uniform(2.0, 3.0)), float(rng.choice([1.5, 4.0, 20.0]))
    street.add("street", "asphalt", quad((-_HALF_M - 40.0, -kerb_m, 0), (2 * _HALF_M + 80.0, 0, 0), (0, 2 * kerb_m, 0)))
    for name, side in (("left", 1.0), ("right", -1.0)):
        low, high = sorted((side * kerb_m, side * (fronts_m + 12.0)))
        street.add("pavement", "concrete", box((-_HALF_M, low, -0.2), (_HALF_M, high, _KERB_M)))
        _add_side(street, name, side, fronts_m, rng, plain)
        _add_parked(street, name, side, kerb_m, rng, apart_m)
    heading_deg = float(rng.uniform(0.0, 360.0))
    parts, at = Parts(), np.zeros(3)
    parts.place(street, at, heading_deg)
    roof_m, lane = float(rng.uniform(1.8, 2.2)), 0.45 * (kerb_m - 2.3)

    def laid(points: list[tuple[float, float, float]]) -> Array:
        return placed(np.array(points, np.float64)[:, None], at, heading_deg)[:, 0]

    start = -_HALF_M + float(rng.uniform(20.0, 60.0))
    end = _HALF_M - 20.0
    way = laid(
        [
            (start, -lane, roof_m),
            (end, -lane, roof_m),
            (end + 5.0, 0.0, roof_m),
            (end, lane, roof_m),
            (start, lane, roof_m),
        ]
    )
    drive = Route(points_m=tuple((x, y, z) for x, y, z in way.tolist()), speed_m_s=7.0, loop_from=-1, kind="car")
    lanes = laid([(-180.0, -lane, 0.0), (180.0, -lane, 0.0), (180.0, lane, 0.0), (-180.0, lane, 0.0)])
    walk = fronts_m - 0.8
    walks = [
        laid([(-180.0, s * walk, 0.0), (180.0, s * walk, 0.0), (180.0, s * (walk - 0.4), 0.0)]) for s in (-1.0, 1.0)
    ]
    tracks = Tracks(
        (over_ground([(x, y) for x, y, _ in lanes.tolist()], lambda x, _: np.zeros_like(x)),),
        tuple(
            over_ground([(x, y) for x, y, _ in each.tolist()], lambda x, _: np.full_like(x, _KERB_M)) for each in walks
        ),
    )
    return parts.world(), {"drive": drive}, tracks
