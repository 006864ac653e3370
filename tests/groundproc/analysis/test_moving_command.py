"""`swath moving` on people and cars of known ways, as a turning lidar sees them."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pytest
import shapely

from groundproc.analysis.tracks import bursts, tracks
from groundproc.cli import main
from tests.groundproc.analysis.test_ground_command import ORIGIN, write_cloud

SECONDS, TURN_S = 9.0, 0.1
GPS_S = 1.46e9 - 1e9
# begin east and north, speed east and north, length, width, height
THINGS = (
    (2.0, 3.0, 1.4, 0.0, 0.4, 0.5, 1.8),
    (20.0, 0.0, 0.0, 1.2, 0.4, 0.5, 1.7),
    (0.0, 25.0, 8.0, 0.0, 4.2, 1.7, 1.4),
    (70.0, 31.0, -6.5, 0.5, 4.2, 1.7, 1.4),
)


def seen(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Times and points: the two faces of each thing that look to a lidar at (10, 15), one burst a turn."""
    rng = np.random.default_rng(seed)
    lidar = np.array([10.0, 15.0])
    times, places = [], []
    for turn in range(int(SECONDS / TURN_S)):
        for x, y, u, v, length, width, height in THINGS:
            middle = np.array([x + u * turn * TURN_S, y + v * turn * TURN_S])
            way = middle - lidar
            time = (turn + np.arctan2(*way) / (2 * np.pi) % 1.0) * TURN_S
            middle = np.array([x + u * time, y + v * time])
            # a HDL-32E has beams 0.16 deg apart across and 1.33 deg in height
            count = int(min(height * max(length, width) / (way @ way) / (0.0028 * 0.0232), 1500))
            along, across = rng.uniform(-0.5, 0.5, (2, count))
            face = rng.random(count) < length / (length + width)
            side = -np.sign(way)
            sizes = (length, width) if abs(u) > abs(v) else (width, length)
            dx = np.where(face, along * sizes[0], side[0] * sizes[0] / 2)
            dy = np.where(face, side[1] * sizes[1] / 2, across * sizes[1])
            z = rng.uniform(0.2, height, count)
            places.append(np.column_stack([middle[0] + dx, middle[1] + dy, z]) + 0.02 * rng.standard_normal((count, 3)))
            times.append(time + 0.002 * np.sort(rng.random(count)))
    return np.concatenate(times), np.concatenate(places)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("moving")
    time, xyz = seen()
    still = np.random.default_rng(2).uniform((0, 0, 0), (40, 40, 0.01), (5000, 3))
    cloud = write_cloud(folder / "cloud.laz", np.concatenate([xyz, still]))
    las = laspy.read(cloud)
    las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las.gps_time = np.concatenate([time, np.linspace(0, SECONDS, len(still))]) + GPS_S
    las.classification = np.concatenate([np.full(len(xyz), 69), np.full(len(still), 2)]).astype(np.uint8)
    las.write(cloud)
    words = ["moving", str(folder), "-o", str(folder / "m.geojson"), "--ways", str(folder / "w.geojson")]
    assert main([*words, "--json", str(folder / "f.json")]) == 0
    return folder


def table(path: Path) -> tuple[Any, dict[str, Any]]:
    meta, _, shapes, fields = pyogrio.raw.read(path)
    return shapely.from_wkb(shapes), dict(zip(meta["fields"], fields, strict=True))


def test_each_thing_is_one_track_with_its_speed(made: Path) -> None:
    lines, ways = table(made / "w.geojson")
    assert len(lines) == len(THINGS)
    for x, y, u, v, *_ in THINGS:
        begins = np.array([each.coords[0][:2] for each in lines]) - ORIGIN
        number = int(np.argmin(np.hypot(*(begins - (x, y)).T)))
        speed, sigma = ways["speed_m_s"][number], ways["speed_sigma_m_s"][number]
        assert abs(speed - np.hypot(u, v)) < max(3.0 * sigma, 0.05)
        assert sigma < 0.5


