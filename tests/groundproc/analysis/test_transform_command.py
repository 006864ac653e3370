"""`swath transform`: national heights by a grid, epochs, site coordinates, ground distances, feet; and what is refused."""

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

from groundproc.analysis import sitecalibration
from groundproc.cli import main

Array = npt.NDArray[np.float64]

ABOVE_M = 31.5
PLACES = np.array([[653_000.0, 6_580_000.0, 60.0], [653_040.0, 6_580_010.0, 61.0], [653_010.0, 6_580_050.0, 62.5]])


def written(path: Path, xyz: Array, crs: str | None) -> Path:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = [0.001] * 3 if np.abs(xyz[:, 1]).max() > 90.0 else [1e-9, 1e-9, 1e-3]
    header.offsets = np.floor(xyz.min(axis=0))
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.intensity = np.arange(len(xyz)).astype(np.uint16)
    las.write(path)
    return path


def read(path: Path) -> tuple[Array, laspy.LasData]:
    las = laspy.read(path)
    return np.asarray(las.xyz), las


def geoid(folder: Path) -> Path:
    """Sweden's grid with one height everywhere."""
    folder.mkdir()
    profile = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    place = from_origin(10.0, 70.0, 0.4, 0.4)
    with rasterio.open(folder / "se_lantmateriet_SWEN17_RH2000.tif", "w", transform=place, **profile) as out:
        out.write(np.full((40, 40), ABOVE_M, np.float32), 1)
        out.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", target_crs_epsg_code="5613")
    return folder


def done(cloud: Path, *words: str | Path) -> tuple[Array, dict[str, Any]]:
    out = cloud.parent / "out.laz"
    told = cloud.parent / "told.json"
    assert main(["transform", str(cloud), *map(str, words), "-o", str(out), "--json", str(told), "--force"]) == 0
    return read(out)[0], json.loads(told.read_text())


def test_national_heights_are_those_of_the_grid(tmp_path: Path) -> None:
    """ETRS89 (SWEREF 99) above the ellipsoid to RH 2000: less the geoid's height."""
    cloud = written(tmp_path / "c.laz", PLACES, None)
    found, told = done(cloud, "--from", "3006+ellipsoid", "--crs", "3006+5613", "--grids", geoid(tmp_path / "grids"))
    assert found == pytest.approx(PLACES - np.array([0.0, 0.0, ABOVE_M]), abs=1e-3)
    assert told["grids"] == ["se_lantmateriet_SWEN17_RH2000.tif"]
    las = read(tmp_path / "out.laz")[1]
    crs = las.header.parse_crs()
    assert crs is not None
    assert "RH2000" in crs.name
    # whatever else a point has stays
    assert list(las.intensity) == [0, 1, 2]


def test_an_epoch_moves_coordinates_with_the_plate(tmp_path: Path) -> None:
    """Boston in ITRF2014: NAD83(2011) stays with the plate, which goes some 16 mm a year to the west-north-west."""
    cloud = written(tmp_path / "c.laz", np.array([[-71.05, 42.35, 10.0], [-71.06, 42.36, 12.0]]), "EPSG:7912")
    early, _ = done(cloud, "--crs", "6348+ellipsoid", "--epoch", "2010")
    late, told = done(cloud, "--crs", "6348+ellipsoid", "--epoch", "2020")
    assert told["epoch"] == 2020.0
    gone = np.hypot(*(late - early)[:, :2].T)
    assert gone == pytest.approx(0.16, abs=0.04)
    # the same place in UTM of that frame comes to the same
    utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32619", always_xy=True).transform(-71.05, 42.35)
    flat = written(tmp_path / "u.laz", np.array([[*utm, 10.0]]), None)
    other, _ = done(flat, "--from", "32619@9000+ellipsoid", "--crs", "6348+ellipsoid", "--epoch", "2020")
    assert other[0] == pytest.approx(late[0], abs=2e-3)


def test_heights_that_would_stay_in_feet_are_named_with_the_way_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """New York's plane in feet (2263) with heights in feet (6360): 328.0833 ft are 100 m."""
    place = np.array([[1_312_400.0, 656_200.0, 100.0 * 3937 / 1200]])
    cloud = written(tmp_path / "a.las", place, "EPSG:2263+6360")
    assert main(["transform", str(cloud), "--crs", "26918", "-o", str(tmp_path / "b.laz")]) == 2
    assert "--feet too if that is meant, or say heights in metres after a +" in capsys.readouterr().err
    assert not (tmp_path / "b.laz").exists()
    moved, told = done(cloud, "--crs", "26918+5703")
    assert told["unit"] == "metre"
    assert moved[0, 2] == pytest.approx(100.0, abs=1e-3)


