"""The named scenes: what stands where, where to fly, and how the lidar is mounted for it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import UsageError
from flightlog.mount import LidarMount, Mount
from simulator.avenue import avenue
from simulator.buildings import (
    Windows,
    add_car,
    add_house,
    add_panel,
    add_shelter,
    add_tree,
    add_wall,
)
from simulator.chance import generator
from simulator.ground import add_ground, ground_height
from simulator.lake import lake
from simulator.meshes import box, catenary, prism, quad
from simulator.moving import Tracks, flat, over_ground
from simulator.natural import bank, bare_field, crops, meadow, slope
from simulator.parts import Parts, World
from simulator.quarry import quarry
from simulator.route import Route, eights
from simulator.street import empty_street, facades, yard_street
from simulator.town import town
from simulator.wood import wood

Array = npt.NDArray[np.float64]
Place = tuple[World, dict[str, Route], Tracks]
"""What a scene's function builds: the first of its routes is flown where none is named."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A world, a route through it, the nominal mount, and ways for what moves."""

    name: str
    world: World
    route: Route
    mount: Mount = field(default_factory=Mount)
    tracks: Tracks = field(default_factory=Tracks)


def _on_ground(x_m: float, y_m: float) -> Array:
    return np.array([x_m, y_m, float(ground_height(np.array(x_m), np.array(y_m))) - 0.03])


def _add_power_line(parts: Parts) -> None:
    posts = [np.array([x, -30.0, 0.0]) for x in (-75.0, -37.5, 0.0, 37.5, 75.0)]
    for i, at in enumerate(posts):
        parts.add(f"pole {i}", "wood", prism(at - np.array([0, 0, 0.5]), at + np.array([0, 0, 8.0]), 0.12, 8))
        parts.add(f"pole {i}", "wood", box(at + np.array([-0.06, -1.2, 7.6]), at + np.array([0.06, 1.2, 7.72])))
    for i in range(len(posts) - 1):
        for offset in (-1.1, 0.0, 1.1):
            hang = np.array([0.0, offset, 7.75])
            parts.add("wires", "wire", catenary(posts[i] + hang, posts[i + 1] + hang, 0.7, 0.009))


def _add_reference_panels(parts: Parts) -> None:
    for i, material in enumerate(("panel_4.6", "panel_30.3", "panel_81.3")):
        at = np.array([-26.0 + 2.0 * i, -17.0, 0.25])
        parts.add(f"{material} flat", material, quad(at - [0.5, 0.5, 0], (1, 0, 0), (0, 1, 0)))
        add_panel(parts, f"{material} upright", material, np.array([30.0 + 2.0 * i, 16.0, 0.9]), 200.0)


def _block(north_m: float, east_m: float, heights_m: tuple[float, float]) -> tuple[tuple[float, float, float], ...]:
    """Corners of four strips there and back, at two heights in turn."""
    points = []
    for strip, north in enumerate(np.linspace(-north_m, north_m, 4).tolist()):
        ends = (-east_m, east_m) if strip % 2 == 0 else (east_m, -east_m)
        points += [(end, north, heights_m[strip % 2]) for end in ends]
    return tuple(points)


