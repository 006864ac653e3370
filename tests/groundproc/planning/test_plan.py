"""A plan: density by counting, lines that cover, a mission that pymavlink reads."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import shapely
from pymavlink import mavwp
from scipy.spatial.transform import Rotation

from flightlog.errors import UsageError
from flightlog.frames import mat_local_ins
from flightlog.hdl32e import BLOCKS, FIRING_NS
from flightlog.mount import Mount
from groundproc import sensors
from groundproc.cli import main
from groundproc.planning.coverage import Coverage
from groundproc.planning.plan import Wish, plan
from groundproc.planning.route import route
from groundproc.sensors.shots import Gate
from simulator.clocks import clocks
from simulator.config import Options
from simulator.flight import Flight
from simulator.lidar import Lidar
from simulator.route import Route as SimulatedRoute
from simulator.scene import scene

GATE = Gate(255.0, 105.0, 0.0, 70.0)
AREA = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {},
            "geometry": {
                "type": "Polygon",
                "coordinates": [[[15.0, 58.0], [15.003, 58.0], [15.003, 58.0008], [15.0, 58.0008], [15.0, 58.0]]],
            },
        }
    ],
}


@pytest.fixture
def area(tmp_path: Path) -> Path:
    path = tmp_path / "area.geojson"
    path.write_text(json.dumps(AREA))
    return path


def test_density_is_what_shots_of_a_flight_count_to() -> None:
    """Shot by shot: firings of 46.08 us, a rotor of 600 rpm, 5 m/s at 12 m, the source's tilt."""
    lidar, mount = sensors.lidar("HDL-32E"), Mount()
    seconds, height, speed = 8.0, 12.0, 5.0
    time_s = np.arange(0.0, seconds, 46.08e-6)
    azimuth = 2.0 * np.pi * 10.0 * time_s
    inside = np.abs((azimuth + np.pi) % (2.0 * np.pi) - np.pi) <= np.deg2rad(105.0)
    time_s, azimuth = time_s[inside], azimuth[inside]
    mat = mat_local_ins(0.0, 0.0, 0.0) @ mount.mat_ins_lidar()
    counts = np.zeros(8)
    for elevation in lidar.lasers.elevation_rad:
        beam = np.stack(
            [
                np.cos(elevation) * np.sin(azimuth),
                np.cos(elevation) * np.cos(azimuth),
                np.full(len(azimuth), np.sin(elevation)),
            ]
        )
        east, _, up = mat @ beam
        reach = np.where(up < 0.0, -height / np.where(up < 0.0, up, -1.0), np.inf)
        met = reach <= 70.0
        # every point of so many seconds lies on so many metres of strip, wherever ahead it is
        counts += np.histogram((east * reach)[met], np.arange(-20.0, 21.0, 5.0))[0]
    found = counts / (5.0 * speed * seconds)
    told = Coverage(lidar, mount, GATE, height, speed, 0.0).swath
    expected = [
        told.density[(told.across_m > low) & (told.across_m < low + 5.0)].mean() for low in np.arange(-20.0, 20.0, 5.0)
    ]
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_as_few_lines_are_flown_as_are_dense_enough_and_none_beyond_the_area(area: Path) -> None:
    asked = 500.0
    made = plan(Wish(area, 30.0, 5.0, density=asked))
    assert made.figures()["density"]["least"] >= asked
    width = (made.route.lines - 1) * made.spacing_m
    side = np.array([np.cos(np.deg2rad(made.route.heading_deg)), -np.sin(np.deg2rad(made.route.heading_deg))])
    np.testing.assert_allclose(width, np.ptp(shapely.get_coordinates(made.area) @ side), rtol=1e-6)
    # as many lines farther apart end beyond the area: a longer way for less in the mean
    wider = plan(Wish(area, 30.0, 5.0, spacing_m=width / (made.route.lines - 1.5)))
    assert wider.route.lines == made.route.lines
    assert wider.route.length_m > made.route.length_m
    assert wider.figures()["density"]["mean"] < made.figures()["density"]["mean"]
    # one line less is not enough
    fewer = plan(Wish(area, 30.0, 5.0, spacing_m=width / (made.route.lines - 2) + 1e-6))
    assert fewer.route.lines == made.route.lines - 1
    assert fewer.figures()["density"]["least"] < asked


