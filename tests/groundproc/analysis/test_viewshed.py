"""What is seen from a place: as a dense walk along every line says, and on the grid of the surface."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
import pytest
import rasterio
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter

from groundproc.analysis.viewshed import EXACT, FAST, HIDDEN, UNKNOWN, VISIBLE, Sight, bend_per_m, height_at, viewshed
from groundproc.cli import main

Array = npt.NDArray[np.float64]


def surface(rng: np.random.Generator, shape: tuple[int, int], kind: int) -> Array:
    white = rng.standard_normal(shape)
    if kind == 0:
        return np.asarray(3.0 * white)
    if kind == 1:
        return np.asarray(20.0 * gaussian_filter(white, 2))
    return np.asarray(200.0 * gaussian_filter(white, 8) + 5.0 * gaussian_filter(rng.standard_normal(shape), 2))


def walked(z: Array, sight: Sight, steps: int = 3000) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Least height of each line over the surface by dense steps, and where a step more could decide otherwise."""
    rows, columns = z.shape
    eye = height_at(z, sight.column, sight.row) + sight.above_m
    s = np.linspace(0, 1, steps + 1)
    least = np.empty(z.shape)
    for j in range(rows):
        u = np.clip(sight.column + np.outer(np.arange(columns) - sight.column, s), 0, columns - 1)
        v = np.clip(np.broadcast_to(sight.row + (j - sight.row) * s, u.shape), 0, rows - 1)
        i0, j0 = np.minimum(u.astype(int), columns - 2), np.minimum(v.astype(int), rows - 2)
        p, q = u - i0, v - j0
        ground = (1 - q) * ((1 - p) * z[j0, i0] + p * z[j0, i0 + 1]) + q * (
            (1 - p) * z[j0 + 1, i0] + p * z[j0 + 1, i0 + 1]
        )
        line = eye + s * (z[j][:, None] + sight.target_m - eye)
        least[j] = (line - ground).min(axis=1)
    return least, np.abs(least) < 5e-4


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_exact_is_what_a_dense_walk_along_every_line_finds(kind: int) -> None:
    rng = np.random.default_rng(kind)
    for case in range(4):
        shape = (int(rng.integers(8, 26)), int(rng.integers(8, 26)))
        z = surface(rng, shape, kind)
        place = rng.uniform(0, 1, 2) * (shape[1] - 1, shape[0] - 1)
        place = np.rint(place) if case % 2 else place
        sight = Sight(*place, rng.uniform(0, 3), (0.0, 1.5)[case % 2], 0.0, 1.0)
        least, unsure = walked(z, sight)
        found = viewshed(z, sight, EXACT)
        assert ((found == VISIBLE) == (least >= -1e-9))[~unsure].all()


def test_fast_is_right_nearly_everywhere() -> None:
    rng = np.random.default_rng(7)
    same = []
    for kind in (1, 1, 2, 2):
        z = surface(rng, (300, 400), kind)
        sight = Sight(*(rng.uniform(0, 1, 2) * (399, 299)), 2.0, 0.0, 0.0, 1.0)
        same.append(np.mean(viewshed(z, sight, FAST) == viewshed(z, sight, EXACT)))
    assert min(same) > 0.99
    assert np.mean(same) > 0.995  # what is promised


@pytest.mark.parametrize("mode", [EXACT, FAST])
def test_a_line_that_crosses_nodata_tells_nothing(mode: str) -> None:
    z = np.zeros((301, 311))
    z[10, 15] = np.nan
    found = viewshed(z, Sight(5.0, 10.0, 2.0, 0.0, 0.0, 1.0), mode)
    assert (found[10, 15:] == UNKNOWN).all()
    assert (found[10, :15] == VISIBLE).all()
    assert (found[:8, :15] == VISIBLE).all()
    assert not (found == HIDDEN).any()


def test_a_round_earth_hides_what_is_far() -> None:
    z = np.zeros((3, 400))
    # horizon of 2 m: sqrt(2 x 2 m x R / (1 - 0.13)) = 5.4 km
    found = viewshed(z, Sight(0.0, 1.0, 2.0, 0.0, bend_per_m(True), 50.0), EXACT)
    seen = np.flatnonzero(found[1] == VISIBLE).max() * 50.0
    assert abs(seen - np.sqrt(2 * 2 * 6_371_000 / 0.87)) < 100.0


def raster(path: Path, z: Array, cell_m: float = 2.0) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", width=z.shape[1], height=z.shape[0], count=1, dtype="float32", nodata=-9999.0,
        crs="EPSG:32633", transform=from_origin(500_001.3, 6_000_000.7, cell_m, cell_m),
    ) as file:  # fmt: skip
        file.write(np.where(np.isfinite(z), z, -9999.0).astype(np.float32), 1)
    return path


