"""`swath volume`: heaps and pits whose volume geometry gives."""

import json
import math
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pyproj
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin

from groundproc.cli import main

ORIGIN = np.array([533_000.0, 6_472_000.0])


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A slope of 5 % and 2 %."""
    return 50.0 + 0.05 * x - 0.02 * y


def scene(path: Path, seed: int = 1, noise_m: float = 0.02, per_m2: float = 60.0) -> Path:
    """A cone of radius 8 m and height 4 m at (20, 20), and a square pit of 6 m, 1.5 m deep, at (45, 20), on a slope."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 60, (2, int(60 * 40 * per_m2)))
    y *= 40 / 60
    z = ground(x, y) + np.maximum(4.0 * (1 - np.hypot(x - 20, y - 20) / 8.0), 0.0)
    z -= 1.5 * ((np.abs(x - 45) < 3) & (np.abs(y - 20) < 3))
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [*ORIGIN, 0.0]
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.x, las.y, las.z = x + ORIGIN[0], y + ORIGIN[1], z + rng.normal(0, noise_m, len(z))
    las.write(path)
    return path


def polygons(path: Path, shapes: dict[str, Any], epsg: int = 32633) -> Path:
    """Polygons about the origin of the scene, in a CRS."""
    moved = [shapely.transform(each, lambda xy: xy + ORIGIN) for each in shapes.values()]
    if epsg != 32633:
        to = pyproj.Transformer.from_crs(32633, epsg, always_xy=True)
        moved = [shapely.transform(each, lambda xy: np.stack(to.transform(*xy.T), axis=1)) for each in moved]
    pyogrio.raw.write(
        path, shapely.to_wkb(np.array(moved, object)), [np.array(list(shapes), object)], ["id"],
        geometry_type="Polygon", crs=f"EPSG:{epsg}", driver="GPKG" if path.suffix == ".gpkg" else "GeoJSON",
    )  # fmt: skip
    return path


HEAP = shapely.Point(20, 20).buffer(10.0)
PIT = shapely.box(40, 15, 50, 25)
CONE_M3 = math.pi * 8.0**2 * 4.0 / 3.0
PIT_M3 = 6.0 * 6.0 * 1.5


def measured(tmp_path: Path, *words: str | Path) -> dict[str, dict[str, Any]]:
    assert main(["volume", *map(str, words), "--json", str(tmp_path / "v.json"), "--force"]) == 0
    return {each["id"]: each for each in json.loads((tmp_path / "v.json").read_text())["polygons"]}


@pytest.mark.parametrize("base", ["toe", "plane"])
@pytest.mark.parametrize(("name", "epsg"), [("p.gpkg", 32633), ("p.geojson", 4326)])
def test_a_heap_and_a_pit_on_a_slope_hold_what_geometry_says(base: str, name: str, epsg: int, tmp_path: Path) -> None:
    cloud = scene(tmp_path / "c.laz")
    found = measured(tmp_path, cloud, polygons(tmp_path / name, {"heap": HEAP, "pit": PIT}, epsg), "--base", base)
    heap, pit = found["heap"], found["pit"]
    # noise of 2 cm makes |z| of 7 mm in each cell of six points on bare ground, which cut and fill share, and net does not
    assert heap["net_m3"] == pytest.approx(CONE_M3, abs=3.0 * heap["sigma_m3"])
    assert pit["net_m3"] == pytest.approx(-PIT_M3, abs=3.0 * pit["sigma_m3"])
    assert heap["sigma_m3"] < 0.02 * CONE_M3
    assert heap["cut_m3"] - heap["fill_m3"] == pytest.approx(heap["net_m3"])
    assert heap["fill_m3"] < 0.01 * CONE_M3
    assert pit["cut_m3"] < 0.02 * PIT_M3
    assert heap["area_m2"] == pytest.approx(HEAP.area, rel=1e-3)


@pytest.mark.parametrize("seeds", [4, pytest.param(12, marks=pytest.mark.soak)])  # a cloud and a run each
def test_errors_lie_within_their_sigma_over_many_seeds(seeds: int, tmp_path: Path) -> None:
    shapes = polygons(tmp_path / "p.gpkg", {"heap": HEAP, "pit": PIT})
    errors = []
    for seed in range(seeds):
        found = measured(tmp_path, scene(tmp_path / "c.laz", seed, 0.05, 25.0), shapes)
        errors.append((found["heap"]["net_m3"] - CONE_M3) / found["heap"]["sigma_m3"])
        errors.append((found["pit"]["net_m3"] + PIT_M3) / found["pit"]["sigma_m3"])
    assert np.mean(np.abs(errors) <= 2.0) >= 0.9