@pytest.mark.parametrize("overlap", [0.1, 0.5, 0.8])
def test_strips_overlap_as_asked_for_or_more_without_a_line_more(area: Path, overlap: float) -> None:
    made = plan(Wish(area, 30.0, 5.0, overlap=overlap))
    told = made.figures()
    assert told["overlap"] >= overlap - 1e-9
    loose = plan(Wish(area, 30.0, 5.0, spacing_m=told["width_m"] * (1.0 - overlap)))
    assert loose.route.lines == made.route.lines
    assert made.route.length_m <= loose.route.length_m + 1e-6


def test_all_points_of_a_leg_fall_somewhere() -> None:
    """The sum over the ground is the rate of what is met times the time: nothing is gained or lost at the ends."""
    coverage = Coverage(sensors.lidar("HDL-32E"), Mount(), GATE, 30.0, 5.0, np.deg2rad(-7.5))
    turns = np.array([[3.0, -4.0], [83.0, 56.0]])
    east, north = np.meshgrid(np.arange(-100.0, 190.0), np.arange(-100.0, 160.0))
    found = coverage.density(np.column_stack([east.ravel(), north.ravel()]), turns)
    # cells of half a metre looked at every metre, aslant: a hundredth
    np.testing.assert_allclose(found.sum(), coverage.straight.rate * 100.0 / 5.0, rtol=0.01)


@pytest.mark.parametrize(("yaw_deg", "level_pitch_deg"), [(0.0, -32.0), (180.0, -8.0)])
def test_the_lean_of_the_aircraft_turns_the_mount_as_a_whole(yaw_deg: float, level_pitch_deg: float) -> None:
    """Nose down by 12 deg, a lidar that looks 20 deg down ahead looks 32 deg down, and one that looks back 8 deg."""
    lidar, mount = sensors.lidar("HDL-32E"), Mount().with_lidar(yaw_deg=yaw_deg)
    leaning = Coverage(lidar, mount, GATE, 20.0, 8.0, np.deg2rad(-12.0)).straight
    level = Coverage(lidar, mount.with_lidar(pitch_deg=level_pitch_deg), GATE, 20.0, 8.0, 0.0).straight
    assert leaning.rate == pytest.approx(level.rate, rel=1e-3)  # shots at the very end of the range gate
    np.testing.assert_allclose(leaning.before[:, -1], level.before[:, -1], rtol=0, atol=0.02 * level.before.max())


def test_a_lidar_that_looks_to_the_side_is_tipped_about_its_own_axis_by_the_lean() -> None:
    """scipy's rotations as the witness, shot by shot: yaw 90 deg, 20 deg down, nose down by 12 deg."""
    lidar, mount = sensors.lidar("HDL-32E"), Mount().with_lidar(yaw_deg=90.0)
    both = Rotation.from_euler("X", -12.0, degrees=True) * Rotation.from_euler("ZX", [90.0, -20.0], degrees=True)
    azimuth = np.deg2rad(np.arange(-104.95, 105.0, 0.1))
    counts = np.zeros(12)
    for elevation in lidar.lasers.elevation_rad:
        flat = np.cos(elevation)
        beam = np.column_stack(
            [flat * np.sin(azimuth), flat * np.cos(azimuth), np.full(len(azimuth), np.sin(elevation))]
        )
        right, _, up = both.apply(beam).T
        reach = np.where(up < 0.0, -20.0 / np.where(up < 0.0, up, -1.0), np.inf)
        counts += np.histogram((right * reach)[reach <= 70.0], np.arange(-60.0, 61.0, 10.0))[0]
    told = Coverage(lidar, mount, GATE, 20.0, 8.0, np.deg2rad(-12.0)).swath
    found = [
        told.density[(told.across_m > low) & (told.across_m < low + 10.0)].mean()
        for low in np.arange(-60.0, 60.0, 10.0)
    ]
    expected = counts / 3600.0 / 46.08e-6 / (10.0 * 8.0)
    np.testing.assert_allclose(found, expected, rtol=0.01, atol=1.0)


FLOWN = [
    # width and depth of the area [m], spacing, height, mount; what plan over flight was: mean, tenth
    pytest.param(60.0, 30.0, 20.0, 20.0, Mount(), id="small"),  # 1.03, 0.98
    pytest.param(60.0, 30.0, 20.0, 20.0, Mount().with_lidar(yaw_deg=90.0), id="small, to the left"),  # 1.00, 0.94
    pytest.param(160.0, 100.0, 40.0, 30.0, Mount(), id="larger"),  # 1.04, 1.02
    pytest.param(160.0, 100.0, 40.0, 30.0, Mount().with_lidar(pitch_deg=-90.0), id="larger, across"),  # 1.01, 1.01
]


