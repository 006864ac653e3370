"""Mosaics and indices against what pictures were rendered from."""

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
import rendered
from PIL import Image

from flightlog.errors import UsageError
from groundproc.cli import main
from groundproc.imagery.poses import NO_TIME, ImagePoses, write_poses
from groundproc.imagery.radiance import vignetting
from groundproc.imagery.rig import Rig, RigCamera, write_rig

pytestmark = pytest.mark.filterwarnings("ignore:Dataset has no geotransform")

BLACK = 4096
FALL = -0.4
"""Of the light, in the corners."""
PANELS = {"dark": (-12.0, -8.0, 0.05, 0.06), "grey": (-12.0, 8.0, 0.30, 0.32), "white": (12.0, 8.0, 0.80, 0.78)}
"""Place, red, near infrared; discs of 1.5 m."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ortho")
    rendered.write_block(folder / "images", rendered.shots(), epsg=None)
    measured, _ = rendered.points(60.0, 1)
    rendered.write_cloud(folder / "cloud.laz", measured, epsg=None)
    return folder


# a second mosaic of a second scene; in the quick suite: every pixel of a mosaic to a fifth of its size (test_foreign)
@pytest.mark.soak
def test_a_mosaic_shows_every_place_where_it_is(place: Path) -> None:
    """Pixels of 0.2 m: the picture is that of the scene seen from straight above, roof and ground, but for the roof's edge."""
    out = place / "ortho.tif"
    words = ["--images", str(place / "images"), "--gsd", "0.2", "-o", str(out), "--json", str(place / "told.json")]
    assert main(["ortho", str(place / "cloud.laz"), *words]) == 0
    with rasterio.open(out) as file:
        shown = np.moveaxis(file.read(), 0, -1) / 255.0
        transform = file.transform
        assert file.profile["nodata"] == 0
        assert (transform.a, transform.c % 0.2 < 1e-9 or transform.c % 0.2 > 0.2 - 1e-9) == (0.2, True)
    with rasterio.open(place / "ortho_images.tif") as file:
        images = file.read(1)
    row, column = np.mgrid[: shown.shape[0], : shown.shape[1]]
    x, y = transform * (column + 0.5, row + 0.5)
    roof = (np.abs(x) < 4.6) & (np.abs(y) < 3.6)
    ground = (np.abs(x) > 5.4) | (np.abs(y) > 4.4)
    truth = rendered.colour_at(np.stack([x.ravel(), y.ravel(), np.where(roof, 8.0, 0.0).ravel()], axis=1)).reshape(
        shown.shape
    )
    seen = (shown > 0).all(axis=-1)
    assert seen[roof | ground].mean() > 0.999
    factor = np.median((shown / truth)[seen & ground])
    for part in (roof, ground):
        error = (shown / factor - truth)[part & seen]
        # a shift of one pixel would be an error of 0.33 a metre times 0.2 m
        assert np.sqrt((error**2).mean()) < 0.01
    assert len(np.unique(images[roof])) == 1, "the house is of one image"
    told = json.loads((place / "told.json").read_text())
    assert told["images"][images.max() - 1].endswith(".png")


