"""`swath contours`: lines of surfaces for which they are known, read again by GDAL and by a drawing program's library."""

from pathlib import Path

import ezdxf
import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin

from groundproc.cli import main

WEST, NORTH, CELL = 533_000.0, 6_472_100.0, 0.5


def cone(path: Path, hole: bool = False) -> Path:
    """A hill: 110 m less the distance from its middle."""
    j, i = np.mgrid[:200, :200]
    x, y = WEST + (i + 0.5) * CELL, NORTH - (j + 0.5) * CELL
    heights = (110.0 - np.hypot(x - WEST - 50.0, y - NORTH + 50.0)).astype(np.float32)
    if hole:
        heights[:, 90:110] = -9999.0
    with rasterio.open(
        path, "w", driver="GTiff", width=200, height=200, count=1, dtype="float32", crs="EPSG:32633", nodata=-9999.0,
        transform=from_origin(WEST, NORTH, CELL, CELL),
    ) as file:  # fmt: skip
        file.write(heights, 1)
    return path


def lines(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray], str]:
    meta, _, wkb, fields = pyogrio.raw.read(path)
    return shapely.from_wkb(wkb), dict(zip(meta["fields"], fields, strict=True)), meta["crs"]


@pytest.mark.parametrize("name", ["c.gpkg", "c.geojson"])
def test_contours_of_a_cone_are_circles_of_its_height(name: str, tmp_path: Path) -> None:
    assert main(["contours", str(cone(tmp_path / "d.tif")), "--interval", "5", "-o", str(tmp_path / name)]) == 0
    geometry, columns, crs = lines(tmp_path / name)
    assert "32633" in crs
    for line, height in zip(geometry, columns["height_m"], strict=True):
        places = shapely.get_coordinates(line, include_z=True)
        distance = np.hypot(places[:, 0] - WEST - 50.0, places[:, 1] - NORTH + 50.0)
        # between centres of cells the cone is taken as flat: it bends by cell^2 / 8 R, and most near its tip
        assert distance == pytest.approx(110.0 - height, abs=CELL**2 / (8.0 * max(110.0 - height, 1.0)) + 1e-3)
        assert (places[:, 2] == height).all()
    index = columns["height_m"][columns["index"].astype(bool)]
    assert set(index) <= {50.0, 75.0, 100.0}
    assert len(index)


def test_heights_are_numbers_as_people_write_them(tmp_path: Path) -> None:
    """Three times 0.3 is 0.8999999999999999 in double precision, and would be a label of that length."""
    main(["contours", str(cone(tmp_path / "d.tif")), "--interval", "0.3", "-o", str(tmp_path / "c.gpkg")])
    for height in lines(tmp_path / "c.gpkg")[1]["height_m"].tolist():
        assert height == float(f"{height:.1f}")


@pytest.mark.parametrize("none", [-9999.0, -32768.0])
@pytest.mark.parametrize("command", ["contours", "tin", "profile"])
def test_a_raster_that_does_not_say_what_stands_for_none_is_refused(
    command: str, none: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with rasterio.open(cone(tmp_path / "d.tif", hole=True)) as file:
        heights, profile = file.read(1), file.profile
    profile["nodata"] = None
    with rasterio.open(tmp_path / "d.tif", "w", **profile) as file:
        file.write(np.where(heights == -9999.0, np.float32(none), heights), 1)
    words = {
        "contours": ["-o", "c.gpkg"], "tin": ["-o", "t.xml"],
        "profile": ["--line", f"{WEST + 1},{NORTH - 50},{WEST + 99},{NORTH - 50}", "-o", "p.csv"],
    }[command]  # fmt: skip
    words[-1] = str(tmp_path / words[-1])
    assert main([command, str(tmp_path / "d.tif"), *words]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"gdal_translate -a_nodata {none:g}" in said
    assert [each.name for each in tmp_path.iterdir()] == ["d.tif"]


@pytest.mark.parametrize(("columns", "rows"), [(1, 1), (1, 50), (50, 1)])
def test_one_row_of_cells_has_no_contour(
    columns: int, rows: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with rasterio.open(
        tmp_path / "d.tif", "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float32", crs="EPSG:32633",
        transform=from_origin(WEST, NORTH, CELL, CELL),
    ) as file:  # fmt: skip
        file.write(np.linspace(1.0, 9.0, columns * rows).astype(np.float32).reshape(rows, columns), 1)
    assert main(["contours", str(tmp_path / "d.tif"), "-o", str(tmp_path / "c.gpkg")]) == 1
    assert capsys.readouterr().err == (
        f"swath: {tmp_path / 'd.tif'}: {columns} x {rows} cells, expected two or more each way: lines run between their centres\n"
    )


def test_a_drawing_has_heights_layers_and_labels(tmp_path: Path) -> None:
    main(["contours", str(cone(tmp_path / "d.tif")), "--interval", "5", "-o", str(tmp_path / "c.dxf")])
    space = ezdxf.readfile(tmp_path / "c.dxf").modelspace()
    polylines = space.query("LWPOLYLINE")
    assert {each.dxf.elevation for each in polylines} >= {65.0, 75.0, 100.0, 105.0}
    assert {each.dxf.layer for each in polylines} == {"CONTOUR", "CONTOUR_INDEX"}
    labels = {each.dxf.text for each in space.query("TEXT")}
    assert {"75", "100"} <= labels <= {"50", "75", "100"}


def test_no_line_crosses_what_is_not_known(tmp_path: Path) -> None:
    main(["contours", str(cone(tmp_path / "d.tif", hole=True)), "--interval", "5", "-o", str(tmp_path / "c.gpkg")])
    places = shapely.get_coordinates(lines(tmp_path / "c.gpkg")[0])
    assert not ((places[:, 0] > WEST + 45.0) & (places[:, 0] < WEST + 55.0)).any()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["d.tif", "-o", "c.shp"], "ends in .shp"),
        (["d.tif", "--interval", "0", "-o", "c.gpkg"], "interval 0 m"),
        (["d.tif", "--interval", "1e-6", "-o", "c.gpkg"], "levels"),
        (["d.tif", "--interval", "1000", "-o", "c.gpkg"], "no contour"),
        (["none.tif", "-o", "c.gpkg"], "none.tif"),
        (["d.tif", "-o", "there.dxf"], "--force to write over"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cone(tmp_path / "d.tif")
    (tmp_path / "there.dxf").write_text("mine")
    before = sorted(tmp_path.iterdir())
    assert main(["contours", *words]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
