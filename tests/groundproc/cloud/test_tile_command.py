"""`swath tile`: every point in one tile and unchanged; the index as STAC's own library and GDAL read it."""

import json
import tracemalloc
from pathlib import Path

import copclib
import laspy
import numpy as np
import pyogrio
import pyproj
import pystac
import pytest
import shapely

from groundproc.cli import main
from groundproc.cloud import reader

EAST, NORTH = 533_000.0, 6_472_000.0
SIZE = 50.0
START_S = 430_000_000.0


def cloud(path: Path, seed: int = 1, count: int = 40_000, crs: bool = True, rough_m: float = 2.0) -> laspy.LasData:
    """Points over 150 x 120 m, some of them on the edges of tiles."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [EAST, NORTH, 0.0]
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    if crs:
        both = pyproj.crs.CompoundCRS("both", [pyproj.CRS.from_epsg(32633), pyproj.CRS.from_epsg(5773)])
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(both.to_wkt("WKT1_GDAL")))
    header.add_extra_dim(laspy.ExtraBytesParams("theirs", "f8"))
    header.add_extra_dim(laspy.ExtraBytesParams("step", "u2", scales=[0.5], offsets=[0.0]))
    las = laspy.LasData(header)
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 150, count), rng.uniform(0, 120, count)
    x[:100], y[50:150] = 50.0, 100.0
    las.x, las.y = EAST + 10 + x, NORTH + y
    las.x[:100] = EAST + 50.0
    las.z, las.intensity = rng.normal(50.25, rough_m, count), rng.integers(0, 255, count)
    las.theirs, las.step = rng.normal(0, 1, count), 0.5 * rng.integers(0, 9, count)
    las.return_number = las.number_of_returns = np.ones(count, np.uint8)
    las.gps_time = START_S + 1000.0 * seed + np.arange(count) * 1e-3
    las.write(path)
    return laspy.read(path)


def tiled(tmp_path: Path, *words: str) -> dict[str, laspy.LasData]:
    """All tiles by their name, as laspy reads them."""
    assert main(["tile", *words, "-o", str(tmp_path / "tiles"), "--size", f"{SIZE:g}"]) == 0
    names = [each.name for each in (tmp_path / "tiles").glob("*.laz") if each.name != "overview.copc.laz"]
    return {name: laspy.read(tmp_path / "tiles" / name) for name in sorted(names)}


@pytest.mark.parametrize("form", ["copc", "laz"])
def test_every_point_is_in_one_tile_as_it_was(form: str, tmp_path: Path) -> None:
    sources = [cloud(tmp_path / f"{seed}.laz", seed) for seed in (1, 2)]
    tiles = tiled(tmp_path, str(tmp_path / "1.laz"), str(tmp_path / "2.laz"), "--format", form)
    names = ("X", "Y", "Z", "gps_time", "theirs", "step", "intensity")
    rows = [np.rec.fromarrays([np.asarray(las[n]) for n in names], names=names) for las in (*tiles.values(), *sources)]
    found, expected = np.concatenate(rows[: len(tiles)]), np.concatenate(rows[len(tiles) :])
    np.testing.assert_array_equal(np.sort(found, order="gps_time"), np.sort(expected, order="gps_time"))
    assert len(tiles) == 4 * 3
    for name, las in tiles.items():
        west, south = (float(part) for part in name.partition(".")[0].split("_"))
        assert west % SIZE == south % SIZE == 0.0
        assert las.x.min() >= west, "a point on the western edge belongs to the tile"
        assert las.x.max() < west + SIZE
        assert las.y.min() > south
        assert las.y.max() <= south + SIZE, "and one on the northern edge"
        np.testing.assert_allclose(
            [las.header.mins, las.header.maxs], [las.xyz.min(axis=0), las.xyz.max(axis=0)], rtol=0.0, atol=1e-6
        )
        assert las.header.parse_crs().sub_crs_list[1].to_epsg() == 5773
        assert int(las.header.number_of_points_by_return[0]) == len(las.points)


def test_the_index_is_stac_and_says_where_and_what_the_tiles_are(tmp_path: Path) -> None:
    cloud(tmp_path / "1.laz")
    tiles = tiled(tmp_path, str(tmp_path / "1.laz"))
    index = tmp_path / "tiles" / "cloud.vpc"
    tree = json.loads(index.read_text())
    # the grammar of its schemas takes seconds to read
    from pystac.validation.stac_validator import JsonSchemaSTACValidator

    items = pystac.ItemCollection.from_file(str(index))
    assert len(items) == len({item.id for item in items}) == len(tiles)
    assert {each["stac_version"] for each in tree["features"]} == {"1.0.0"}, "other programs read this version only"
    schema = JsonSchemaSTACValidator()
    for item in items:
        plain = item.to_dict()  # of the version whose schema the library holds
        assert schema.validate_core(plain, pystac.STACObjectType.ITEM, plain["stac_version"])
        las = tiles[Path(item.assets["data"].href).name]
        told = item.properties
        sizes = {each["name"]: each["size"] for each in told["pc:schemas"]}
        assert told["pc:count"] == len(las.points)
        assert set(sizes) >= {"X", "Y", "Z", "Intensity", "GpsTime", "theirs", "step"}
        assert sizes["step"] == 8, "PDAL gives scaled extra bytes as doubles"
        np.testing.assert_allclose(told["proj:bbox"], [*las.header.mins, *las.header.maxs], rtol=0.0, atol=1e-6)
        crs = pyproj.CRS.from_wkt(told["proj:wkt2"])
        assert [part.to_epsg() for part in crs.sub_crs_list] == [32633, 5773]
        to_map = pyproj.Transformer.from_crs(4326, 32633, always_xy=True)
        ring = shapely.geometry.shape(item.geometry)
        assert shapely.is_ccw(ring.exterior)
        back = np.array(to_map.transform(*np.array(ring.exterior.coords).T)).T
        np.testing.assert_allclose(
            [back.min(axis=0), back.max(axis=0)], [las.header.mins[:2], las.header.maxs[:2]], rtol=0, atol=1e-3
        )
        assert item.common_metadata.start_datetime is not None
        assert item.datetime is not None
        assert item.datetime.year == 2025
    by_gdal = pyogrio.raw.read(index, layer=0)
    assert len(by_gdal[2]) == len(tiles)


def test_the_index_is_what_qgis_and_pdal_wrench_look_for(tmp_path: Path) -> None:
    """The rules of their readers (QGIS's provider of virtual point clouds, wrench's vpc.cpp and vpc-spec.md), followed by hand."""
    cloud(tmp_path / "1.laz")
    tiled(tmp_path, str(tmp_path / "1.laz"))
    tree = json.loads((tmp_path / "tiles" / "cloud.vpc").read_text())
    assert tree["type"] == "FeatureCollection"
    for item in tree["features"]:
        assert (item["type"], item["stac_version"]) == ("Feature", "1.0.0")
        assert all(isinstance(item[name], dict) for name in ("assets", "properties", "geometry"))
        # both sort names, and the first asset is the data
        first = item["assets"][min(item["assets"])]
        assert first["href"].startswith("./")
        assert first["href"].endswith("copc.laz")
        assert (tmp_path / "tiles" / first["href"]).is_file()
        views = [each for each in item["assets"].values() if "overview" in each["roles"]]
        assert [each["href"] for each in views] == ["./overview.copc.laz"]
        told = item["properties"]
        assert isinstance(told["pc:count"], int)
        assert isinstance(told["proj:wkt2"], str)
        assert "proj:epsg" not in told, "QGIS would take it for a number of its own"
        low, high = np.array(told["proj:bbox"][:3]), np.array(told["proj:bbox"][3:])
        assert (low <= high).all()
        (ring,) = told["proj:geometry"]["coordinates"]
        assert ring[0] == ring[-1]
        assert {(x, y) for x, y in ring} == {(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])}
        for each in told["pc:schemas"]:
            assert isinstance(each["size"], int)
            assert each["type"] in ("floating", "unsigned", "signed")
        assert all(len(place) >= 2 for place in item["geometry"]["coordinates"][0])


def test_the_overview_is_a_few_points_of_every_tile(tmp_path: Path) -> None:
    source = cloud(tmp_path / "1.laz", count=200_000, rough_m=0.05)
    tiled(tmp_path, str(tmp_path / "1.laz"))
    path = tmp_path / "tiles" / "overview.copc.laz"
    overview = laspy.read(path)
    assert copclib.FileReader(str(path)).ValidateSpatialBounds(False)
    assert set(overview.gps_time) <= set(source.gps_time)
    assert len(overview.points) < len(source.points) / 2
    cells = np.unique(np.floor(source.xyz[:, :2] / 0.5), axis=0)
    assert len(np.unique(np.floor(overview.xyz[:, :2] / 0.5), axis=0)) == len(cells), "half a metre apart, and no hole"


def test_a_folder_with_files_needs_force_and_tiles_of_another_size_replace_those_before(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud(tmp_path / "1.laz")
    folder = tmp_path / "tiles"
    before = set(tiled(tmp_path, str(tmp_path / "1.laz")))
    (folder / "mine.txt").write_text("mine")
    words = ["tile", str(tmp_path / "1.laz"), "-o", str(folder), "--size", "100"]
    assert main(words) == 2
    assert "holds files already" in capsys.readouterr().err
    assert main([*words, "--force"]) == 0
    after = {path.name for path in folder.iterdir()}
    assert "mine.txt" in after
    assert len(after - {"mine.txt", "overview.copc.laz", "cloud.vpc"}) == 2 * 2
    assert not (
        after
        & before
        - {"533000_6472000.copc.laz", "533100_6472000.copc.laz", "533000_6472100.copc.laz", "533100_6472100.copc.laz"}
    )
    assert main(["tile", str(folder / "533000_6472000.copc.laz"), "-o", str(folder), "--force"]) == 2
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize(("size", "told"), [("0", "tiles of 0 m"), ("nan", "tiles of nan m")])
def test_what_is_no_size_is_one_sentence_and_leaves_nothing(
    size: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud(tmp_path / "1.laz", count=100)
    assert main(["tile", str(tmp_path / "1.laz"), "-o", str(tmp_path / "tiles"), "--size", size]) == 2
    assert told in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["1.laz"]


def test_a_cloud_without_a_crs_is_tiled_with_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud(tmp_path / "1.laz", count=1000, crs=False)
    tiled(tmp_path, str(tmp_path / "1.laz"))
    assert "states no CRS" in capsys.readouterr().err


def test_memory_does_not_follow_the_number_of_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of eight times the points, the waiting ones go to the disk."""
    monkeypatch.setattr(reader, "CHUNK", 20_000)
    monkeypatch.setattr("groundproc.cloud.spool._WAITING_BYTES", 1 << 20)
    monkeypatch.setattr("groundproc.cloud.tiling._FINEST_M", 5.0)
    peaks = []
    for count in (60_000, 480_000):
        cloud(tmp_path / "1.laz", count=count)
        tracemalloc.start()
        words = [
            "tile",
            str(tmp_path / "1.laz"),
            "-o",
            str(tmp_path / "tiles"),
            "--size",
            "50",
            "--format",
            "laz",
            "--force",
        ]
        assert main(words) == 0
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 2.0 * peaks[0]