@pytest.mark.parametrize(("width", "depth", "spacing", "height", "mount"), FLOWN)
def test_the_density_is_that_of_a_simulated_flight_along_the_lines(
    width: float, depth: float, spacing: float, height: float, mount: Mount
) -> None:
    """Over the area's mean and for its poorest tenth within 10 %: 8 m/s, gusts, turns, grass that is lost where it is far and aslant."""
    area, speed = shapely.box(-250.0, -350.0, -250.0 + width, -350.0 + depth), 8.0
    turns = route(area, spacing, speed, None, 10.0, calibrate=False).places_m
    points = _flown(turns, height, speed, mount)
    edges = np.arange(-250.0, -249.9 + width, 2.5), np.arange(-350.0, -349.9 + depth, 2.5)
    found = np.histogram2d(*points.T, edges)[0] * _EVERY / 2.5**2
    middles = [0.5 * (each[1:] + each[:-1]) for each in edges]
    places = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 2)
    coverage = Coverage(sensors.lidar("HDL-32E"), mount, GATE, height, speed, np.deg2rad(-12.0))
    told = coverage.density(places, turns)
    assert told.mean() == pytest.approx(found.mean(), rel=0.10)
    assert np.percentile(told, 10.0) == pytest.approx(np.percentile(found, 10.0), rel=0.10)


_EVERY = 4
"""Of the flight's pieces of 0.1 s one in so many is rendered: 3 m of way, which is little beside the swath."""


def _flown(
    turns_m: npt.NDArray[np.float64], height_m: float, speed_m_s: float, mount: Mount
) -> npt.NDArray[np.float64]:
    """East and north of what the simulated lidar sees within the gate."""
    options = Options()
    # a line instead of a cone: a seventh of the rays, and as many echoes of level ground
    beams = dataclasses.replace(options.lidar, footprint_mrad=0.0)
    points_m = tuple((east, north, height_m) for east, north in turns_m.tolist())
    seconds = float(np.linalg.norm(np.diff(turns_m, axis=0), axis=1).sum()) / speed_m_s
    flight = Flight(
        SimulatedRoute(points_m, speed_m_s=speed_m_s, loop_from=-1, hold_s=0.0, smooth_s=0.7),
        seconds,
        options.flight,
        1,
    )
    clock = clocks(options.clocks).lidar
    lidar = Lidar(scene("field", 1).world, flight, mount, clock, beams, 1)
    points, pieces = [], 181
    for first in range(0, lidar.packets_until(seconds) - pieces, pieces * _EVERY):
        sweep = lidar.sweep(first, pieces)
        firing = (sweep.truth["lidar_ns"] - clock.start_ns) // FIRING_NS - first * BLOCKS
        azimuth = sweep.packets["blocks"]["azimuth"].ravel()[firing] * 0.01
        kept = (np.abs((azimuth + 180.0) % 360.0 - 180.0) <= 105.0) & (sweep.truth["range_m"] <= 70.0)
        points.append(np.column_stack([sweep.truth["x"], sweep.truth["y"]])[kept])
    return np.concatenate(points)


@pytest.mark.parametrize("spacing_m", [20.0, 124.0])
@pytest.mark.parametrize("shape", [[(0, 0), (200, 0), (200, 80), (0, 80)], [(0, 0), (150, 30), (60, 140), (-20, 120)]])
def test_every_place_of_the_area_lies_between_two_lines(shape: list[tuple[float, float]], spacing_m: float) -> None:
    """Each flown past it on its own side, no farther than the spacing."""
    polygon = shapely.Polygon(shape)
    flown = route(polygon, spacing_m, 5.0, None, 10.0, calibrate=False)
    ends = flown.places_m.reshape(-1, 2, 2)
    assert flown.lines == len(ends)
    angle = np.deg2rad(flown.heading_deg)
    ahead, right = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
    low, high = np.sort(ends @ ahead, axis=1).T
    offset = (ends @ right).mean(axis=1)
    places = np.random.default_rng(1).uniform(-30.0, 210.0, (3000, 2))
    for place in places[shapely.contains_xy(polygon, places)]:
        beside = (low <= place @ ahead) & (high >= place @ ahead)
        away = offset[beside] - place @ right
        assert ((away >= -1e-9) & (away <= spacing_m)).any()
        assert ((away <= 1e-9) & (away >= -spacing_m)).any()


