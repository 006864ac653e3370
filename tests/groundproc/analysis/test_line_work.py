"""`swath profile`, `swath section` and `swath tin` as tables and drawings: surfaces for which the answer is known."""

import csv
import json
import xml.etree.ElementTree as ET
from pathlib import Path

import ezdxf
import laspy
import numpy as np
import pyogrio
import pyproj
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin
from scipy.interpolate import LinearNDInterpolator

from groundproc.cli import main

WEST, NORTH, CELL = 533_000.0, 6_472_100.0, 0.5
LANDXML = "{http://www.landxml.org/schema/LandXML-1.2}"


def plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(100.0 + 0.1 * (x - WEST) - 0.05 * (y - NORTH))


def raster(path: Path, heights: np.ndarray, epsg: int = 32633) -> Path:
    rows, columns = heights.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float32", crs=f"EPSG:{epsg}", nodata=-9999.0,
        transform=from_origin(WEST, NORTH, CELL, CELL),
    ) as file:  # fmt: skip
        file.write(heights.astype(np.float32), 1)
    return path


def centres(side: int) -> tuple[np.ndarray, np.ndarray]:
    j, i = np.mgrid[:side, :side]
    return WEST + (i + 0.5) * CELL, NORTH - (j + 0.5) * CELL


def cloud(path: Path, seed: int = 1) -> tuple[Path, np.ndarray, np.ndarray]:
    """A plane with a scatter of 2 cm, half of it in class 2, and birds in class 18 above."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((0, -100), (100, 0), (60_000, 2)) + np.array([WEST, NORTH])
    z = plane(*xy.T) + rng.normal(0, 0.02, len(xy))
    kind = np.where(rng.random(len(xy)) < 0.5, 2, 1)
    birds = rng.random(len(xy)) < 0.05
    z[birds] += 30.0
    kind[birds] = 18
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [WEST, NORTH, 100.0]
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.xyz = np.column_stack([xy, z])
    las.classification = kind
    las.write(path)
    return path, np.asarray(las.xyz), kind


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_profile_of_a_raster_is_the_plane_it_was_made_of(tmp_path: Path) -> None:
    heights = plane(*centres(400))
    heights[100:140] = -9999.0
    source = raster(tmp_path / "dtm.tif", heights)
    corners = (WEST + 10, NORTH - 10, WEST + 10, NORTH - 190, WEST + 150, NORTH - 190)
    words = [
        "profile",
        str(source),
        "--line",
        ",".join(map(str, corners)),
        "--step",
        "0.3",
        "-o",
        str(tmp_path / "p.csv"),
    ]
    assert main(words) == 0
    found = rows(tmp_path / "p.csv")
    assert len(found) == 320 / 0.3 // 1 + 2
    assert float(found[-1]["along_m"]) == 320.0
    x, y = (np.array([float(row[name]) for row in found]) for name in ("easting", "northing"))
    unknown = np.array([row["height_m"] == "" for row in found])
    down = (NORTH - y) / CELL
    assert unknown[(down > 101) & (down < 139)].all()
    assert not unknown[(down < 99) | (down > 141)].any()
    height = np.array([float(row["height_m"] or "nan") for row in found])
    # single precision, and beside the hole the nearest known cell: half a cell at a slope of 5 %
    assert np.nanmax(np.abs(height - plane(x, y))) < 0.5 * CELL * 0.05 + 1e-3


def test_a_profile_of_a_class_that_no_point_has_says_which_there_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, _, _ = cloud(tmp_path / "c.laz")
    line = f"{WEST + 5},{NORTH - 5},{WEST + 95},{NORTH - 95}"
    words = ["profile", str(path), "--line", line, "--classes", "6,9", "-o", str(tmp_path / "p.csv")]
    assert main(words) == 1
    assert "no point of classes 6, 9 lies within" in (said := capsys.readouterr().err)
    assert "the cloud has classes 1, 2, 18" in said
    assert said.count("\n") == 1


def test_a_profile_of_a_cloud_has_mean_scatter_and_classes(tmp_path: Path) -> None:
    path, xyz, kind = cloud(tmp_path / "c.laz")
    shapes = np.array([shapely.LineString([(WEST + 5, NORTH - 5), (WEST + 95, NORTH - 95)])], object)
    pyogrio.raw.write(
        tmp_path / "l.gpkg", shapely.to_wkb(shapes), [np.array(["ditch"], object)], ["name"],
        geometry_type="LineString", crs="EPSG:32633",
    )  # fmt: skip
    words = ["profile", str(path), "--lines", str(tmp_path / "l.gpkg"), "--step", "1", "--width", "2", "--classes", "2"]
    assert main([*words, "-o", str(tmp_path / "p.csv"), "--picture", str(tmp_path / "p.png")]) == 0
    found = rows(tmp_path / "p.csv")
    assert {row["line"] for row in found} == {"ditch"}
    # a second way to the same: points turned into the line's own axes
    along, across = (
        (xyz[:, 0] - WEST - 5 - xyz[:, 1] + NORTH - 5) / np.sqrt(2),
        (xyz[:, 0] - WEST - 5 + xyz[:, 1] - NORTH + 5) / np.sqrt(2),
    )
    inside = (np.abs(across) <= 1.0) & (along >= 0) & (along <= np.hypot(90, 90)) & (kind == 2)
    assert sum(int(row["points"]) for row in found) == inside.sum()
    middle = found[40]
    own = inside & (np.abs(along - 40.0) < 0.5)
    assert float(middle["height_m"]) == pytest.approx(xyz[own, 2].mean(), abs=1e-3)
    assert float(middle["sigma_m"]) == pytest.approx(xyz[own, 2].std(ddof=1), abs=1e-3)
    assert float(middle["lowest_m"]) == pytest.approx(xyz[own, 2].min(), abs=1e-3)
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_noise_is_no_part_of_a_profile(tmp_path: Path) -> None:
    path, _, _ = cloud(tmp_path / "c.laz")
    line = f"{WEST + 5},{NORTH - 50},{WEST + 95},{NORTH - 50}"
    assert main(["profile", str(path), "--line", line, "-o", str(tmp_path / "p.csv")]) == 0
    highest = [float(row["highest_m"]) for row in rows(tmp_path / "p.csv") if row["highest_m"]]
    assert max(highest) < plane(np.array(WEST + 95), np.array(NORTH - 50)) + 0.2


def test_a_drawing_of_a_profile_has_grid_numbers_and_a_curve_each_source(tmp_path: Path) -> None:
    flat = raster(tmp_path / "dtm.tif", plane(*centres(200)))
    high = raster(tmp_path / "dsm.tif", plane(*centres(200)) + 5.0)
    line = f"{WEST + 10},{NORTH - 50},{WEST + 90},{NORTH - 50}"
    words = ["profile", str(flat), str(high), "--line", line, "--exaggeration", "2", "-o", str(tmp_path / "p.dxf")]
    assert main(words) == 0
    space = ezdxf.readfile(tmp_path / "p.dxf").modelspace()
    low, top = (np.array(space.query(f'LWPOLYLINE[layer=="PROFILE_{n}"]')[0].get_points("xy")) for n in (1, 2))
    assert low[:, 0] == pytest.approx(top[:, 0])
    assert top[:, 1] - low[:, 1] == pytest.approx(2.0 * 5.0, abs=1e-3)
    assert low[-1, 1] - low[0, 1] == pytest.approx(2.0 * 80 * 0.1, abs=1e-3)
    assert len(space.query('TEXT[layer=="PROFILE_TEXT"]')) > 8


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1,2,3", "3 numbers found"),
        (f"{WEST},{NORTH},{WEST},{NORTH}", "0 m long"),
        ("0,0,10,10", "no height is known"),
    ],
)
def test_what_is_no_line_is_said(line: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = raster(tmp_path / "dtm.tif", plane(*centres(50)))
    assert main(["profile", str(source), "--line", line, "-o", str(tmp_path / "p.csv")]) in (1, 2)
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "p.csv").exists()


def test_files_of_two_places_have_no_profile_in_common(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = raster(tmp_path / "a.tif", plane(*centres(50))), raster(tmp_path / "b.tif", plane(*centres(50)), 32632)
    line = f"{WEST},{NORTH},{WEST + 10},{NORTH - 10}"
    assert main(["profile", str(one), str(other), "--line", line, "-o", str(tmp_path / "p.csv")]) in (1, 2)
    assert "expected files in one CRS" in capsys.readouterr().err


def test_a_section_as_table_and_drawing_holds_the_points_of_the_slice(tmp_path: Path) -> None:
    path, xyz, kind = cloud(tmp_path / "c.laz")
    words = ["section", str(path), "--line", f"{WEST + 5},{NORTH - 50},{WEST + 95},{NORTH - 50}", "--width", "1", "-o"]
    assert main([*words, str(tmp_path / "s.csv"), "--picture", str(tmp_path / "s.png")]) == 0
    # noise and what moves are no part of the surface that is cut
    inside = (
        (np.abs(xyz[:, 1] - NORTH + 50) <= 0.5) & (np.abs(xyz[:, 0] - WEST - 50) <= 45) & ~np.isin(kind, (7, 18, 69))
    )
    found = rows(tmp_path / "s.csv")
    assert [float(row["height"]) for row in found] == pytest.approx(xyz[inside, 2], abs=1e-3)
    assert [float(row["left_m"]) for row in found] == pytest.approx(xyz[inside, 1] - NORTH + 50, abs=1e-3)
    assert [int(row["classification"]) for row in found] == kind[inside].tolist()
    assert main([*words, str(tmp_path / "s.dxf")]) == 0
    space = ezdxf.readfile(tmp_path / "s.dxf").modelspace()
    drawn = {(round(p.dxf.location.x, 2), round(p.dxf.location.y, 2), p.dxf.layer) for p in space.query("POINT")}
    expected = zip((xyz[inside, 0] - WEST - 5).round(2), xyz[inside, 2].round(2), kind[inside], strict=True)
    assert len(drawn ^ {(float(x), float(z), f"CLASS_{k}") for x, z, k in expected}) < 0.01 * len(
        drawn
    )  # ties of rounding


def hills(side: int) -> np.ndarray:
    x, y = centres(side)
    return np.asarray(100.0 + 8.0 * np.sin((x - WEST) / 12.0) + 4.0 * np.cos((y - NORTH) / 9.0))


def landxml(path: Path) -> tuple[np.ndarray, np.ndarray]:
    root = ET.parse(path).getroot()
    places = np.array([[float(value) for value in (p.text or "").split()] for p in root.iter(f"{LANDXML}P")])
    faces = np.array([[int(value) for value in (f.text or "").split()] for f in root.iter(f"{LANDXML}F")]) - 1
    return places[:, [1, 0, 2]], faces


def test_triangles_keep_within_the_tolerance_of_all_cells(tmp_path: Path) -> None:
    heights = hills(200)
    heights[80:120, 60:150] = -9999.0
    source = raster(tmp_path / "dtm.tif", heights)
    assert (
        main(
            [
                "tin",
                str(source),
                "--tolerance",
                "0.1",
                "-o",
                str(tmp_path / "t.xml"),
                "--json",
                str(tmp_path / "t.json"),
            ]
        )
        == 0
    )
    places, faces = landxml(tmp_path / "t.xml")
    x, y = centres(200)
    known = heights > 0
    # far fewer than the cells, and by another program's triangulation of the same corners as near as stated
    assert len(places) < 0.1 * known.sum()
    found = LinearNDInterpolator(places[:, :2] - (WEST, NORTH), places[:, 2])(x[known] - WEST, y[known] - NORTH)
    off = np.abs(found - heights[known])
    assert (
        np.nanquantile(off, 0.999) <= 0.1 + 1e-3
    )  # where four corners lie on one circle, there are two triangulations
    assert json.loads((tmp_path / "t.json").read_text())["greatest_difference"] <= 0.1
    corners = places[faces]
    (ux, uy), (vx, vy) = (corners[:, 1, :2] - corners[:, 0, :2]).T, (corners[:, 2, :2] - corners[:, 0, :2]).T
    turn = ux * vy - uy * vx
    assert (turn > 0).all()
    # triangles join the centres of cells: half a cell less on every side, and none over the hole
    rim = 4 * 200 + 2 * (40 + 90)
    assert turn.sum() / 2.0 == pytest.approx((known.sum() - rim / 2) * CELL**2, rel=0.01)


def test_triangles_become_faces_of_a_drawing(tmp_path: Path) -> None:
    source = raster(tmp_path / "dtm.tif", hills(60))
    assert main(["tin", str(source), "--tolerance", "0.5", "-o", str(tmp_path / "t.dxf")]) == 0
    faces = ezdxf.readfile(tmp_path / "t.dxf").modelspace().query("3DFACE")
    assert len(faces) > 10
    assert {round(face.dxf.vtx0.z, 1) > 80.0 for face in faces} == {True}


@pytest.mark.parametrize(
    ("heights", "tolerance", "expected"),
    [(np.full((50, 50), -9999.0), "0.1", "0 known cells"), (hills(50), "0", "more than 0")],
)
def test_a_raster_without_a_surface_is_refused(
    heights: np.ndarray, tolerance: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = raster(tmp_path / "dtm.tif", heights)
    assert main(["tin", str(source), "--tolerance", tolerance, "-o", str(tmp_path / "t.xml")]) in (1, 2)
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "t.xml").exists()