def test_places_have_time_speed_and_heading(made: Path) -> None:
    points, places = table(made / "m.geojson")
    assert len(points) == pytest.approx(len(THINGS) * SECONDS / 0.5, rel=0.15)
    xy = np.array([(each.x, each.y) for each in points]) - ORIGIN
    time = np.array([str(each) for each in places["time"]], "datetime64[ms]").astype(np.int64) / 1e3
    for number in np.unique(places["thing"]):
        own = places["thing"] == number
        gone = np.hypot(*np.diff(xy[own], axis=0).T) / np.diff(time[own])
        # each place may be off by what is seen of the thing
        assert np.median(gone) == pytest.approx(np.median(places["speed_m_s"][own]), rel=0.1, abs=0.2)
    assert np.isfinite(places["speed_sigma_m_s"]).all()
    assert ((places["heading_deg"] >= 0) & (places["heading_deg"] < 360)).all()


def test_speeds_are_as_good_as_their_sigmas_say() -> None:
    off = []
    for seed in range(5):
        for each in tracks(bursts(*seen(seed))):
            apart = [np.hypot(*(each.place_m[0, :2] - thing[:2])) for thing in THINGS]
            true = np.array(THINGS[int(np.argmin(apart))][2:4])
            off.append((each.velocity_m_s - true) / each.sigma_m_s[:, None])
    every = np.concatenate(off)
    assert 0.2 < np.sqrt(np.mean(every**2)) < 1.3


def test_figures_count_what_is_in_tracks(made: Path) -> None:
    figures = json.loads((made / "f.json").read_text())
    assert figures["things"] == len(THINGS)
    assert figures["points_in_tracks"] <= figures["points"]
    assert figures["points_in_tracks"] > 0.95 * figures["points"]


def test_a_cloud_in_which_nothing_moved_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = write_cloud(tmp_path / "c.laz", np.random.default_rng(1).uniform(0, 9, (500, 3)))
    las = laspy.read(cloud)
    las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las.gps_time = np.linspace(1, 5, 500) + GPS_S
    las.write(cloud)
    assert main(["moving", str(cloud), "-o", str(tmp_path / "m.geojson")]) == 0
    assert "no point of class 69" in capsys.readouterr().err
    assert json.loads((tmp_path / "m.geojson").read_text())["features"] == []
    # beside a flight's figures the reason is told
    for points, said in (
        ({"classes": {"1": 500}, "warning": "the path does not come back"}, "the path does not come back"),
        ({"classes": {"1": 500}, "warning": ""}, "no beam passed through a place where something was at another time"),
        ({"written": 500}, "its classes were not asked for"),
    ):
        (tmp_path / "quality.json").write_text(json.dumps({"points": points}))
        assert main(["moving", str(cloud), "-o", str(tmp_path / "m.geojson"), "--force"]) == 0
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(("words", "said"), [(("--every", "0"), "--every 0 s: expected"), ((), "no gps_time")])
def test_what_cannot_be_is_one_sentence(
    tmp_path: Path, words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_cloud(tmp_path / "c.las", np.zeros((10, 3)), version="1.2", point_format=0)
    assert main(["moving", str(path), "-o", str(tmp_path / "m.geojson"), *words]) in (1, 2)
    err = capsys.readouterr().err.strip()
    assert said in err
    assert "\n" not in err
    assert not (tmp_path / "m.geojson").exists()


def test_nobody_is_asked_for_the_week_of_a_cloud_without_anything_that_moved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = write_cloud(tmp_path / "c.laz", np.random.default_rng(0).uniform(0, 9, (500, 3)))
    las = laspy.read(cloud)
    las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.WEEK_TIME
    las.gps_time = np.linspace(1000.0, 1010.0, 500)
    las.write(cloud)
    words = ["moving", str(cloud), "-o", str(tmp_path / "m.geojson"), "--force"]
    assert main(words) == 0
    assert "no point of class 69" in capsys.readouterr().err
    las.classification[:50] = 69
    las.write(cloud)
    assert main(words) == 1
    assert "give the week with --week" in capsys.readouterr().err
