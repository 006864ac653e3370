"""The scenes hold what they promise, and shapes are what geometry says."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from flightlog.errors import UsageError
from simulator.buildings import RECESS_M, Windows, add_wall
from simulator.chance import generator
from simulator.config import FlightOptions, Options
from simulator.flight import Flight
from simulator.materials import INDEX, TABLE
from simulator.meshes import box, catenary, placed, prism, quad
from simulator.parts import Parts
from simulator.rays import Surfaces
from simulator.route import eights
from simulator.scene import SCENES, ground_height, scene


def area(triangles):
    sides = triangles[:, 1:] - triangles[:, :1]
    return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2


def test_a_box_has_the_area_of_a_box():
    assert area(box((0, 0, 0), (1, 2, 3))) == pytest.approx(22.0)


def test_a_prism_has_the_girth_of_its_polygon():
    assert area(prism((0, 0, 0), (0, 0, 5), 0.1, 6)) == pytest.approx(6 * 0.1 * 5)


def test_a_shape_is_placed_clockwise():
    turned = placed(quad((0, 1, 0), (0.1, 0, 0), (0, 0, 1)), (10, 0, 0), 90.0)
    assert turned[0, 0] == pytest.approx([11.0, 0.0, 0.0])


def test_a_wire_sags_by_what_is_asked():
    wire = catenary((0, 0, 8), (40, 0, 8), 0.7, 0.01)
    assert wire[..., 2].min() == pytest.approx(8 - 0.7, abs=0.02)


def test_a_wall_with_windows_lacks_exactly_their_area():
    parts = Parts()
    frame = (np.zeros(3), np.array([1.0, 0, 0]), np.array([0, -1.0, 0]))
    add_wall(parts, "wall", frame, (20.0, 6.0), Windows(4, 2))
    world = parts.world()
    wall = world.triangles_m[world.surface == world.names.index("wall")]
    glass = world.triangles_m[world.surface == world.names.index("wall glass")]
    assert area(glass) == pytest.approx(8 * 1.2 * 1.4)
    assert area(wall) == pytest.approx(120.0 - area(glass))
    # seen from the south, the panes lie behind the wall
    assert (wall[..., 1] == 0).all()
    assert glass[..., 1] == pytest.approx(RECESS_M)


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_is_finite_and_has_a_route(name):
    built = scene(name, 1)
    assert np.isfinite(built.world.triangles_m).all()
    assert len(built.world.material) == len(built.world.surface) == len(built.world.triangles_m)
    assert built.world.surface.max() + 1 == len(built.world.names)
    assert built.route.points_m[0][2] > 0


def test_the_village_has_all_that_a_survey_meets():
    names = " ".join(scene("village", 1).world.names)
    for thing in ("grass", "street", "glass", "indoors", "roof", "shelter", "tree", "pole", "wires", "car", "panel"):
        assert thing in names


def test_the_seed_moves_what_is_not_fixed():
    first, again, other = (scene("village", seed).world.triangles_m for seed in (1, 1, 2))
    assert (first == again).all()
    assert first.shape == other.shape
    assert (first != other).any()


def test_the_ground_is_level_where_the_house_stands():
    x, y = np.meshgrid(np.linspace(-20, 20, 50), np.linspace(-6, 6, 20))
    assert not ground_height(x, y).any()
    assert np.ptp(ground_height(np.linspace(-80, 80, 500), np.full(500, 40.0))) > 0.1


def test_reflectances_are_those_of_the_source():
    bounds = {
        "grass": (0.7, 0.7), "leaf": (0.45, 0.6), "bark": (0.5, 0.8), "soil": (0.2, 0.5), "asphalt": (0.08, 0.12),
        "concrete": (0.3, 0.3), "brick": (0.3, 0.7), "wood": (0.8, 0.9), "metal": (0.1, 0.5),
        "panel_4.6": (0.046, 0.046), "panel_30.3": (0.303, 0.303), "panel_81.3": (0.813, 0.813),
    }  # fmt: skip
    for name, (low, high) in bounds.items():
        assert low <= TABLE[INDEX[name]].reflectance <= high


# the town is much the largest, and no flight of the quick suite goes there
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.soak if name == "town" else ()) for name in SCENES]
)
def test_no_route_touches_anything(name):
    for route in SCENES[name][0](generator(1, "x"))[1]:
        assert_clear(name, route, 480.0 if route == "patrol" else 120.0)


def assert_clear(name, route, seconds):
    """From no place of a route does anything stand near, and the ground lies below."""
    built = scene(name, 2, route)
    time_s = np.arange(0.0, seconds, 0.5)
    position = Flight(built.route, seconds, FlightOptions(), 2).poses(time_s).position_m
    away = np.random.default_rng(1).normal(size=(100, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    origins = np.repeat(position, 100, axis=0).astype(np.float32)
    directions = np.tile(away, (len(time_s), 1)).astype(np.float32)
    surfaces = Surfaces(built.world)
    met = surfaces.opaque(origins, directions)
    hit = met >= 0
    plane = surfaces.planes[met[hit]]
    normal = plane[:, :3]
    distance = (plane[:, 3] - (normal * origins[hit]).sum(axis=1)) / (normal * directions[hit]).sum(axis=1)
    assert distance.min() > 1.4, route
    # not under the ground, where everything is seen from below
    assert (directions[hit, 2] < 0).mean() > 0.6, route


def test_an_eight_turns_both_ways_and_crosses_itself():
    points = np.array(eights((-15.0, 0.0), (15.0, 0.0), 12.0, (10.0, 13.0)))
    legs = np.diff(points[:, :2], axis=0)
    turns = legs[:-1, 0] * legs[1:, 1] - legs[:-1, 1] * legs[1:, 0]
    # clockwise round the first centre, counter-clockwise round the second; the two corners at the crossing are either
    assert (turns[:10] < 0).all()
    assert (turns[-10:] > 0).all()
    assert np.hypot(points[:12, 0] + 15.0, points[:12, 1]) == pytest.approx(12.0)
    assert points[:, 2].min() == pytest.approx(10.0, abs=0.1)
    assert points[:, 2].max() == pytest.approx(13.0, abs=0.1)


def test_water_returns_hardly_anything_and_the_shore_does(simulate):
    options = Options()
    sights = {
        route: simulate("lake", 1.0, replace(options, flight=FlightOptions(route=route)), points=True)
        for route in ("open", "out")
    }
    shots = {route: recorded.shots.payloads.shape[0] * 384 for route, recorded in sights.items()}
    share = {route: len(recorded.points) / shots[route] for route, recorded in sights.items()}
    assert share["open"] < 0.01
    assert share["out"] > 0.1
    water = sights["out"].truth["surfaces"].index("water")
    seen = sights["out"].points[sights["out"].points["surface"] == water]
    # what does come back comes from near the vertical
    assert (len(seen) == 0) or (np.abs(seen["range_m"]).max() < 12.0)


def test_an_unknown_scene_is_refused_with_the_known_ones():
    with pytest.raises(UsageError, match="'moon' is not known; known are village"):
        scene("moon", 1)


@pytest.mark.parametrize("name", ["meadow", "barefield", "crops", "slope", "facades", "avenue", "bank"])
def test_a_natural_scene_is_another_with_another_seed(name):
    first, again, other = (scene(name, seed).world.triangles_m for seed in (1, 1, 2))
    assert (first == again).all()
    assert first.shape != other.shape or (first != other).any()


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", ["meadow", "barefield", "crops", "slope"])
def test_survey_lines_keep_clear_of_the_ground(name, seed):
    """Between two corners a line is straight and the ground is not: still it stays 4 m above what lies below."""
    built = scene(name, seed)
    world = built.world
    ground = world.triangles_m[world.surface == world.names.index("ground")].mean(axis=1)
    points = np.array(built.route.points_m)
    for start, end in pairwise(points):
        for share in np.linspace(0.0, 1.0, 9):
            at = start + share * (end - start)
            near = np.linalg.norm(ground[:, :2] - at[:2], axis=1) < 1.5
            assert at[2] - ground[near, 2].max() > 4.0


def test_the_meadow_has_what_tells_the_way_and_the_bare_field_has_not():
    names = " ".join(scene("meadow", 3).world.names)
    for thing in ("tufts", "line tree", "tree 4", "car 1"):
        assert thing in names
    assert set(scene("barefield", 3).world.names) == {"ground", "far ground"}
    assert scene("meadow", 3, "hover").route.hold_s > 10.0


def test_crops_stand_in_rows():
    world = scene("crops", 4).world
    plants = world.triangles_m[world.surface == world.names.index("crops")].mean(axis=1)
    # along the rows' direction the plants are many, across they come every 0.75 m
    angle = np.linspace(-0.35, 0.35, 141)
    across = -np.sin(angle)[:, None] * plants[::97, 0] + np.cos(angle)[:, None] * plants[::97, 1]
    strength = np.abs(np.exp(2j * np.pi * across / 0.75).mean(axis=1))
    assert strength.max() > 0.25
    assert np.median(strength) < 0.1


def test_the_slope_is_one():
    world = scene("slope", 5).world
    ground = world.triangles_m[world.surface == world.names.index("ground")].mean(axis=1)
    rise, *_ = np.linalg.lstsq(np.column_stack([ground[:, :2], np.ones(len(ground))]), ground[:, 2], rcond=None)
    assert 11.0 < np.degrees(np.arctan(np.hypot(rise[0], rise[1]))) < 21.0


def test_a_quarry_has_steep_faces_that_are_no_planes():
    built = scene("quarry", 6)
    world, normal = built.world, built.world.normals()
    ground = world.surface == world.names.index("ground")
    steep = ground & (np.abs(normal[:, 2]) < np.cos(np.radians(50.0)))
    assert area(world.triangles_m[steep]) > 1000.0
    # a face looks all ways between south-east and south-west, and from one half metre to the next another one
    facing = np.degrees(np.arctan2(normal[steep, 0], -normal[steep, 1]))
    assert facing.std() > 15.0
    assert sum(name.startswith("heap") for name in world.names) == 4


def test_in_the_empty_street_nothing_stands_between_the_walls():
    built = scene("emptystreet", 7)
    assert set(built.world.names) == {"street", "facade north", "facade south"}
    walls = built.world.triangles_m[built.world.surface != built.world.names.index("street")]
    assert 28.0 <= np.ptp(walls[..., 1]) <= 34.0


def test_the_yard_lies_before_the_street_and_is_come_back_to():
    built = scene("yardstreet", 7)
    facades = np.array([name.startswith("facade") for name in built.world.names])[built.world.surface]
    houses = np.array([name.startswith("house") for name in built.world.names])[built.world.surface]
    assert built.world.triangles_m[houses][..., 0].max() < built.world.triangles_m[facades][..., 0].min()
    points = np.array(built.route.points_m)
    assert np.linalg.norm(points[0] - points[-1]) < 5.0
    assert np.ptp(points[:, 0]) > 300.0


def test_an_avenue_runs_as_the_seed_has_it_and_is_driven_at_the_height_of_a_roof():
    for seed in (1, 2):
        built = scene("avenue", seed)
        points = np.array(built.route.points_m)
        assert 1.8 <= points[:, 2].min() <= points[:, 2].max() <= 2.2
        cars = [name for name in built.world.names if name.startswith("car ")]
        assert len(cars) > 20
        assert any(name.startswith("lamps") for name in built.world.names)
    courses = [np.subtract(*np.array(scene("avenue", seed).route.points_m)[1::-1, :2]) for seed in (1, 2)]
    east, north = (course / np.linalg.norm(course) for course in courses)
    assert abs(east @ north) < 0.99