def village(rng: np.random.Generator) -> Place:
    """A long house with recessed windows, garage, shed, bicycle shelter, trees, poles, wires, cars, on undulating ground."""
    parts = Parts()
    add_ground(parts, 90.0, 0.5, rng)
    add_house(parts, "house", (40.0, 12.0), 6.0, 9.0, Windows(9, 2))
    parts.add("balcony", "concrete", box((-4.0, -7.4, 2.9), (4.0, -6.0, 3.05)))
    parts.add("canopy", "wood", box((10.0, 6.0, 2.5), (14.0, 7.6, 2.6)))
    parts.add("garage", "brick", box((26, -8, -0.2), (32, 0, 2.8)))
    parts.add("shed", "wood", box((-34, 6, -0.2), (-30, 9, 2.3)))
    add_shelter(parts, "shelter", np.array([-8.0, -13.5, -0.1]), 0.0)
    spots = [(-38, -12), (-44, 4), (-30, 20), (-18, 24), (-4, 19), (8, 26), (20, 19), (33, 24), (42, 8), (40, -10)]
    for i, (x, y) in enumerate([*spots, (-55, -14), (14, -38), (-20, -36), (55, 20)]):
        shift = rng.uniform(-1.5, 1.5, 2)
        add_tree(parts, f"tree {i}", _on_ground(x + shift[0], y + shift[1]), rng.uniform(5.0, 10.0), rng)
    for i, at_m in enumerate(np.linspace(-36, 36, 7)):
        add_car(parts, f"car {i}", np.array([at_m + rng.uniform(-2, 2), -22.5, -0.12]), 90 + rng.uniform(-4, 4))
    _add_power_line(parts)
    _add_reference_panels(parts)
    for post_m in np.arange(-24.0, 24.1, 2.0):
        parts.add("fence", "wood", prism((post_m, 15.0, -0.4), (post_m, 15.0, 1.1), 0.04, 4))
    for rail_m in (0.4, 1.0):
        parts.add("fence", "wood", prism((-24, 15, rail_m), (24, 15, rail_m), 0.03, 4))
    high = [5.4 + 4.0 * float(share) for share in rng.random(8)]
    route = Route(
        points_m=(
            (-24.0, -12.0, 3.0),
            (-14.0, -15.5, high[0]),
            (4.0, -14.0, high[1]),
            (27.0, -13.5, high[2]),
            (37.0, 2.0, high[3]),
            (22.0, 12.0, high[4]),
            (0.0, 11.5, high[5]),
            (-24.0, 12.5, high[6]),
            (-36.0, -2.0, high[7]),
            (-27.0, -12.0, high[0]),
        ),
        speed_m_s=4.4,
    )
    # above all roofs: walls of four directions and roofs of two are seen from every side, in both directions
    eight = eights((-15.0, 0.0), (15.0, 0.0), 12.0, (11.5, 14.0))
    mirrored = tuple((x, -y, z) for x, y, z in eight)
    both_ways = Route(points_m=((0.0, 0.0, 12.0), *eight, *mirrored), speed_m_s=6.0, smooth_s=0.7)
    block = Route(points_m=_block(34.5, 46.0, (30.0, 33.0)), speed_m_s=5.0, loop_from=-1)
    street = [(-85.0, -20.8), (85.0, -20.8), (85.0, -18.9), (-85.0, -18.9)]
    walks = (
        [(-23.5, -10.2), (23.5, -10.2), (24.0, 9.8), (-23.5, 9.8)],
        [(-60.0, -25.4), (60.0, -25.4), (60.0, -26.4), (-60.0, -26.4)],
        [(-22.0, 10.8), (22.0, 10.8), (22.0, 13.6), (-22.0, 13.6)],
    )
    tracks = Tracks(
        cars=(over_ground(street, lambda x, _: np.full_like(x, -0.12)),),
        people=tuple(over_ground(walk, ground_height) for walk in walks),
    )
    return parts.world(), {"round": route, "eights": both_ways, "block": block}, tracks


def field_scene(rng: np.random.Generator) -> Place:
    """Flat level ground at height 0 and one plain wall that looks south: for tests of geometry. Flown in lines."""
    parts = Parts()
    parts.add("ground", "grass", quad((-400, -400, 0), (800, 0, 0), (0, 800, 0)))
    wall = (np.array([-30.0, 20.0, 0.0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0]))
    add_wall(parts, "wall", wall, (60.0, 8.0), None)
    lines = [(-20.0, -15.0), (20.0, -15.0), (20.0, -5.0), (-20.0, -5.0), (-20.0, 5.0), (20.0, 5.0)]
    points = [(x, y, 10.0 + rng.uniform(-1, 1)) for x, y in lines]
    hover = Route(points_m=((0.0, -250.0, 10.0),), heading_deg=180.0)  # the wall is out of reach
    lines_route = Route(points_m=((-24.0, -15.0, 6.0), *points), speed_m_s=4.0)
    cars = (
        [(-30.0, 8.0), (30.0, 8.0), (30.0, 13.0), (-30.0, 13.0)],
        [(-30, -270), (30, -270), (30, -275), (-30, -275)],
    )
    walks = (
        [(-15.0, 15.0), (15.0, 15.0), (15.0, 18.0), (-15.0, 18.0)],
        [(-12, -262), (12, -262), (12, -266), (-12, -266)],
    )
    tracks = Tracks(tuple(over_ground(c, flat) for c in cars), tuple(over_ground(w, flat) for w in walks))
    return parts.world(), {"lines": lines_route, "hover": hover}, tracks


