"""Moving things are met where they are at the instant of the shot, and hide what is behind them."""

from dataclasses import replace

import numpy as np
import pytest

from flightlog.errors import UsageError
from simulator.config import MovingOptions, Options
from simulator.moving import Tracks, Traffic, flat, over_ground
from simulator.scene import SCENES, scene
from simulator.simulation import Job, Simulation

LOOP = over_ground([(-50.0, 10.0), (50.0, 10.0), (50.0, 40.0), (-50.0, 40.0)], flat)
WALL = np.array([[0.0, 1.0, 0.0, 30.0]])


class Parked(Traffic):
    """One car where it is put."""

    def __init__(self, east_m, north_m, heading_deg):
        super().__init__(Tracks(cars=(LOOP,)), MovingOptions(cars=1), 1)
        self.place = np.array([east_m, north_m, 0.0, np.radians(heading_deg)])

    def poses(self, time_s):
        return np.tile(self.place, (len(time_s), 1, 1))


def ray_north(traffic, wall_m, height_m=0.5, east_m=0.0):
    """Distance and triangle of a ray to the north, with a wall in its way."""
    opaque = np.zeros(1, np.int32)
    planes, box = traffic.meet(
        np.zeros(2), np.array([0]), np.float32([[east_m, 0, height_m]]), np.float32([[0, 1, 0]]), opaque,
        np.array([[0.0, 1.0, 0.0, wall_m]]), 100.0,
    )  # fmt: skip
    if opaque[0] == 0:
        return wall_m, 0
    normal, offset = planes[opaque[0] - 1, :3], planes[opaque[0] - 1, 3]
    return (offset - normal @ [east_m, 0, height_m]) / normal[1], int(box[opaque[0] - 1])


@pytest.mark.parametrize(
    ("heading_deg", "wall_m", "expected_m"),
    [(0, 30, 7.9), (180, 30, 7.9), (90, 30, 9.15), (270, 30, 9.15), (90, 9.0, 9.0), (90, 9.2, 9.15)],
)
def test_a_car_of_4_2_by_1_7_m_is_met_at_its_near_side(heading_deg, wall_m, expected_m):
    assert ray_north(Parked(0.0, 10.0, heading_deg), wall_m)[0] == pytest.approx(expected_m, abs=1e-6)


def test_above_and_beside_a_car_there_is_nothing():
    car = Parked(0.0, 10.0, 0.0)
    assert ray_north(car, 30.0, height_m=1.0) == (pytest.approx(8.7), 1)  # the cabin
    assert ray_north(car, 30.0, height_m=1.5)[0] == 30.0
    assert ray_north(car, 30.0, east_m=0.9)[0] == 30.0
    assert ray_north(Parked(0.0, -10.0, 0.0), 30.0)[0] == 30.0
    # turned by 45 deg: the near corner, (right 0.85, back 2.1), is 2.95 / sqrt 2 before the middle and 1.25 / sqrt 2 to the left
    assert ray_north(Parked(0.0, 10.0, 45.0), 30.0, east_m=-1.25 / np.sqrt(2))[0] == pytest.approx(
        10 - 2.95 / np.sqrt(2)
    )


def test_they_keep_to_their_way_at_their_speed():
    traffic = Traffic(Tracks((LOOP,), (LOOP,)), MovingOptions(cars=3, people=2), 4)
    time_s = np.arange(0.0, 60.0, 0.1)
    poses = traffic.poses(time_s)
    assert traffic.names == ["moving car 0", "moving car 1", "moving car 2", "moving person 0", "moving person 1"]
    speed = np.linalg.norm(np.diff(poses[:, :, :3], axis=0), axis=2) / 0.1
    straight = np.median(speed, axis=0)
    assert (straight[:3] > 5.9).all()
    assert (straight[:3] < 9.1).all()
    assert (straight[3:] > 1.0).all()
    assert (straight[3:] < 1.7).all()
    # forward is where they go, but for the steps of the grid in a bend
    ahead = np.stack([np.sin(poses[:-1, :, 3]), np.cos(poses[:-1, :, 3])], axis=2)
    along = (np.diff(poses[:, :, :2], axis=0) * ahead).sum(axis=2) / 0.1
    assert (along > 0.97 * speed).all()
    # cars of one way never meet
    apart = [np.linalg.norm(poses[:, i, :2] - poses[:, j, :2], axis=1).min() for i, j in ((0, 1), (0, 2), (1, 2))]
    assert min(apart) > 10.0


@pytest.fixture(scope="module")
def busy(simulate):
    options = replace(Options(), moving=MovingOptions(cars=2, people=4))
    return simulate("field", 3.0, options, points=True), options


def test_points_on_them_lie_on_their_boxes_at_that_instant(busy, tmp_path):
    recorded, options = busy
    traffic = Simulation(Job("field", 3.0, 3, tmp_path, options)).traffic
    names = recorded.truth["surfaces"]
    assert names[-6:] == traffic.names
    seen = 0
    for i, name in enumerate(traffic.names):
        points = recorded.points[(recorded.points["surface"] == names.index(name)) & ~recorded.points["mixed"]]
        seen += len(points)
        if not len(points):
            continue
        assert (points["triangle"] == -1).all()
        time_s = recorded.true_time_s("lidar", points["lidar_ns"] * 1e-9)
        east, north, _, heading = traffic.poses(time_s)[:, i].T
        sine, cosine = np.sin(heading), np.cos(heading)
        x, y = points["x"] - east, points["y"] - north
        right, forward = cosine * x - sine * y, sine * x + cosine * y
        half = (0.85, 2.1) if "car" in name else (0.23, 0.13 + 0.22)
        # beams are cast as of the start of their firing, 46 us before the end, and the footprint may reach over an edge by 3 cm
        assert np.abs(right).max() < half[0] + 0.05
        assert np.abs(forward).max() < half[1] + 0.05
    assert seen > 200


def test_they_hide_what_is_behind_and_nothing_else(busy, simulate):
    recorded, options = busy
    still = simulate("field", 3.0, replace(options, moving=MovingOptions()), points=True)
    moved = recorded.points["surface"] >= len(still.truth["surfaces"])
    _, one, other = np.intersect1d(recorded.points["lidar_ns"], still.points["lidar_ns"], return_indices=True)
    after, before = recorded.points["range_m"][one], still.points["range_m"][other]
    assert (after < before + 0.6)[moved[one]].all()
    # elsewhere only beams differ that they cut in part: at their outline, of which there is less than of them
    assert 0 < (after != before)[~moved[one]].sum() < moved.sum()
    assert (after != before)[~moved[one]].mean() < 0.001


def test_a_scene_without_a_way_refuses():
    with pytest.raises(UsageError, match="moving: cars: 2 found, expected 0, because this scene has no way for cars"):
        Traffic(scene("panels", 1).tracks, MovingOptions(cars=2), 1)


@pytest.mark.parametrize("name", SCENES)
def test_ways_lie_within_the_scene(name):
    built = scene(name, 1)
    low, high = built.world.triangles_m.min(axis=(0, 1)), built.world.triangles_m.max(axis=(0, 1))
    for track in (*built.tracks.cars, *built.tracks.people):
        assert ((track > low - 1e-9) & (track < high)).all()
        assert np.linalg.norm(np.diff(track, axis=0), axis=1).max() < 4.1
