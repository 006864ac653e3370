"""`swath drape` of rasters whose every cell is known."""

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from rasterio.warp import Resampling, calculate_default_transform, reproject

from groundproc.analysis.spectra import Library, wavelengths
from groundproc.cli import main
from tests.groundproc.analysis.test_ground_command import ORIGIN, write_cloud

SIDE = 40
"""Metres, and cells of the raster."""
NM = np.linspace(450.0, 950.0, 26)
SPECTRA = {
    "grass": 0.05 + 0.45 / (1 + np.exp(-(NM - 710) / 12)) + 0.04 * np.exp(-(((NM - 550) / 30) ** 2)),
    "soil": 0.12 + 0.25 * (NM - 450) / 500,
    "roof": 0.25 + 0.15 / (1 + np.exp(-(NM - 580) / 15)),
}


def material(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """0 grass, 1 soil in the east, 2 the roof of a house in the middle."""
    house = (np.abs(x - 20) < 5) & (np.abs(y - 20) < 5)
    return np.where(house, 2, np.where(x > 30, 1, 0))


def temperature(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 15.0 + 0.1 * x + 0.05 * y


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A cloud with a house that was also seen from below its roof, a thermal and a spectral raster."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(0.7, SIDE - 0.7, (40_000, 2))
    roof = material(*xy.T) == 2
    under = roof & (rng.random(len(xy)) < 0.3)
    z = np.where(roof & ~under, 5.0, 0.0)
    xyz = np.column_stack([xy, z])
    folder = tmp_path_factory.mktemp("drape")
    write_cloud(folder / "c.laz", xyz)
    at = np.arange(SIDE) + 0.5
    x, y = np.meshgrid(at, at[::-1])
    profile = {
        "driver": "GTiff", "width": SIDE, "height": SIDE, "dtype": "float32", "crs": "EPSG:32633", "nodata": -9999.0,
        "transform": from_origin(ORIGIN[0], ORIGIN[1] + SIDE, 1.0, 1.0),
    }  # fmt: skip
    warm = temperature(x, y)
    warm[:3, :3] = -9999.0  # nothing was measured there
    with rasterio.open(folder / "t.tif", "w", count=1, **profile) as file:
        file.write(warm.astype(np.float32), 1)
    bands = (
        np.array(list(SPECTRA.values()))[material(x, y)] * rng.uniform(0.5, 1.5, x.shape)[..., None]
    )  # in sun and shade
    bands = bands + 0.005 * rng.standard_normal(bands.shape)
    with rasterio.open(folder / "s.tif", "w", count=len(NM), **profile) as file:
        file.write(np.moveaxis(bands, -1, 0).astype(np.float32))
        for number, each in enumerate(NM, 1):
            file.set_band_description(number, f"Band {number} ({each:.1f} nm)")
    rows = ["wavelength_nm," + ",".join(SPECTRA)]
    fine = np.linspace(400, 1000, 200)
    rows += [f"{w:.2f}," + ",".join(f"{np.interp(w, NM, s):.5f}" for s in SPECTRA.values()) for w in fine]
    (folder / "library.csv").write_text("\n".join(rows) + "\n")
    return folder, xyz


def test_temperatures_are_those_of_the_raster_on_what_is_uppermost(
    place: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    folder, xyz = place
    words = [
        "drape",
        str(folder / "c.laz"),
        str(folder / "t.tif"),
        "--as",
        "temperature",
        "-o",
        str(tmp_path / "o.laz"),
    ]
    assert main([*words, "--json", str(tmp_path / "f.json")]) == 0
    out = laspy.read(tmp_path / "o.laz")
    assert np.allclose(out.xyz, xyz + np.array([*ORIGIN, 0.0]), rtol=0, atol=0.001)
    found = np.asarray(out["temperature"])
    inside = (np.abs(xyz[:, 0] - 20) < 4.4) & (np.abs(xyz[:, 1] - 20) < 4.4)
    hidden = inside & (xyz[:, 2] < 1.0)
    assert hidden.sum() > 100
    assert np.isnan(found[hidden]).mean() > 0.98  # a cell may hold only what was seen below the roof
    corner = (xyz[:, 0] < 2.4) & (xyz[:, 1] > SIDE - 2.4)
    assert np.isnan(found[corner]).all()
    seen = np.isfinite(found)
    assert seen.mean() > 0.9
    assert np.abs(found[seen] - temperature(xyz[seen, 0], xyz[seen, 1])).max() < 0.05
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["draped"] == seen.sum()
    assert figures["draped"] + figures["below_the_top"] + figures["outside_or_without_value"] == len(xyz)


def test_materials_are_told_by_their_spectra_in_sun_and_shade(place: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    folder, xyz = place
    words = ["drape", str(folder / "c.laz"), str(folder / "s.tif"), "--spectra", str(folder / "library.csv"), "--all"]
    assert main([*words, "-o", str(tmp_path / "o.laz"), "--json", str(tmp_path / "f.json")]) == 0
    out = laspy.read(tmp_path / "o.laz")
    x, y = xyz[:, 0], xyz[:, 1]
    edge = (np.abs(np.abs(x - 20) - 5) < 1) | (np.abs(np.abs(y - 20) - 5) < 1) | (np.abs(x - 30) < 1)
    true = material(x, y) + 1
    assert (np.asarray(out["spectral_class"])[~edge] == true[~edge]).mean() > 0.99
    assert np.nanmedian(np.asarray(out["spectral_angle"])) < 3.0
    told = json.loads((tmp_path / "f.json").read_text())["materials"]
    assert list(told) == list(SPECTRA)


def test_a_raster_in_another_crs_is_met(place: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    folder, xyz = place
    with rasterio.open(folder / "t.tif") as source:
        transform, width, height = calculate_default_transform(
            source.crs, "EPSG:3006", source.width, source.height, *source.bounds, resolution=0.5
        )
        profile = {**source.profile, "crs": "EPSG:3006", "transform": transform, "width": width, "height": height}
        with rasterio.open(tmp_path / "m.tif", "w", **profile) as out:
            reproject(rasterio.band(source, 1), rasterio.band(out, 1), resampling=Resampling.bilinear)
    words = [
        "drape",
        str(folder / "c.laz"),
        str(tmp_path / "m.tif"),
        "--as",
        "temperature",
        "-o",
        str(tmp_path / "o.laz"),
    ]
    assert main([*words, "--all"]) == 0
    found = np.asarray(laspy.read(tmp_path / "o.laz")["temperature"])
    seen = np.isfinite(found)
    assert seen.mean() > 0.85
    assert np.abs(found[seen] - temperature(xyz[seen, 0], xyz[seen, 1])).max() < 0.1


def test_the_angle_is_blind_to_brightness_and_wavelengths_are_read() -> None:
    library = Library(("a", "b"), np.array([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0]]))
    best, angle = library.nearest(np.array([[0.1, 0.2, 0.3], [30.0, 20.0, 10.0], [0.0, 0.0, 0.0], [np.nan, 1.0, 1.0]]))
    assert best.tolist() == [0, 1, -1, -1]
    assert np.allclose(angle[:2], 0.0, rtol=0, atol=1e-6)
    assert np.isnan(angle[2:]).all()
    found = wavelengths(["Band 1 (450.5 nm)", "0.55 Micrometers", "700"])
    assert found is not None
    assert np.allclose(found, [450.5, 550.0, 700.0])
    assert wavelengths(["red", "550"]) is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["t.tif"], "what its 1 bands become is not said"),
        (["t.tif", "--as", "gold"], "--as gold: expected some of temperature"),
        (["t.tif", "--as", "red,green"], "2 names found, expected 1"),
        (["t.tif", "--spectra", "library.csv"], "has 1 bands, expected 3 or more"),
        (["c.laz", "--as", "temperature"], "expected a georeferenced raster"),
        (["far.tif", "--as", "temperature"], "are they of one place"),
        (["s.tif", "--spectra", "short.csv"], "spans 500 to 600 nm, expected 450 to 950 nm"),
        (["s.tif", "--spectra", "wrong.csv"], "line 3: expected 2 numbers"),
    ],
)
def test_bad_wishes_are_one_sentence(
    place: tuple[Path, np.ndarray], tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = place
    (folder / "short.csv").write_text("wavelength_nm,a\n500,0.1\n600,0.2\n")
    (folder / "wrong.csv").write_text("wavelength_nm,a\n500,0.1\n600,x\n")
    with rasterio.open(folder / "t.tif") as source:
        profile = {**source.profile, "transform": from_origin(ORIGIN[0] + 5000, ORIGIN[1], 1.0, 1.0)}
        with rasterio.open(folder / "far.tif", "w", **profile) as out:
            out.write(source.read())
    given = [str(folder / word) if "." in word else word for word in words]
    capsys.readouterr()
    assert main(["drape", str(folder / "c.laz"), *given, "-o", str(tmp_path / "o.laz")]) in (1, 2)
    err = capsys.readouterr().err.strip()
    assert said in err
    assert "\n" not in err
    assert not (tmp_path / "o.laz").exists()


def test_every_point_of_level_ground_is_uppermost_and_one_far_away_does_no_harm(tmp_path: Path) -> None:
    """Points on edges of cells, of a cloud with a stray point 400 km off."""
    x, y = np.meshgrid(np.arange(2.0, 30.0, 0.5), np.arange(2.0, 30.0, 0.5))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 3.0)])
    write_cloud(tmp_path / "c.laz", np.vstack([xyz, [400_000.0, 700_000.0, 3.0]]))
    with rasterio.open(
        tmp_path / "t.tif", "w", driver="GTiff", width=SIDE, height=SIDE, count=1, dtype="float32", crs="EPSG:32633",
        transform=from_origin(ORIGIN[0], ORIGIN[1] + SIDE, 1.0, 1.0),
    ) as file:  # fmt: skip
        file.write(np.full((SIDE, SIDE), 20.0, np.float32), 1)
    words = ["drape", str(tmp_path / "c.laz"), str(tmp_path / "t.tif"), "--as", "temperature"]
    assert main([*words, "-o", str(tmp_path / "o.laz"), "--json", str(tmp_path / "f.json")]) == 0
    figures = json.loads((tmp_path / "f.json").read_text())
    assert (figures["draped"], figures["below_the_top"], figures["outside_or_without_value"]) == (len(xyz), 0, 1)
    assert (np.asarray(laspy.read(tmp_path / "o.laz")["temperature"])[:-1] == 20.0).all()