def facade(rng: np.random.Generator) -> Place:
    """A street between long facades at 30 m, driven by a car at 6 m/s."""
    parts = Parts()
    parts.add("street", "asphalt", quad((-250, -12, 0), (500, 0, 0), (0, 20, 0)))
    parts.add("lawn", "grass", quad((-250, 8, 0.0), (500, 0, 0), (0, 92, 0)))
    parts.add("lawn", "grass", quad((-250, -100, 0.0), (500, 0, 0), (0, 88, 0)))
    for i, x in enumerate(np.arange(-200.0, 120.1, 80.0 + 15.0)):
        wall = (np.array([x, 30.0, 0.0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0]))
        add_wall(parts, f"facade {i}", wall, (80.0, 12.0), Windows(20, 4))
        across = (np.array([x + 80.0, -38.0, 0.0]), np.array([-1.0, 0, 0]), np.array([0, 1.0, 0]))
        add_wall(parts, f"facade {i} across", across, (80.0, 9.0), Windows(16, 3))
    for i, x in enumerate(np.arange(-190.0, 190.0, 24.0)):
        add_tree(parts, f"tree {i}", np.array([x + rng.uniform(-4, 4), 12.0, 0.0]), rng.uniform(5, 9), rng)
        add_car(parts, f"car {i}", np.array([x + rng.uniform(-6, 6), 6.5, 0.0]), 90.0)
        at = np.array([x + 12.0, 9.5, 0.0])
        parts.add("lamps", "metal", prism(at, at + np.array([0, 0, 6.0]), 0.06, 8))
    points = ((-150.0, 0.0, 2.1), (150.0, 0.0, 2.1), (158.0, -4.0, 2.1), (150.0, -8.0, 2.1), (-150.0, -8.0, 2.1))
    route = Route(points_m=(*points, (-158.0, -4.0, 2.1)), speed_m_s=6.0, loop_from=0, kind="car")
    lanes = [(-185.0, -11.0), (185.0, -11.0), (185.0, 3.0), (-185.0, 3.0)]
    walks = (
        [(-180.0, 10.4), (180.0, 10.4), (180.0, 11.0), (-180.0, 11.0)],
        [(-180, 26), (180, 26), (180, 27), (-180, 27)],
    )
    tracks = Tracks((over_ground(lanes, flat),), tuple(over_ground(walk, flat) for walk in walks))
    return parts.world(), {"street": route}, tracks


def panels(rng: np.random.Generator) -> Place:
    """Reference panels of 1 m2 at 5 to 60 m around a tripod: the sensor verification of the source's appendix B."""
    parts = Parts()
    parts.add("ground", "grass", quad((-300, -300, 0), (600, 0, 0), (0, 600, 0)))
    distances = np.arange(5.0, 60.1, 5.0)
    headings = np.linspace(-95.0, 95.0, 36)
    order = rng.permutation(36)
    for i, slot in enumerate(order):
        material = ("panel_4.6", "panel_30.3", "panel_81.3")[i % 3]
        distance, heading = distances[i // 3], np.radians(headings[slot])
        at = np.array([distance * np.sin(heading), distance * np.cos(heading), 1.5])
        add_panel(parts, f"{material} at {distance:.0f} m", material, at, headings[slot] + 180.0)
    # two surfaces in one footprint: a step of 0.3 m, which a pulse of 4 ns cannot tell apart
    add_panel(parts, "step front", "panel_30.3", np.array([0.0, 10.0, 3.0]), 180.0)
    parts.add("step back", "panel_81.3", quad((-1.0, 10.3, 2.0), (2.0, 0, 0), (0, 0, 2.0)))
    return parts.world(), {"stand": Route(points_m=((0.0, 0.0, 1.5),), heading_deg=0.0, kind="tripod")}, Tracks()


_LEVEL: Final = Mount(lidar=LidarMount(position_m=(0.0, 0.0, 0.0), pitch_deg=0.0))
SCENES: Final[dict[str, tuple[Callable[[np.random.Generator], Place], Mount]]] = {
    "village": (village, Mount()),
    "field": (field_scene, Mount()),
    "facade": (facade, Mount()),
    "panels": (panels, _LEVEL),
    "town": (town, Mount()),
    "lake": (lake, Mount()),
    "wood": (wood, Mount()),
    "meadow": (meadow, Mount()),
    "barefield": (bare_field, Mount()),
    "crops": (crops, Mount()),
    "slope": (slope, Mount()),
    "avenue": (avenue, Mount()),
    "facades": (facades, Mount()),
    "bank": (bank, Mount()),
    "quarry": (quarry, Mount()),
    "emptystreet": (empty_street, Mount()),
    "yardstreet": (yard_street, Mount()),
}


def scene(name: str, seed: int, route: str = "") -> Scene:
    """Build a scene by name; the seed places what is not fixed.

    Parameters
    ----------
    name : str
    seed : int
    route : str
        One of the scene's routes; empty: the first.

    Raises
    ------
    UsageError
        No such scene, or no such route in it.
    """
    if name not in SCENES:
        raise UsageError(f"scene {name!r} is not known; known are {', '.join(SCENES)}")
    build, mount = SCENES[name]
    world, routes, tracks = build(generator(seed, f"scene {name}"))
    if route and route not in routes:
        raise UsageError(f"route {route!r} is not known in scene {name}; known are {', '.join(routes)}")
    return Scene(name, world, routes[route or next(iter(routes))], mount, tracks)
