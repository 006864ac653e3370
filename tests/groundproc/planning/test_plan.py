"""A plan: density by counting, lines that cover, a mission that pymavlink reads."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from pymavlink import mavwp

from flightlog.errors import UsageError
from flightlog.frames import mat_local_ins
from flightlog.mount import Mount
from groundproc import sensors
from groundproc.cli import main
from groundproc.planning.coverage import spacing_for, swath
from groundproc.planning.route import route
from groundproc.sensors.shots import Gate

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
    told = swath(lidar, mount, GATE, height, speed)
    expected = [
        told.density[(told.across_m > low) & (told.across_m < low + 5.0)].mean() for low in np.arange(-20.0, 20.0, 5.0)
    ]
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_the_widest_spacing_that_is_dense_enough_is_taken() -> None:
    strip = swath(sensors.lidar("HDL-32E"), Mount(), GATE, 30.0, 5.0)
    spacing = spacing_for(strip, 100.0)
    assert strip.of_lines(spacing).min() >= 100.0
    assert strip.of_lines(spacing + 0.5).min() < 100.0
    # all points of a line fall somewhere between the lines
    np.testing.assert_allclose(strip.of_lines(spacing).mean() * spacing, strip.density.sum() * 0.25, rtol=1e-3)


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
