"""`swath wires` on a line whose every wire is known."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
from scipy.spatial import cKDTree

from groundproc.analysis.corridor.catenary import fitted
from groundproc.analysis.corridor.clearance import Clearance
from groundproc.cli import main
from simulator import outdoors, powerline

ORIGIN = np.array([533_000.0, 6_472_000.0, 0.0])


def write_cloud(path: Path, xyz: np.ndarray, version: str = "1.4", point_format: int = 6) -> Path:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, ORIGIN
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (xyz + ORIGIN).T
    las.write(path)
    return path


@pytest.fixture(scope="module")
def line() -> powerline.Line:
    return powerline.power_line(seed=3, spans=2, per_m2=10.0)


@pytest.fixture(scope="module")
def made(line: powerline.Line, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wires")
    write_cloud(folder / "c.laz", line.xyz)
    words = ["-o", str(folder / "w.geojson"), "--clearance", str(folder / "o.laz"), "--json", str(folder / "f.json")]
    assert main(["wires", str(folder / "c.laz"), *words]) == 0
    return folder


def features(folder: Path, *kinds: str) -> list[tuple[np.ndarray, dict[str, Any]]]:
    tree = json.loads((folder / "w.geojson").read_text())
    assert "EPSG::32633" in tree["crs"]["properties"]["name"]
    return [
        (np.array(each["geometry"]["coordinates"]) - ORIGIN, each["properties"])
        for each in tree["features"]
        if each["properties"]["kind"] in kinds
    ]


def test_each_conductor_of_each_span_is_one_line_from_attachment_to_attachment(
    line: powerline.Line, made: Path
) -> None:
    found = features(made, "conductor", "guard")
    assert len(found) == len(line.wires)
    for wire in line.wires:
        middle = wire.places(np.array([wire.length_m / 2]))[0]
        places, about = min(found, key=lambda each: np.linalg.norm(each[0] - middle, axis=1).min())
        assert np.linalg.norm(places - middle, axis=1).min() < 0.5
        assert about["sag_m"] == pytest.approx(wire.sag_m, abs=0.05)
        assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() <= 1.0
        ends = wire.ends_m if np.linalg.norm(places[0] - wire.ends_m[0]) < 5.0 else wire.ends_m[::-1]
        assert np.linalg.norm(places[[0, -1]] - ends, axis=1).max() < 0.5
        chord = np.linspace(places[0, 2], places[-1, 2], len(places))
        assert about["sag_m"] == pytest.approx((chord - places[:, 2]).max(), abs=0.01)


def test_clearance_is_the_distance_to_the_nearest_true_wire(line: powerline.Line, made: Path) -> None:
    wires = np.concatenate([each.places(np.linspace(0, each.length_m, 4000)) for each in line.wires])
    truth, _ = cKDTree(wires).query(line.xyz)
    las = laspy.read(made / "o.laz")
    assert np.abs(las.clearance - truth)[truth < 30.0].max() < 0.05
    before = laspy.read(made / "c.laz")
    assert np.array_equal(before.points.array["X"], las.points.array["X"])
    told = json.loads((made / "f.json").read_text())["wires"]
    least = min(each["clearance_ground_m"] for each in told)
    heights = wires[:, 2] - outdoors.rolling(wires[:, :2])
    assert least == pytest.approx(heights.min(), abs=0.15)


def test_poles_stays_and_the_fence_are_found_and_nothing_else(line: powerline.Line, made: Path) -> None:
    poles = features(made, "pole", "mast")
    assert len(poles) == len(line.poles_m)
    for x, y, foot, height in line.poles_m:
        assert any(
            np.hypot(*(places[0, :2] - (x, y))) < 0.2
            and places[0, 2] == pytest.approx(foot, abs=0.2)
            and about["height_m"] == pytest.approx(height, abs=0.4)
            for places, about in poles
        )
    stays = features(made, "stay")
    assert len(stays) == len(line.stays_m)
    for ends in line.stays_m:
        assert any(np.linalg.norm(places[[0, -1]] - ends, axis=1).max() < 0.7 for places, _ in stays)
    ((places, _),) = features(made, "fence")
    assert (
        min(np.linalg.norm(places[[0, -1], :2] - each, axis=1).max() for each in (line.fence_m, line.fence_m[::-1]))
        < 1.5
    )


def test_wires_poles_stays_and_fences_have_their_classes(line: powerline.Line, made: Path) -> None:
    kind = np.asarray(laspy.read(made / "o.laz").classification)
    assert np.mean(np.isin(kind[line.kind == powerline.WIRE], (13, 14))) > 0.98
    assert np.mean(kind[line.kind == powerline.POLE] == 65) > 0.8
    assert np.mean(np.isin(kind[line.kind == powerline.STAY], (65, 67))) > 0.9
    high = line.xyz[:, 2] - outdoors.rolling(line.xyz[:, :2]) > 0.5
    assert np.mean(kind[(line.kind == powerline.FENCE) & high] == 66) > 0.9
    assert np.mean(np.isin(kind[line.kind == outdoors.TREE], (13, 14, 65, 66, 67))) < 0.01


def test_houses_and_trees_have_no_wires(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = write_cloud(tmp_path / "c.laz", outdoors.village(seed=1, side_m=80.0, per_m2=12.0).xyz)
    assert main(["wires", str(cloud), "-o", str(tmp_path / "w.geojson")]) == 0
    out = capsys.readouterr()
    assert "0 wires, 0 poles, 0 masts, 0 stays, 0 fences" in out.out
    assert "no wire was found" in out.err


def test_an_old_format_keeps_classes_it_cannot_hold(
    line: powerline.Line, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = write_cloud(tmp_path / "c.las", line.xyz, "1.2", 1)
    words = ["-o", str(tmp_path / "w.gpkg"), "--clearance", str(tmp_path / "o.las")]
    assert main(["wires", str(cloud), *words]) == 0
    assert "classes up to 31 only" in capsys.readouterr().err
    kind = np.asarray(laspy.read(tmp_path / "o.las").classification)
    assert np.mean(np.isin(kind[line.kind == powerline.WIRE], (13, 14))) > 0.98


@pytest.mark.parametrize("a_m", [60.0, 300.0, 4000.0])
def test_a_catenary_is_found_again_from_its_own_places(a_m: float) -> None:
    s = np.linspace(-31.0, 44.0, 60)
    places = np.column_stack([10 + 0.6 * s, 20 - 0.8 * s, 7.0 + a_m * (np.cosh((s - 5.0) / a_m) - 1.0)])
    wire = fitted(places)
    assert wire.a_m == pytest.approx(a_m, rel=1e-2)
    assert wire.low_m == pytest.approx(7.0, abs=1e-3)
    assert wire.rms_m < 1e-3


def test_scatter_about_a_wire_is_the_true_one() -> None:
    """2 cm across and in height are 2.8 cm in all, whatever one point of thirty hangs on."""
    rng = np.random.default_rng(0)
    s = rng.uniform(-31.0, 44.0, 3000)
    places = np.column_stack([s, np.zeros_like(s), 7.0 + 300.0 * (np.cosh((s - 5.0) / 300.0) - 1.0)])
    places[:, 1:] += rng.normal(0.0, 0.02, (len(s), 2))
    places[::30, 2] += 0.3
    assert fitted(places).rms_m == pytest.approx(0.02 * np.sqrt(2.0), rel=0.06)


def test_distances_to_a_wire_are_those_of_brute_force() -> None:
    s = np.linspace(0.0, 50.0, 40)
    wire = fitted(np.column_stack([s, np.zeros_like(s), 10 + (s - 20) ** 2 / 400]))
    places = np.random.default_rng(0).uniform((-5, -10, 0), (55, 10, 20), (300, 3))
    found, _ = Clearance([wire]).of(places)
    truth, _ = cKDTree(wire.places(0.002)).query(places)
    assert found == pytest.approx(truth, abs=2e-3)
    nothing, number = Clearance([]).of(places)
    assert np.isnan(nothing).all()
    assert (number == -1).all()


def test_distances_amid_bundles_and_where_spans_meet_are_those_of_brute_force() -> None:
    """The nearest vertex is often another wire's than the nearest place."""
    rng = np.random.default_rng(1)
    wires = []
    for y, z, phase in ((0.0, 10.0, 0.0), (0.1, 10.0, 0.03), (0.0, 10.13, 0.06), (0.3, 10.0, 0.08)):
        for start, bend in ((0.0, 0.0), (30.0, 0.3)):
            s = start + phase + np.linspace(0.0, 30.0, 50)
            wires.append(fitted(np.column_stack([s, y + bend * (s - 30.0), z + (s - start - 14) ** 2 / 500])))
    truth_at = np.concatenate([each.places(0.001) for each in wires])
    number = np.repeat(np.arange(len(wires)), [len(each.places(0.001)) for each in wires])
    places = truth_at[rng.integers(len(truth_at), size=2000)] + rng.normal(0, 0.06, (2000, 3))
    found, wire = Clearance(wires).of(places)
    truth, at = cKDTree(truth_at).query(places)
    assert found == pytest.approx(truth, abs=1e-3)
    assert np.mean(wire == number[at]) > 0.98  # but for places half way between two


def test_a_height_that_is_none_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = write_cloud(tmp_path / "c.laz", np.random.default_rng(0).uniform(0, 5, (50, 3)))
    assert main(["wires", str(cloud), "-o", str(tmp_path / "w.geojson"), "--min-height", "0"]) == 2
    assert "--min-height 0 m: expected 1 m or more" in capsys.readouterr().err
    assert main(["wires", str(cloud), "-o", str(tmp_path / "w.shp")]) == 2
    assert not list(tmp_path.glob("w.*"))