def test_feet_come_only_when_asked_for_and_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = written(tmp_path / "c.laz", np.array([[500_000.0, 4_510_000.0, 10.0]]), "EPSG:6347+5703")
    words = ["transform", str(cloud), "--crs", "6539+6360", "-o", str(tmp_path / "f.laz")]
    assert main(words) == 2
    assert "--feet" in capsys.readouterr().err
    assert main([*words, "--feet"]) == 0
    assert "unit: US survey foot" in capsys.readouterr().out
    assert read(tmp_path / "f.laz")[0][0, 2] == pytest.approx(10.0 * 3937.0 / 1200.0, abs=2e-3)


def test_site_coordinates_are_those_of_the_control_with_residuals(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    map_m = PLACES[0] + rng.uniform(-100, 100, (6, 3)) * (1.0, 1.0, 0.02)
    turn, scale = np.deg2rad(12.0), 1.0 + 40e-6
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    off = map_m - PLACES[0]
    true = np.column_stack([c * off[:, 0] - s * off[:, 1], s * off[:, 0] + c * off[:, 1], off[:, 2] + 1e-4 * off[:, 0]])
    site_m = true + np.array([1000.0, 2000.0, 100.0]) + rng.normal(0, 0.003, true.shape)
    site_m[4, 0] += 0.1  # a blunder of 10 cm
    lines = [",".join(map(str, (f"p{n}", *map_m[n], *site_m[n]))) for n in range(6)]
    (tmp_path / "s.csv").write_text("\n".join(["id,x,y,z,e,n,h", *lines]) + "\n")
    cloud = written(tmp_path / "c.laz", map_m, "EPSG:3006+5613")
    found, told = done(cloud, "--site", tmp_path / "s.csv")
    assert told["to"] is None
    assert found == pytest.approx(site_m, abs=0.12)
    worst = max(told["site"]["points"], key=lambda each: abs(each["left_out_m"][0]))
    assert worst["id"] == "p4"
    assert worst["left_out_m"][0] == pytest.approx(0.1, abs=0.03)
    good = np.arange(6) != 4
    fit = sitecalibration.calibrated(map_m[good], site_m[good])
    # 3 mm over 100 m: 0.03 mrad, 30 ppm
    assert np.rad2deg(fit.turn_rad) == pytest.approx(12.0, abs=0.005)
    assert fit.scale == pytest.approx(scale, abs=6e-5)
    assert np.sqrt(np.mean(fit.residual_m**2)) < 0.006


def test_ground_distances_are_longer_by_the_combined_factor(tmp_path: Path) -> None:
    """At the middle of a UTM zone, at 1500 m: 0.9996 less 235 ppm."""
    places = np.array([[500_000.0, 5_000_000.0, 1500.0], [500_100.0, 5_000_000.0, 1500.0]])
    cloud = written(tmp_path / "c.laz", places, "EPSG:32633+5773")
    found, told = done(cloud, "--ground")
    assert told["ground"]["combined_factor"] == pytest.approx(0.9996 * (1 - 1500.0 / 6_372_500.0), abs=2e-6)
    assert found[1, 0] - found[0, 0] == pytest.approx(100.0 / told["ground"]["combined_factor"], abs=1.5e-3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--crs", "3006+5613"], "does not say what its heights refer to"),
        (["--from", "25832+ellipsoid", "--crs", "25832+7837"], "proj-data"),
        (["--from", "3006+ellipsoid", "--crs", "3006", "--epoch", "2020"], "knows no epoch"),
        (["--from", "7912", "--crs", "6348+ellipsoid"], "--epoch"),
        (["--from", "4326@9990", "--crs", "6348"], "expected a projected CRS"),
        (["--crs", "nowhere"], "expected EPSG codes"),
        (["--crs", "999999"], "no such"),
        (["--ground", "--crs", "3006"], "expected one of"),
        (["--site", "two.csv"], "2 points, expected 3"),
        (["--crs", "3006", "--epoch", "12"], "expected a year"),
    ],
)
def test_what_cannot_be_done_well_is_refused_in_one_sentence(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "c.laz", PLACES, "EPSG:3006")
    (tmp_path / "two.csv").write_text("id,x,y,z,e,n,h\na,0,0,0,0,0,0\nb,1,0,0,1,0,0\n")
    assert main(["transform", "c.laz", *words, "-o", "o.laz"]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not (tmp_path / "o.laz").exists()
