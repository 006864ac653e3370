"""The scenes hold what they promise, and shapes are what geometry says."""

import numpy as np
import pytest

from flightlog.errors import UsageError
from simulator.buildings import RECESS_M, Windows, add_wall
from simulator.materials import INDEX, TABLE
from simulator.meshes import box, catenary, placed, prism, quad
from simulator.parts import Parts
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


def test_an_unknown_scene_is_refused_with_the_known_ones():
    with pytest.raises(UsageError, match="'moon' is not known; known are village"):
        scene("moon", 1)