def test_each_battery_climbs_flies_to_where_the_last_one_turned_and_comes_back() -> None:
    """Two lines of 200 m, 50 m apart, at 5 m/s; 6 s a turning point and 20 s to climb: by hand."""
    flown = route(shapely.box(0.0, 0.0, 180.0, 49.9), 50.0, 5.0, 90.0, 10.0, calibrate=False)
    assert (flown.lines, len(flown.places_m)) == (2, 4)
    # 450 m and 50 m home, four turning points
    whole = 500.0 / 5.0 + 4 * 6.0 + 20.0
    assert flown.seconds == pytest.approx(whole)
    # line, move over and straight back; the other way round: to there, line, back
    diagonal = np.hypot(200.0, 50.0)
    first, second = (250.0 + diagonal) / 5.0 + 3 * 6.0 + 20.0, (diagonal + 200.0 + 50.0) / 5.0 + 2 * 6.0 + 20.0
    assert flown.batteries(whole + 0.1) == 1
    assert flown.batteries(whole - 0.1) == 2
    assert flown.batteries(first + 0.1) == 2
    assert flown.batteries(first - 0.1) == 3  # back from the first line's end, 400 m; move over, 123 s; second line
    assert flown.batteries(second + 0.1) == 3
    with pytest.raises(UsageError, match=r"^--battery 2: 2\.1 min are needed from turning point 2 to the next one"):
        flown.batteries(120.0)
    assert flown.batteries(1e9) == 1


def test_a_mission_is_read_by_pymavlink_and_lies_where_the_area_is(
    area: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, told = tmp_path / "plan.waypoints", tmp_path / "plan.json"
    words = ["--height", "30", "--speed", "5", "--density", "100", "--battery", "10", "--calibrate", "-o", str(out)]
    assert main(["plan", str(area), *words, "--json", str(told)]) == 0
    assert "points a square metre" in capsys.readouterr().out
    loader = mavwp.MAVWPLoader()
    assert loader.load(str(out)) > 10
    commands = [loader.wp(i).command for i in range(loader.count())]
    assert commands[:3] == [16, 22, 178]
    assert commands[-1] == 20
    points = [loader.wp(i) for i in range(3, loader.count() - 1)]
    assert all(14.999 < point.y < 15.004 and 57.999 < point.x < 58.002 and point.z == 30.0 for point in points)
    figures = json.loads(told.read_text())
    assert figures["density"]["least"] >= 100.0
    assert figures["batteries"] == int(np.ceil(figures["seconds"] / 600.0))
    assert (tmp_path / "plan.png").stat().st_size > 10_000


@pytest.mark.parametrize(("spacing", "overlap", "gaps"), [("60", "overlap 4", False), ("250", "no overlap", True)])
def test_lines_that_do_not_overlap_are_said_in_words_and_gaps_are_a_warning(
    area: Path, tmp_path: Path, spacing: str, overlap: str, gaps: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    out, told = tmp_path / "p.waypoints", tmp_path / "p.json"
    words = ["--height", "30", "--speed", "5", "--spacing", spacing, "-o", str(out), "--json", str(told)]
    assert main(["plan", str(area), *words]) == 0
    said = capsys.readouterr()
    assert overlap in said.out
    assert ("% of the area gets less than one point a square metre" in said.err) == gaps
    figures = json.loads(told.read_text())
    assert figures["overlap"] >= 0.0
    assert (figures["gaps"] > 0.0) == gaps


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--height", "0.1", "--speed", "5"], "--height 0.1: expected 1 to 200"),
        (["--height", "90", "--speed", "5"], "no beam meets the ground"),
        (["--height", "30", "--speed", "5", "--density", "99999"], "fly slower or lower"),
    ],
)
def test_what_cannot_be_flown_is_one_sentence(
    area: Path, tmp_path: Path, words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", str(area), *words, "-o", str(tmp_path / "p.waypoints")]) == 2
    told = capsys.readouterr().err
    assert sentence in told
    assert told.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["area.geojson"]