def test_the_command_writes_the_same_grid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    z = surface(np.random.default_rng(3), (40, 60), 1)
    z[5, 50] = np.nan
    dsm = raster(tmp_path / "dsm.tif", z)
    at = (500_001.3 + 20.25 * 2, 6_000_000.7 - 30.75 * 2)
    words = ["viewshed", str(dsm), "--at", f"{at[0]},{at[1]}", "--height", "1.7", "-o", str(tmp_path / "o.tif")]
    assert main([*words, "--target-height", "0.5", "--json", str(tmp_path / "o.json")]) == 0
    with rasterio.open(tmp_path / "o.tif") as out, rasterio.open(dsm) as given:
        assert out.transform == given.transform
        assert (out.width, out.height, out.crs) == (given.width, given.height, given.crs)
        found = out.read(1, masked=True)
        heights = given.read(1, masked=True).filled(np.nan)
    expected = viewshed(heights, Sight(19.75, 30.25, 1.7, 0.5, 0.0, 2.0))
    assert (found.filled(UNKNOWN) == expected).all()
    assert found.mask[5, 50]
    assert json.loads((tmp_path / "o.json").read_text())["visible_cells"] == int((expected == VISIBLE).sum())
    assert main([*words, "--force", "--reverse"]) == 0
    back = rasterio.open(tmp_path / "o.tif").read(1)
    assert (back == viewshed(heights, Sight(19.75, 30.25, 0.0, 1.7, 0.0, 2.0))).all()
    capsys.readouterr()
    assert main(["viewshed", str(dsm), "--at", "0,0", "--height", "1", "-o", str(tmp_path / "p.tif")]) == 1
    assert "no height there" in capsys.readouterr().err
    assert main(["viewshed", str(dsm), "--at", "here", "--height", "1", "-o", str(tmp_path / "p.tif")]) == 2


def test_a_surface_full_of_gaps_is_said_to_tell_little(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    z = np.zeros((40, 40), np.float64)
    for count, told in ((20, False), (400, True)):
        some = np.random.default_rng(1).choice(z.size, count, replace=False)
        some = some[some != 20 * 40 + 20]
        gappy = z.copy()
        gappy.flat[some] = np.nan
        source = raster(tmp_path / f"{count}.tif", gappy)
        with rasterio.open(source) as file:
            east, north = file.xy(20, 20)
        assert (
            main(
                [
                    "viewshed",
                    str(source),
                    "--at",
                    f"{east},{north}",
                    "--height",
                    "2",
                    "-o",
                    str(tmp_path / f"v{count}.tif"),
                ]
            )
            == 0
        )
        assert ("give the cloud itself" in capsys.readouterr().err) == told


def cloud(path: Path, xyz: Array, **columns: Any) -> Path:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [500_000.0, 6_000_000.0, 0.0]
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.xyz = xyz + np.array([500_000.0, 6_000_000.0, 0.0])
    las.return_number = las.number_of_returns = np.ones(len(xyz), np.uint8)
    for name, values in columns.items():
        las[name] = values
    las.write(path)
    return path


def test_nothing_is_known_of_a_line_below_a_roof_that_beams_came_down_on(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 30, (60_000, 2))
    house = (np.abs(xy - 15.0) < 5.0).all(axis=1)
    path = cloud(tmp_path / "a.laz", np.column_stack([xy, np.where(house, 6.1, 0.1)]))
    words = ["viewshed", str(path), "--at", "500005.2,6000015.2", "--height", "1.7", "--target-height", "1.7"]
    assert main([*words, "--mode", "voxels", "-o", str(tmp_path / "t.tif")]) == 0
    with rasterio.open(tmp_path / "t.tif") as out:
        value = out.read(1, masked=True).filled(np.nan)
        behind, beside = (value[out.index(*at)] for at in ((500_025.2, 6_000_015.2), (500_012.2, 6_000_027.2)))
    assert np.isnan(behind)
    assert beside == pytest.approx(1.0)


def test_leaves_let_through_what_beams_say(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    ground = rng.uniform(0, 40, (300_000, 2))
    # a hedge of 4 m between 18 and 22 m east: of the beams from above that enter a voxel, a tenth ends there
    inside = (ground[:, 0] > 18) & (ground[:, 0] < 22)
    z = np.zeros(len(ground))
    depth = rng.geometric(0.1, len(ground)) - 1
    met = inside & (depth < 8)
    z[met] = 4.0 - 0.5 * depth[met] - 0.25
    path = cloud(tmp_path / "a.laz", np.column_stack([ground, z]))
    words = [
        "viewshed",
        str(path),
        "--at",
        "500010.2,6000020.2",
        "--height",
        "1.7",
        "--target-height",
        "1.7",
        "--mode",
        "voxels",
    ]
    assert main([*words, "-o", str(tmp_path / "t.tif")]) == 0
    with rasterio.open(tmp_path / "t.tif") as out:
        value = out.read(1, masked=True).filled(np.nan)
        row, column = out.index(500_030.2, 6_000_020.2)
    # eight voxels of 0.9 each; half of the hits of a layer end what enters it
    assert np.nanmedian(value[:, :30]) == pytest.approx(1.0)
    assert abs(np.nanmean(value[row - 3 : row + 4, column - 4 : column + 4]) - 0.9**8) < 0.06
