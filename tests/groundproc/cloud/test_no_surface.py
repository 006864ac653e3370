"""Noise and what moves (classes 7, 18, 69) change nothing in what the commands say of surfaces: with them and without them, the same."""

import json
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import pyproj
import pytest
import rasterio
import shapely

from groundproc.cli import main

EAST, NORTH = 533_000.0, 6_472_000.0
JUNK = (7, 18, 69)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A slope with a heap; the same with 6,000 points of noise, birds and a car that passes; polygon and check points."""
    path = tmp_path_factory.mktemp("surface")
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0.01, 39.99, (2, 60_000))
    z = 50.0 + 0.05 * x + np.maximum(3.0 * (1 - np.hypot(x - 20, y - 20) / 6.0), 0.0) + rng.normal(0, 0.02, len(x))
    u, v = rng.uniform(5.0, 35.0, (2, 6_000))
    kind = rng.choice(np.array(JUNK, np.uint8), len(u))
    w = 50.0 + np.select(
        [kind == 7, kind == 18],
        [rng.uniform(-20, -5, len(u)), rng.uniform(10, 40, len(u))],
        rng.uniform(1, 2.5, len(u)),
    )
    for name, parts in (("clean.laz", 1), ("dirty.laz", 2)):
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.scales, header.offsets = [0.001] * 3, [EAST, NORTH, 0.0]
        las = laspy.LasData(header)
        rows = [np.stack([x, y, z]), np.stack([u, v, w])][:parts]
        las.xyz = np.concatenate(rows, axis=1).T + np.array([EAST, NORTH, 0.0])
        las.classification = np.concatenate([np.ones(len(x), np.uint8), kind])[: len(las.points)]
        las.intensity = np.concatenate([100 + x.astype(np.uint16), np.full(len(u), 250, np.uint16)])[: len(las.points)]
        las.return_number = las.number_of_returns = np.ones(len(las.points), np.uint8)
        las.header.add_crs(pyproj.CRS.from_epsg(32633))
        las.write(path / name)
    heap = shapely.Point(EAST + 20, NORTH + 20).buffer(8.0)
    pyogrio.raw.write(
        path / "heap.gpkg", shapely.to_wkb(np.array([heap], object)), [np.array(["heap"], object)], ["id"],
        geometry_type="Polygon", crs="EPSG:32633", driver="GPKG",
    )  # fmt: skip
    places = rng.uniform(6, 34, (12, 2))
    rows_ = [f"p{n},{EAST + a:.3f},{NORTH + b:.3f},{50.0 + 0.05 * a:.3f}" for n, (a, b) in enumerate(places)]
    (path / "control.csv").write_text("\n".join(["id,x,y,z", *rows_]) + "\n")
    return path


def run(*words: object) -> None:
    assert main([str(word) for word in words]) == 0


@pytest.mark.parametrize("what", ["dsm", "density", "intensity", "hillshade", "local-relief"])
def test_rasters_are_those_of_the_clean_cloud(
    what: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = []
    for name in ("clean", "dirty"):
        run("raster", folder / f"{name}.laz", "--what", what, "--cell", "0.5", "-o", tmp_path / f"{name}.tif")
        with rasterio.open(tmp_path / f"{name}.tif") as raster:
            found.append((raster.bounds, raster.read(1)))
    assert found[0][0] == found[1][0]
    np.testing.assert_array_equal(found[0][1], found[1][1])
    assert "6,000 points of classes 7, 18 and 69 left out" in capsys.readouterr().out


def test_all_classes_count_where_they_are_asked_for(folder: Path, tmp_path: Path) -> None:
    run("raster", folder / "dirty.laz", "--all-classes", "--cell", "0.5", "-o", tmp_path / "all.tif")
    with rasterio.open(tmp_path / "all.tif") as raster:
        assert raster.read(1).max() > 80.0


def test_volumes_check_points_and_orthophotos_are_those_of_the_clean_cloud(folder: Path, tmp_path: Path) -> None:
    told: dict[str, list[object]] = {"volume": [], "assess": []}
    pixels = []
    for name in ("clean", "dirty"):
        cloud = folder / f"{name}.laz"
        run("volume", cloud, folder / "heap.gpkg", "--base", "toe", "--json", tmp_path / f"{name}.v.json")
        run(
            "assess",
            cloud,
            "--points",
            folder / "control.csv",
            "--mode",
            "plane",
            "--json",
            tmp_path / f"{name}.a.json",
        )
        run("orthophoto", cloud, "--attribute", "intensity", "--cell", "0.5", "-o", tmp_path / f"{name}.o.tif")
        told["volume"].append(json.loads((tmp_path / f"{name}.v.json").read_text())["polygons"])
        told["assess"].append(json.loads((tmp_path / f"{name}.a.json").read_text())["points"])
        with rasterio.open(tmp_path / f"{name}.o.tif") as raster:
            pixels.append(raster.read(1))
    assert told["volume"][0] == told["volume"][1]
    assert told["assess"][0] == told["assess"][1]
    np.testing.assert_array_equal(*pixels)


def test_the_ground_is_that_of_the_clean_cloud_and_what_moves_stays_so(folder: Path, tmp_path: Path) -> None:
    found = []
    for name in ("clean", "dirty"):
        run("ground", folder / f"{name}.laz", "-o", tmp_path / f"{name}.laz", "--dtm", tmp_path / f"{name}.tif")
        with rasterio.open(tmp_path / f"{name}.tif") as raster:
            found.append(raster.read(1))
    np.testing.assert_allclose(*found, rtol=0, atol=1e-4)
    clean, dirty = laspy.read(tmp_path / "clean.laz"), laspy.read(tmp_path / "dirty.laz")
    given = np.asarray(laspy.read(folder / "dirty.laz").classification)
    same = np.asarray(dirty.classification)[: len(clean.points)] == np.asarray(clean.classification)
    assert same.all()
    assert (np.asarray(dirty.classification)[given == 69] == 69).all()
    assert np.isin(np.asarray(dirty.classification)[np.isin(given, [7, 18])], [7, 18]).all()


def test_changes_and_moves_of_surfaces_are_those_of_the_clean_cloud(folder: Path, tmp_path: Path) -> None:
    told = []
    for name in ("clean", "dirty"):
        out = tmp_path / name
        run(
            "change",
            folder / "clean.laz",
            folder / f"{name}.laz",
            "--registered",
            "--surface",
            "-o",
            out,
            "--json",
            out / "f.json",
        )
        told.append(json.loads((out / "f.json").read_text()))
    surfaces = [each.pop("surface") for each in told]
    assert told[0] == told[1]
    # squares follow the number of points, and with them where distances are measured
    assert surfaces[0]["areas"] == surfaces[1]["areas"] == 0
    assert surfaces[0]["lod95_m"] == pytest.approx(surfaces[1]["lod95_m"], rel=0.05)
    made = laspy.read(tmp_path / "dirty" / "change.laz")
    junk = np.isin(np.asarray(made.classification), JUNK)
    assert junk.sum() == 6_000
    assert len(made.points) == 60_000 + 66_000  # every point that came in
    assert (np.asarray(made.change)[junk] == 4).all()
    assert np.isnan(np.asarray(made.change_distance)[junk]).all()
    assert (np.asarray(made.change)[~junk] != 4).all()


def test_noise_is_a_change_where_it_is_asked_for(folder: Path, tmp_path: Path) -> None:
    run(
        "change",
        folder / "clean.laz",
        folder / "dirty.laz",
        "--registered",
        "--all-classes",
        "-o",
        tmp_path,
        "--json",
        tmp_path / "f.json",
    )
    assert not (np.asarray(laspy.read(tmp_path / "change.laz").change) == 4).any()


def test_a_section_shows_what_stands(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ("--line", f"{EAST + 5},{NORTH + 20},{EAST + 35},{NORTH + 20}")
    for name, words in (("clean", ()), ("dirty", ()), ("dirty", ("--all-classes",))):
        run("section", folder / f"{name}.laz", *line, *words, "-o", tmp_path / f"{name}{len(words)}.laz")
    clean, dirty, everything = (laspy.read(tmp_path / f"{name}.laz") for name in ("clean0", "dirty0", "dirty1"))
    np.testing.assert_array_equal(clean.xyz, dirty.xyz)
    left_out = len(everything.points) - len(dirty.points)
    assert left_out > 50
    assert f"{left_out:,} points of noise and of what moves were left out" in capsys.readouterr().out
    assert np.isin(np.asarray(everything.classification), JUNK).sum() == left_out


def test_a_cloud_of_noise_alone_is_one_sentence(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    las = laspy.read(folder / "clean.laz")
    las.classification = np.full(len(las.points), 7, np.uint8)
    las.write(tmp_path / "n.laz")
    words = ["change", str(folder / "clean.laz"), str(tmp_path / "n.laz"), "-o", str(tmp_path / "o")]
    assert main(words) == 1
    assert "n.laz: holds nothing but noise and what moves, expected points of surfaces" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