def test_a_raster_is_a_base_too(tmp_path: Path) -> None:
    cell = 0.5
    j, i = np.mgrid[:80, :120]
    heights = ground((i + 0.5) * cell, 40.0 - (j + 0.5) * cell).astype(np.float32)
    transform = from_origin(ORIGIN[0], ORIGIN[1] + 40.0, cell, cell)
    with rasterio.open(
        tmp_path / "base.tif", "w", driver="GTiff", width=120, height=80, count=1, dtype="float32", crs="EPSG:32633",
        transform=transform,
    ) as file:  # fmt: skip
        file.write(heights, 1)
    found = measured(
        tmp_path,
        scene(tmp_path / "c.laz"),
        polygons(tmp_path / "p.gpkg", {"heap": HEAP}),
        "--base",
        tmp_path / "base.tif",
    )
    assert found["heap"]["net_m3"] == pytest.approx(CONE_M3, rel=0.005)


def in_feet(path: Path, epsg: int) -> Path:
    """The scene in feet of the US survey, its figures as they are in metres."""
    foot_m = 1200 / 3937
    las = laspy.read(scene(path))
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, np.floor(las.header.offsets / foot_m)
    header.add_crs(pyproj.CRS.from_epsg(epsg))
    feet = laspy.LasData(header)
    feet.xyz = las.xyz / foot_m
    feet.write(path)
    return path


@pytest.mark.parametrize("base", ["toe", "plane", "dtm", "base.tif"])
def test_a_cloud_in_feet_has_its_volume_in_cubic_metres(base: str, tmp_path: Path) -> None:
    """A cubic metre is 35.3 cubic feet. North Carolina's plane (EPSG 2264) is in feet, and so are polygons and raster in it."""
    foot_m, cell = 1200 / 3937, 2.0
    cloud = in_feet(tmp_path / "c.laz", 2264)
    shape = shapely.transform(HEAP, lambda xy: (xy + ORIGIN) / foot_m)
    pyogrio.raw.write(
        tmp_path / "p.gpkg", shapely.to_wkb(np.array([shape])), [np.array(["heap"], object)], ["id"], geometry_type="Polygon",
        crs="EPSG:2264",
    )  # fmt: skip
    corner = np.floor(ORIGIN / foot_m / cell) * cell + [0.0, 140.0]
    j, i = np.mgrid[:70, :100]
    east_m, north_m = (corner[0] + (i + 0.5) * cell) * foot_m, (corner[1] - (j + 0.5) * cell) * foot_m
    with rasterio.open(
        tmp_path / "base.tif", "w", driver="GTiff", width=100, height=70, count=1, dtype="float32", crs="EPSG:2264",
        transform=from_origin(*corner, cell, cell),
    ) as file:  # fmt: skip
        file.write((ground(east_m - ORIGIN[0], north_m - ORIGIN[1]) / foot_m).astype(np.float32), 1)
    if base == "dtm":  # what is bare ground is said: a heap of earth is ground itself
        las = laspy.read(cloud)
        away = np.hypot(*((np.asarray(las.xyz)[:, :2] * foot_m - ORIGIN - 20.0).T)) > 8.0
        las.classification = np.where(away, 2, 1)
        las.write(cloud)
    found = measured(tmp_path, cloud, tmp_path / "p.gpkg", "--base", tmp_path / base if base.endswith("tif") else base)[
        "heap"
    ]
    assert found["net_m3"] == pytest.approx(CONE_M3, rel=0.02)
    assert found["area_m2"] == pytest.approx(HEAP.area, rel=1e-3)


def test_parts_of_one_thing_are_measured_together(tmp_path: Path) -> None:
    """Two heaps that are one polygon in a file of a GIS."""
    both = shapely.MultiPolygon([HEAP, PIT])
    areas = tmp_path / "p.gpkg"
    pyogrio.raw.write(
        areas, shapely.to_wkb(np.array([shapely.transform(both, lambda xy: xy + ORIGIN)])), [np.array(["both"], object)], ["id"],
        geometry_type="MultiPolygon", crs="EPSG:32633",
    )  # fmt: skip
    cloud = scene(tmp_path / "c.laz")
    found = measured(tmp_path, cloud, areas)["both"]
    apart = measured(tmp_path, cloud, polygons(tmp_path / "q.gpkg", {"heap": HEAP, "pit": PIT}))
    assert found["net_m3"] == pytest.approx(CONE_M3 - PIT_M3, abs=3.0 * found["sigma_m3"])
    assert found["area_m2"] == pytest.approx(both.area, rel=1e-3)
    assert found["sigma_m3"] == pytest.approx(math.hypot(apart["heap"]["sigma_m3"], apart["pit"]["sigma_m3"]))