def reflectances(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Red and near infrared of the plain: a meadow that changes, and panels."""
    red, nir = 0.08 + 0.04 * np.sin(0.3 * x), 0.45 + 0.15 * np.cos(0.25 * y)
    for east, north, in_red, in_nir in PANELS.values():
        on = np.hypot(x - east, y - north) < 1.5
        red, nir = np.where(on, in_red, red), np.where(on, in_nir, nir)
    return red, nir


@pytest.fixture(scope="module")
def two_bands(place: Path) -> Path:
    """Pictures of 16 bits, a camera a band, with a black level, dark corners, noise, and an exposure that EXIF states."""
    folder = place / "bands"
    folder.mkdir()
    rng = np.random.default_rng(3)
    camera = rendered.CAMERA
    row, column = np.mgrid[: camera.height_px, : camera.width_px]
    rays, _ = camera.unproject(np.stack([column.ravel(), row.ravel()], axis=1).astype(float))
    square = (column - camera.centre_px[0]) ** 2 + (row - camera.centre_px[1]) ** 2
    fall = 1.0 + FALL * square / square.max()
    taken = rendered.shots()[:12]
    names = []
    for number, shot in enumerate(taken):
        mat = rendered.mat_world_camera(*np.deg2rad(np.array(shot.angles_deg))[:, None])[0]
        world = rays @ mat.T
        distance, box = rendered.hit(shot.place_m, world)
        at = shot.place_m + world * distance[:, None]
        for band, plane in zip(("red", "nir"), reflectances(at[:, 0], at[:, 1]), strict=True):
            exposure_s = 0.001 * (1.0 + 0.1 * number)
            light = (
                np.where(box, 0.2, plane).reshape(fall.shape) * fall * exposure_s * (2.2e7 if band == "red" else 2.9e7)
            )
            values = np.clip(BLACK + light * rng.normal(1.0, 0.01, fall.shape), 0, 65535).astype(np.uint16)
            exif = Image.Exif()
            exif._ifds[0x8769], exif[0x8769] = {33434: exposure_s}, 0
            Image.fromarray(values).save(folder / f"{band}_{number:02d}.tif", exif=exif)
            names.append(f"{band}_{number:02d}.tif")
    nothing = np.full((len(names), 3), np.nan)
    write_poses(
        folder / "poses.csv",
        ImagePoses(
            tuple(names), np.full(len(names), NO_TIME), np.repeat([shot.place_m for shot in taken], 2, axis=0),
            np.deg2rad(np.repeat([shot.angles_deg for shot in taken], 2, axis=0)), nothing, nothing,
        ),
    )  # fmt: skip
    cameras = [
        RigCamera(band, camera, image_prefix=band, bands=(band,), black_level=BLACK, vignetting=[FALL])
        for band in ("red", "nir")
    ]
    write_rig(folder / "rig.yaml", Rig(tuple(cameras)))
    rows = [f"{name},{x},{y},0,1.2,{red},,,{nir}" for name, (x, y, red, nir) in PANELS.items()]
    (place / "panels.csv").write_text("\n".join(["name,x,y,z,radius,red,green,blue,nir", *rows]) + "\n")
    return folder


def test_the_index_of_panels_and_meadow_is_right_to_two_hundredths(place: Path, two_bands: Path) -> None:
    out, draped = place / "ndvi.tif", place / "ndvi.laz"
    words = ["--images", str(two_bands), "--gsd", "0.25", "-o", str(out), "--cloud", str(draped)]
    words += ["--panels", str(place / "panels.csv"), "--json", str(place / "ndvi.json")]
    assert main(["ndvi", str(place / "cloud.laz"), *words]) == 0
    with rasterio.open(out) as file:
        shown, transform = file.read(1, masked=True).filled(np.nan), file.transform
    row, column = np.mgrid[: shown.shape[0], : shown.shape[1]]
    x, y = transform * (column + 0.5, row + 0.5)
    red, nir = reflectances(x, y)
    plain = ((np.abs(x) > 5.5) | (np.abs(y) > 4.5)) & np.isfinite(shown)
    edge = np.zeros(x.shape, bool)
    for east, north, in_red, in_nir in PANELS.values():
        distance = np.hypot(x - east, y - north)
        edge |= np.abs(distance - 1.5) < 0.4
        inside = shown[distance < 1.0]
        assert abs(np.median(inside) - (in_nir - in_red) / (in_nir + in_red)) < 0.02
    error = (shown - (nir - red) / (nir + red))[plain & ~edge]
    assert abs(np.median(error)) < 0.005
    assert np.sqrt((error**2).mean()) < 0.02
    told = json.loads((place / "ndvi.json").read_text())
    assert told["calibrated"]
    assert [told["lines"][band]["panels"] for band in ("red", "nir")] == [3, 3]
    cloud, before = laspy.read(draped), laspy.read(place / "cloud.laz")
    assert (cloud.X == before.X).all()
    places = np.asarray(cloud.xyz)
    on_plain = (np.abs(places[:, 2]) < 0.1) & ((np.abs(places[:, 0]) > 5.5) | (np.abs(places[:, 1]) > 4.5))
    off_panels = np.all([np.hypot(places[:, 0] - e, places[:, 1] - n) > 1.9 for e, n, *_ in PANELS.values()], axis=0)
    red, nir = reflectances(places[:, 0], places[:, 1])
    error = (np.asarray(cloud.ndvi) - (nir - red) / (nir + red))[on_plain & off_panels]
    assert np.sqrt(np.nanmean(error**2)) < 0.02


def test_without_panels_it_says_that_it_is_not_calibrated(
    place: Path, two_bands: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = place / "raw.tif"
    assert main(["ndvi", str(place / "cloud.laz"), "--images", str(two_bands), "--gsd", "0.5", "-o", str(out)]) == 0
    told = capsys.readouterr()
    assert "not calibrated" in told.err
    assert "not calibrated" in told.out


@pytest.mark.parametrize(
    ("command", "words", "sentence"),
    [
        ("ortho", ["--gsd", "0"], "cell 0 m: expected"),
        ("ortho", ["--bands", "nir"], "bands nir found, expected those of one kind of pictures: red, green, blue"),
        ("ndvi", [], "no picture has band nir, the bands are blue, green, red"),
        ("ndvi", ["--index", "evi"], "--index 'evi': expected one of ndvi"),
    ],
)
def test_what_cannot_be_made_is_one_sentence(
    place: Path, tmp_path: Path, command: str, words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "o.tif"
    common = ["--images", str(place / "images"), "-o", str(out)]
    assert main([command, str(place / "cloud.laz"), *common, *words]) == 2
    told = capsys.readouterr().err
    assert sentence in told
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_polynomial_of_the_vendor_falls_as_it_says() -> None:
    """The Sequoia's form: powers of x and y from 0 to 1."""
    given = {"powers": [[0, 0], [1, 0], [0, 2]], "coefficients": [0.5, 0.25, 0.125]}
    found = vignetting(RigCamera("nir", rendered.CAMERA, vignetting=given))
    assert found.shape == (480, 640)
    np.testing.assert_allclose(found[[0, 0, -1], [0, -1, -1]], [0.5, 0.75, 0.875], rtol=1e-6)


@pytest.mark.parametrize("given", ["dark", [-2.0], {"powers": [[0, 0]]}, [None]])
def test_vignetting_that_is_none_is_refused(given: object) -> None:
    with pytest.raises(UsageError, match="vignetting"):
        vignetting(RigCamera("nir", rendered.CAMERA, vignetting=given))
