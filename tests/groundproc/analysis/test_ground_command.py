"""`swath ground` on a place of known truth."""

import json
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import pyproj
import pytest
import rasterio
import shapely

from groundproc.analysis.terrain.sparse import SPARSE_M2, cell_for, density_of
from groundproc.cli import main
from groundproc.cloud.classes import OF_USES
from simulator import outdoors

ORIGIN = np.array([533_000.0, 6_472_000.0])


def write_cloud(
    path: Path, xyz: np.ndarray, epsg: int | None = 32633, version: str = "1.4", point_format: int = 6
) -> Path:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, [*ORIGIN, 0.0]
    if epsg is not None:
        header.add_crs(pyproj.CRS.from_epsg(epsg))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz[:, 0] + ORIGIN[0], xyz[:, 1] + ORIGIN[1], xyz[:, 2]
    las.intensity = np.arange(len(xyz)) % 200
    las.write(path)
    return path


@pytest.fixture(scope="module")
def place() -> outdoors.Place:
    return outdoors.village(seed=0, side_m=90.0, per_m2=12.0)


@pytest.fixture(scope="module")
def made(place: outdoors.Place, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the command makes of the village."""
    folder = tmp_path_factory.mktemp("ground")
    write_cloud(folder / "c.laz", place.xyz)
    words = ["ground", str(folder / "c.laz"), "-o", str(folder / "out.laz"), "--json", str(folder / "figures.json")]
    for option, name in (
        ("dtm", "dtm.tif"),
        ("confidence", "sigma.tif"),
        ("chm", "chm.tif"),
        ("buildings", "b.geojson"),
    ):
        words += [f"--{option}", str(folder / name)]
    assert main(words) == 0
    return folder


def test_every_point_comes_out_in_order_with_its_height_above_the_ground(place: outdoors.Place, made: Path) -> None:
    before, after = laspy.read(made / "c.laz"), laspy.read(made / "out.laz")
    assert np.array_equal(before.points.array["X"], after.points.array["X"])
    assert np.array_equal(before.points.array["Z"], after.points.array["Z"])
    assert np.array_equal(before.intensity, after.intensity)
    truth = place.xyz[:, 2] - place.ground(place.xyz[:, :2])
    bare = place.kind == outdoors.GROUND
    assert np.sqrt(np.mean((after.hag - truth)[bare] ** 2)) < 0.05
    assert "m" in after.point_format.dimension_by_name("hag").description


def test_ground_roofs_trees_and_stray_points_have_their_classes(place: outdoors.Place, made: Path) -> None:
    kind = np.asarray(laspy.read(made / "out.laz").classification)
    truth = place.xyz[:, 2] - place.ground(place.xyz[:, :2])
    assert np.mean(kind[place.kind == outdoors.GROUND] == 2) > 0.995
    assert np.mean(kind[place.kind == outdoors.ROOF] == 6) > 0.85
    tall = (place.kind == outdoors.TREE) & (truth > 3.0)
    assert np.mean(kind[tall] == 5) > 0.97
    assert np.mean(np.isin(kind[place.kind == outdoors.NOISE], (7, 18))) > 0.9
    real = place.kind != outdoors.NOISE
    assert np.mean(np.isin(kind[real], (7, 18))) < 1e-4


def test_the_terrain_model_is_as_good_as_it_says(place: outdoors.Place, made: Path) -> None:
    figures = json.loads((made / "figures.json").read_text())
    with rasterio.open(made / "dtm.tif") as dtm, rasterio.open(made / "sigma.tif") as sigma:
        assert dtm.crs.to_epsg() == 32633
        z, s = dtm.read(1, masked=True).filled(np.nan), sigma.read(1, masked=True).filled(np.nan)
        j, i = np.mgrid[: dtm.height, : dtm.width]
        x, y = dtm.bounds.left + (i + 0.5) * dtm.res[0], dtm.bounds.top - (j + 0.5) * dtm.res[1]
    truth = place.ground(np.column_stack([x.ravel(), y.ravel()]) - ORIGIN).reshape(z.shape)
    houses = shapely.union_all([shapely.Polygon(each.corners() + ORIGIN).buffer(1.5) for each in place.houses])
    open_ground = np.isfinite(z) & ~shapely.contains_xy(houses, x, y)
    error = (z - truth)[open_ground]
    # what was left out is met about as well as the truth is
    assert np.sqrt(np.mean(error**2)) == pytest.approx(figures["holdout_rmse_m"], rel=0.5)
    assert np.mean(np.abs(error) <= 2.0 * s[open_ground]) > 0.9


def test_outlines_of_buildings_overlap_with_the_houses(place: outdoors.Place, made: Path) -> None:
    meta, _, wkb, _ = pyogrio.raw.read(made / "b.geojson")
    found = shapely.from_wkb(wkb)
    assert meta["crs"] == "EPSG:32633"
    overlap = []
    for house in place.houses:
        truth = shapely.Polygon(house.corners() + ORIGIN)
        overlap.append(max(each.intersection(truth).area / each.union(truth).area for each in found))
    assert len(found) == len(place.houses)
    assert np.mean(overlap) >= 0.8


def test_the_canopy_has_the_heights_of_the_trees_and_no_holes_in_them(place: outdoors.Place, made: Path) -> None:
    with rasterio.open(made / "chm.tif") as file:
        chm, holes = file.read(1, masked=True).filled(np.nan), 0
        for tree in place.trees:
            row, column = file.index(tree.x + ORIGIN[0], tree.y + ORIGIN[1])
            top = chm[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
            assert np.nanmax(top) == pytest.approx(tree.height_m, abs=0.8)
            holes += int(np.nanmin(top) < 0.3 * tree.height_m)
        assert holes <= 2  # beside the smallest crowns


def test_water_is_level_within_its_breakline(place: outdoors.Place, tmp_path: Path) -> None:
    cloud = write_cloud(tmp_path / "c.laz", place.xyz)
    pond = shapely.box(30, 20, 45, 32)
    pyogrio.raw.write(
        tmp_path / "w.gpkg", shapely.to_wkb(np.array([shapely.transform(pond, lambda xy: xy + ORIGIN)], object)), [], [],
        geometry_type="Polygon", crs="EPSG:32633", driver="GPKG",
    )  # fmt: skip
    words = [
        str(cloud),
        "-o",
        str(tmp_path / "o.laz"),
        "--dtm",
        str(tmp_path / "d.tif"),
        "--water",
        str(tmp_path / "w.gpkg"),
    ]
    assert main(["ground", *words]) == 0
    with rasterio.open(tmp_path / "d.tif") as file:
        window = file.window(*(np.array([31, 21, 44, 31]) + np.tile(ORIGIN, 2)))
        assert np.ptp(file.read(1, window=window)) == 0.0


def test_an_old_cloud_in_feet_has_heights_in_metres(place: outdoors.Place, tmp_path: Path) -> None:
    foot = 0.3048006096012192
    cloud = write_cloud(tmp_path / "c.las", place.xyz / foot, 2229, "1.2", 1)
    words = [
        str(cloud),
        "-o",
        str(tmp_path / "o.las"),
        "--json",
        str(tmp_path / "f.json"),
        "--dtm",
        str(tmp_path / "d.tif"),
    ]
    assert main(["ground", *words]) == 0
    hag = laspy.read(tmp_path / "o.las").hag
    truth = place.xyz[:, 2] - place.ground(place.xyz[:, :2])
    assert np.sqrt(np.mean((hag - truth)[place.kind == outdoors.GROUND] ** 2)) < 0.06
    with rasterio.open(tmp_path / "d.tif") as file:
        assert file.res[0] == pytest.approx(json.loads((tmp_path / "f.json").read_text())["cell_m"] / foot)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--terrain", "mars"], "--terrain mars: expected auto"),
        (["--cell", "0"], "cell 0 m"),
        (["--window", "nan"], "--window nan"),
        (["--dtm", "d.png"], "expected a name that ends in .tif"),
    ],
)
def test_what_is_not_possible_is_one_sentence(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_cloud(tmp_path / "c.laz", np.random.default_rng(0).uniform(0, 5, (200, 3)))
    assert main(["ground", "c.laz", "-o", "o.laz", *words]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not (tmp_path / "o.laz").exists()


def test_a_cloud_in_degrees_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = write_cloud(tmp_path / "c.laz", np.random.default_rng(0).uniform(0, 5, (200, 3)), 4326)
    assert main(["ground", str(cloud), "-o", str(tmp_path / "o.laz")]) != 0
    assert "degrees; expected a projected CRS" in capsys.readouterr().err


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_handful_of_points_is_a_cloud_too(count: int, tmp_path: Path) -> None:
    cloud = write_cloud(tmp_path / "c.laz", np.random.default_rng(0).uniform(0, 3, (count, 3)))
    words = [
        str(cloud),
        "-o",
        str(tmp_path / "o.laz"),
        "--dtm",
        str(tmp_path / "d.tif"),
        "--chm",
        str(tmp_path / "h.tif"),
    ]
    assert main(["ground", *words]) == 0
    assert len(laspy.read(tmp_path / "o.laz")) == count


def test_what_other_uses_classed_survives(tmp_path: Path) -> None:
    place = outdoors.village(seed=1, side_m=40.0, per_m2=6.0)
    cloud = write_cloud(tmp_path / "c.laz", place.xyz)
    las = laspy.read(cloud)
    given = np.where(np.arange(len(las.points)) % 10 < len(OF_USES), np.resize([*OF_USES, 1], len(las.points)), 1)
    las.classification = given.astype(np.uint8)
    las.write(cloud)
    assert main(["ground", str(cloud), "-o", str(tmp_path / "o.laz"), "--json", str(tmp_path / "f.json")]) == 0
    after = np.asarray(laspy.read(tmp_path / "o.laz").classification)
    ours = np.isin(given, OF_USES)
    assert np.array_equal(after[ours], given[ours])
    assert np.isin(after[~ours], (2, 3, 4, 5, 6, 7, 9, 18)).all()
    figures = json.loads((tmp_path / "f.json").read_text())
    assert sum(figures["classes"].values()) == figures["points"] == len(after)


def test_a_cloud_of_a_point_in_hundreds_of_square_metres_has_cells_to_match(tmp_path: Path) -> None:
    """Else the raster is of its bounds, whatever lies in it: this took minutes."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 1500.0, (6280, 2))
    cloud = write_cloud(tmp_path / "c.laz", np.column_stack([xy, 20.0 * np.sin(xy[:, 0] / 200.0)]))
    words = ["ground", str(cloud), "-o", str(tmp_path / "o.laz"), "--json", str(tmp_path / "f.json")]
    assert main(words) == 0
    assert json.loads((tmp_path / "f.json").read_text())["cell_m"] == 4.0
    assert np.mean(np.asarray(laspy.read(tmp_path / "o.laz").classification) == 2) > 0.95


@pytest.mark.parametrize("words", [("detect", "o.geojson"), ("trees", "o.geojson"), ("passability", "o")])
def test_what_needs_small_cells_refuses_such_a_cloud(
    words: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    xy = np.random.default_rng(0).uniform(0, 40_000.0, (500, 2))
    cloud = write_cloud(tmp_path / "c.laz", np.column_stack([xy, np.zeros(500)]))
    assert main([words[0], str(cloud), "-o", str(tmp_path / words[1])]) == 1
    assert "points on a square metre, expected 0.0125 or more to look for" in capsys.readouterr().err
    assert not (tmp_path / words[1]).exists()


def test_cells_go_by_the_squares_that_have_points() -> None:
    along = np.linspace(0.0, 40_000.0, 50_000)
    corridor = np.column_stack([along, 0.6 * along + 7.0, np.zeros_like(along)])  # through no corner of squares
    assert len(along) / np.ptp(corridor[:, 0]) / np.ptp(corridor[:, 1]) < 1e-4
    assert density_of([corridor[:30_000], corridor[30_000:]]) == pytest.approx(50_000 / (313 + 187) / 128**2, rel=0.02)
    assert cell_for(SPARSE_M2, 20.0) == 2.0
    assert [cell_for(each, 20.0) for each in (10.0, 0.013, 0.003, 1e-9)] == [1.0, 1.0, 4.0, 16.0]
    assert cell_for(1e-9, 5.0) == 4.0