def test_a_base_in_another_crs_is_refused_and_what_states_none_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud, areas = scene(tmp_path / "c.laz"), polygons(tmp_path / "p.gpkg", {"heap": HEAP})
    for crs in ("EPSG:32634", None):
        with rasterio.open(
            tmp_path / "base.tif", "w", driver="GTiff", width=60, height=40, count=1, dtype="float32", crs=crs,
            transform=from_origin(ORIGIN[0], ORIGIN[1] + 40.0, 1.0, 1.0),
        ) as file:  # fmt: skip
            file.write(np.full((40, 60), 50.0, np.float32), 1)
        done = main(["volume", str(cloud), str(areas), "--base", str(tmp_path / "base.tif")])
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert (done, "UTM zone 34N" in said, "base.tif states no CRS" in said) == (
            (0, False, True) if crs is None else (1, True, False)
        )


def test_a_polygon_half_without_points_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    areas = polygons(tmp_path / "p.gpkg", {"half": shapely.box(48, 10, 68, 30)})
    found = measured(tmp_path, scene(tmp_path / "c.laz"), areas)["half"]
    assert found["empty_m2"] == pytest.approx(160.0, rel=0.05)
    assert "polygon half: " in capsys.readouterr().err


def test_a_polygon_beyond_the_cloud_is_named_and_the_others_are_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shapes = polygons(tmp_path / "p.gpkg", {"heap": HEAP, "away": shapely.box(200, 200, 210, 210)})
    assert list(measured(tmp_path, scene(tmp_path / "c.laz"), shapes)) == ["heap"]
    assert "polygon away is not measured: no points" in capsys.readouterr().err
    told = json.loads((tmp_path / "v.json").read_text())
    assert [each["id"] for each in told["unmeasured"]] == ["away"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["c.laz", "p.gpkg", "--base", "roof"], "--base roof"),
        (["c.laz", "c.laz"], "ends in .gpkg"),
        (["c.laz", "none.gpkg"], "none.gpkg"),
        (["c.laz", "far.gpkg"], "not one polygon"),
        (["c.laz", "bow.gpkg"], "does not cross itself"),
        (["c.laz", "p.gpkg", "--base", "none.tif"], "none.tif"),
    ],
)
def test_what_cannot_be_measured_is_one_sentence(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scene(Path("c.laz"), per_m2=2.0)
    polygons(Path("p.gpkg"), {"heap": HEAP})
    polygons(Path("far.gpkg"), {"far": shapely.box(900, 900, 910, 910)})
    polygons(Path("bow.gpkg"), {"bow": shapely.Polygon([(10, 10), (20, 20), (20, 10), (10, 20)])})
    capsys.readouterr()
    assert main(["volume", *words]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1


def house(path: Path, classed: bool) -> Path:
    """A block of 10 x 8 m and 5 m high on a slope; its walls are not seen."""
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0, 60, (2, 60 * 40 * 40))
    y *= 40 / 60
    roof = (np.abs(x - 30) < 5) & (np.abs(y - 20) < 4)
    z = np.where(roof, ground(np.array(30.0), np.array(20.0)) + 5.0, ground(x, y)) + rng.normal(0, 0.02, len(x))
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [*ORIGIN, 0.0]
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.x, las.y, las.z = x + ORIGIN[0], y + ORIGIN[1], z
    las.classification = np.where(roof, 6, 2) if classed else np.ones(len(x), np.uint8)
    las.write(path)
    return path


@pytest.mark.parametrize("classed", [True, False])
def test_what_stands_on_the_ground_is_measured_from_the_ground(classed: bool, tmp_path: Path) -> None:
    cloud = house(tmp_path / "c.laz", classed)
    areas = polygons(tmp_path / "p.gpkg", {"house": shapely.box(24, 15, 36, 25)})
    found = measured(tmp_path, cloud, areas, "--base", "dtm")["house"]
    # the roof is flat and the ground slopes evenly: the mean height is that over the middle; each edge is known to half a cell
    edge = 2 * (10 + 8) * 0.5 * 0.16 * 5.0
    assert found["net_m3"] == pytest.approx(10 * 8 * 5.0, abs=edge + 3 * found["sigma_m3"])
    assert 0.0 < found["sigma_m3"] < 10.0


def test_a_cloud_without_ground_has_no_volume_above_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = house(tmp_path / "c.laz", True)
    las = laspy.read(cloud)
    las.classification[las.classification == 2] = 5
    las.classification[np.hypot(las.x - ORIGIN[0] - 37, las.y - ORIGIN[1] - 20).argsort()[:3]] = 2
    las.write(cloud)
    areas = polygons(tmp_path / "p.gpkg", {"house": shapely.box(24, 15, 36, 25)})
    assert main(["volume", str(cloud), str(areas), "--base", "dtm"]) in (1, 2)
    assert "points of ground within 5 m" in capsys.readouterr().err
