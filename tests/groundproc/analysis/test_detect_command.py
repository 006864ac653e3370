"""`swath detect`: cars under trees."""

import json
import os
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
import rasterio

from groundproc.analysis.terrain.floor import Floor
from groundproc.cli import main
from groundproc.cloud import reader
from simulator import outdoors

ORIGIN = np.array([533_000.0, 6_472_000.0, 0.0])
RECORDINGS = os.environ.get("SWATH_RECORDINGS", "")


def write_cloud(path: Path, xyz: np.ndarray) -> Path:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, ORIGIN
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (xyz + ORIGIN).T
    las.return_number[:] = 1
    las.number_of_returns[:] = 1
    las.write(path)
    return path


def objects(path: Path) -> list[dict[str, Any]]:
    return [each["properties"] for each in json.loads(path.read_text())["features"]]


def missed_and_false(found: list[dict[str, Any]], boxes: np.ndarray) -> tuple[int, int]:
    if not found:
        return len(boxes), 0
    away = np.hypot(*(np.array([[[e["x"], e["y"]] for e in found]]) - boxes[:, None, :2]).transpose(2, 0, 1))
    return int((away.min(axis=1) > 2.5).sum()), int((away.min(axis=0) > 2.5).sum())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    folder = tmp_path_factory.mktemp("detect")
    wood = outdoors.wood(seed=2, side_m=60.0, per_m2=14.0)
    above = wood.xyz[:, 2] - wood.ground(wood.xyz[:, :2])
    xyz, boxes = outdoors.with_vehicles(wood.xyz, above, 1, 10)
    write_cloud(folder / "c.laz", xyz)
    words = ["--cloud", str(folder / "o.laz"), "--penetration", str(folder / "p.tif"), "--json", str(folder / "f.json")]
    assert main(["detect", str(folder / "c.laz"), "-o", str(folder / "o.geojson"), *words]) == 0
    boxes[:, :2] += ORIGIN[:2]
    return folder, boxes


def test_cars_under_trees_are_found_with_their_places_and_sizes(made: tuple[Path, np.ndarray]) -> None:
    folder, boxes = made
    found = objects(folder / "o.geojson")
    missed, false = missed_and_false(found, boxes)
    assert missed <= 1
    assert false <= 1
    assert [each["score"] for each in found] == sorted((each["score"] for each in found), reverse=True)
    for box in boxes:
        near = [each for each in found if np.hypot(each["x"] - box[0], each["y"] - box[1]) < 2.5]
        for each in near:
            assert 1.5 < each["length_m"] < 7.5
            # the roof, or where that was hit less, the front
            assert 0.5 * box[5] < each["height_m"] < box[5] + 0.3
            assert each["points"] >= 4


def test_the_copy_holds_every_point_with_its_height_and_object(made: tuple[Path, np.ndarray]) -> None:
    folder, _ = made
    before, after = laspy.read(folder / "c.laz"), laspy.read(folder / "o.laz")
    assert np.array_equal(before.points.array["X"], after.points.array["X"])
    found = objects(folder / "o.geojson")
    assert set(np.unique(after["object"])) <= set(range(len(found) + 1))
    first = found[0]
    inside = after["object"] == first["number"]
    assert inside.sum() >= 4
    assert np.hypot(after.x[inside] - first["x"], after.y[inside] - first["y"]).max() < 4.5
    assert np.isfinite(after.hag).all()


def test_the_penetration_map_holds_shares(made: tuple[Path, np.ndarray]) -> None:
    folder, _ = made
    with rasterio.open(folder / "p.tif") as file:
        share = file.read(1, masked=True).compressed()
        assert file.res == (2.0, 2.0)
    assert share.min() >= 0.0
    assert share.max() <= 1.0
    figures = json.loads((folder / "f.json").read_text())
    assert 0.2 < figures["penetration"] < 0.9
    assert 0.0 <= figures["blind_share"] <= 1.0


def test_a_wood_without_cars_has_hardly_any(tmp_path: Path) -> None:
    cloud = write_cloud(tmp_path / "c.laz", outdoors.wood(seed=5, side_m=50.0, per_m2=14.0).xyz)
    assert main(["detect", str(cloud), "-o", str(tmp_path / "o.geojson")]) == 0
    assert len(objects(tmp_path / "o.geojson")) <= 1


# a recorded wood with forty vehicles put in; in the quick suite: cars under made-up trees, and none in a wood without (above)
@pytest.mark.soak
@pytest.mark.skipif(not RECORDINGS, reason="SWATH_RECORDINGS is not set")
def test_cars_put_into_a_real_wood_are_found_at_five_false_alarms_a_hectare(tmp_path: Path) -> None:
    source = Path(RECORDINGS, "clouds", "lasR_bcts_1.laz")
    las = laspy.read(source)
    floor = Floor(reader.look(source), tmp_path, lambda done: None)
    xyz = np.ascontiguousarray(las.xyz)
    above = xyz[:, 2] - floor.base.bilinear(xyz)
    las.z, boxes = (lambda found: (found[0][:, 2], found[1]))(outdoors.with_vehicles(xyz, above, 1, 40))
    las.write(tmp_path / "c.laz")
    assert main(["detect", str(tmp_path / "c.laz"), "-o", str(tmp_path / "o.geojson")]) == 0
    missed, false = missed_and_false(objects(tmp_path / "o.geojson"), boxes)
    hectares = np.prod(np.ptp(xyz[:, :2], axis=0)) / 1e4
    assert missed <= 4
    assert false / hectares <= 5.0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--max-height", "0.2"], "--max-height 0.2 m: expected 1 to 10 m"),
        (["--min-score", "nan"], "--min-score nan: expected a number"),
    ],
)
def test_values_that_are_none_are_one_sentence(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = write_cloud(tmp_path / "c.laz", np.random.default_rng(0).uniform(0, 5, (50, 3)))
    assert main(["detect", str(cloud), "-o", str(tmp_path / "o.geojson"), *words]) == 2
    assert said in capsys.readouterr().err


def test_a_handful_of_points_has_no_objects(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = write_cloud(tmp_path / "c.laz", np.random.default_rng(0).uniform(0, 3, (3, 3)))
    assert main(["detect", str(cloud), "-o", str(tmp_path / "o.geojson")]) == 0
    assert "0 objects" in capsys.readouterr().out
