"""A quarry: benches with steep rough faces in the north, rubble at their feet, heaps of gravel on the floor, and no wall."""

from typing import Final

import numpy as np
import numpy.typing as npt

from simulator.meshes import height_grid
from simulator.moving import Tracks, over_ground
from simulator.parts import Parts, World
from simulator.route import Route
from simulator.terrain import Relief

Array = npt.NDArray[np.float64]

_HALF_M: Final = 90.0
_STEP_M: Final = 0.5
_LINES: Final = ((-42.0, -22.0), (40.0, -22.0), (40.0, -6.0), (-40.0, -6.0), (-40.0, 10.0), (40.0, 10.0))


def quarry(rng: np.random.Generator) -> tuple[World, dict[str, Route], Tracks]:
    """Three benches 6 to 9 m high on a bend, flown in lines over the floor below them."""
    parts = Parts()
    floor = Relief.drawn(rng, ((45.0, 0.3), (10.0, 0.08), (2.0, 0.04)))
    edge = Relief.drawn(rng, ((30.0, 1.5), (7.0, 0.5), (1.8, 0.25)))
    foot_m = 24.0 + np.cumsum([0.0, *rng.uniform(10.0, 15.0, 2)])
    rise_m, lean = rng.uniform(6.0, 9.0, 3), rng.uniform(0.2, 0.4, 3)
    bend_1_m = float(rng.uniform(0.002, 0.004))

    def height(x: Array, y: Array) -> Array:
        """The floor, and above it what of each face lies south of a place."""
        ahead = y + bend_1_m * x**2 + edge.height(x, y)
        faces = (
            np.clip((ahead - at) / wide, 0.0, 1.0) * up
            for at, up, wide in zip(foot_m, rise_m, lean * rise_m, strict=True)
        )
        return np.asarray(floor.height(x, y) + sum(faces))

    axis = np.arange(-_HALF_M, _HALF_M + _STEP_M / 2, _STEP_M)
    x, y = np.meshgrid(axis, axis)
    parts.add("ground", "concrete", height_grid(axis, axis, height(x, y) + rng.normal(scale=0.03, size=x.shape)))
    east = rng.uniform(-70.0, 70.0, 900)
    foot = rng.choice(foot_m, len(east)) - bend_1_m * east**2 - rng.exponential(2.5, len(east))
    _add_boulders(
        parts, "rubble", np.column_stack([east, foot, height(east, foot)]), rng.uniform(0.1, 0.7, len(east)), rng
    )
    for i in range(4):
        spot, up = rng.uniform((-45.0, -35.0), (45.0, 8.0)), rng.uniform(1.5, 4.0)
        _add_heap(parts, f"heap {i}", np.array([*spot, float(height(*spot))]), float(up), rng)
    points = tuple((x, y, float(height(np.array(x), np.array(y)) + rng.uniform(8.0, 12.0))) for x, y in _LINES)
    walk = over_ground([(-30.0, -28.0), (30.0, -28.0), (30.0, -29.0), (-30.0, -29.0)], height)
    return parts.world(), {"lines": Route(points_m=points, speed_m_s=5.0, loop_from=0)}, Tracks(people=(walk,))


def _add_boulders(parts: Parts, name: str, at_m: Array, radius_m: Array, rng: np.random.Generator) -> None:
    """Octahedra with corners drawn in and out, half sunk into the ground."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]) + rng.normal(scale=0.2, size=(len(at_m), 6, 3))
    corners = at_m[:, None] + corners * radius_m[:, None, None] * rng.uniform(0.6, 1.0, (len(at_m), 6, 1))
    faces = np.array([[a, b, c] for a in (0, 3) for b in (1, 4) for c in (2, 5)])
    # outward: the order of a face turns with each corner that is taken from the other side
    faces[[1, 2, 4, 7]] = faces[[1, 2, 4, 7]][:, ::-1]
    parts.add(name, "concrete", corners[:, faces].reshape(-1, 3, 3))


def _add_heap(parts: Parts, name: str, foot_m: Array, height_m: float, rng: np.random.Generator) -> None:
    """Gravel at its angle of repose, 35 deg, rough by some centimetres."""
    reach = height_m / np.tan(np.radians(35.0))
    axis = np.arange(-reach, reach + _STEP_M, _STEP_M)
    x, y = np.meshgrid(axis, axis)
    z = height_m - np.hypot(x, y) * np.tan(np.radians(35.0)) + rng.normal(scale=0.04, size=x.shape)
    parts.add(name, "concrete", height_grid(axis, axis, np.maximum(z, -1.0)) + foot_m)
