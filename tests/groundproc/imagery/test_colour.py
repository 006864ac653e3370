"""Colours of a cloud, against pictures made by rays: what an image cannot see it does not colour."""

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
import rendered

from flightlog.errors import CaptureError
from groundproc.cli import main
from groundproc.cloud import reader
from groundproc.imagery import pictures
from groundproc.imagery.painting import block, paint
from groundproc.imagery.painting.scene import Scene
from groundproc.imagery.poses import NO_TIME, ImagePoses, write_poses
from groundproc.imagery.rig import Rig, RigCamera, write_rig
from groundproc.imagery.rotations import mat_world_camera

pytestmark = pytest.mark.filterwarnings("ignore:Dataset has no geotransform")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen pictures of a box on a plain, and its cloud of 60 points a square metre."""
    folder = tmp_path_factory.mktemp("colour")
    rendered.write_block(folder / "images", rendered.shots(), epsg=None)
    measured, true = rendered.points(60.0, 1)
    rendered.write_cloud(folder / "cloud.laz", measured, epsg=None)
    np.save(folder / "true.npy", true)
    return folder


@pytest.fixture(scope="module")
def coloured(place: Path) -> laspy.LasData:
    words = ["--images", str(place / "images"), "--json", str(place / "told.json")]
    assert main(["colour", str(place / "cloud.laz"), *words, "-o", str(place / "out.laz")]) == 0
    return laspy.read(place / "out.laz")


@pytest.fixture(scope="module")
def looks(place: Path) -> Iterator[tuple[block.Block, Scene]]:
    cloud = reader.look(place / "cloud.laz")
    found = block.load(place / "images", None, None, cloud.path)
    with tempfile.TemporaryDirectory() as folder:
        yield found, Scene(cloud, found.site, Path(folder), lambda _: None)


def test_hidden_ground_stays_without_colour_and_what_is_seen_gets_one(
    place: Path, looks: tuple[block.Block, Scene]
) -> None:
    """Of the plain; a point within a spacing of an edge as the camera sees it may go either way."""
    found, scene = looks
    true = np.load(place / "true.npy")
    ground = true[:, 2] == 0.0
    counts = dict.fromkeys(("hidden", "shining through", "open", "refused"), 0)
    ever, given = np.zeros(len(true), bool), np.zeros(len(true), bool)
    for image, shot in zip(found.layers[0].images, rendered.shots(), strict=True):
        seen = np.zeros(len(true), bool)
        for square, some, _ in paint.visible(found, image, scene):
            seen[scene.number[square.points][some.number]] = True
        mat = mat_world_camera(*np.deg2rad(np.array(shot.angles_deg))[:, None])[0]
        _, inside = rendered.CAMERA.project((true - shot.place_m) @ mat)
        hidden = rendered.hidden(shot.place_m, true)
        counts["hidden"] += int((inside & hidden & ground).sum())
        counts["shining through"] += int((inside & hidden & ground & seen).sum())
        counts["open"] += int((inside & ~hidden & ground).sum())
        counts["refused"] += int((inside & ~hidden & ground & ~seen).sum())
        ever |= inside & ~hidden
        given |= seen
    assert counts["hidden"] > 20_000
    assert counts["shining through"] < 0.001 * counts["hidden"]
    assert counts["refused"] < 0.01 * counts["open"]
    assert (ever & given).sum() >= 0.999 * ever.sum()


def test_colours_are_those_of_the_scene_at_one_exposure(place: Path, coloured: laspy.LasData) -> None:
    """Exposures differ by 30 %. A pixel is 8 cm on the ground, where the colour changes by at most 0.33 a metre."""
    true = np.load(place / "true.npy")
    shown = np.stack([coloured.red, coloured.green, coloured.blue], axis=1) / 65535.0
    seen = (np.asarray(coloured.views) > 0) & (true[:, 2] == 0.0)
    factor = np.median(shown[seen] / rendered.colour_at(true[seen]))
    error = shown[seen] / factor - rendered.colour_at(true[seen])
    assert np.sqrt((error**2).mean()) < 0.33 * 0.08
    told = json.loads((place / "told.json").read_text())
    assert told["images"] == 16
    assert told["coloured"] == int((np.asarray(coloured.views) > 0).sum())
    assert max(told["held_out"].values()) < 5.0


def test_every_point_goes_out_as_it_came_in_and_without_views_it_is_black(place: Path, coloured: laspy.LasData) -> None:
    before = laspy.read(place / "cloud.laz")
    assert coloured.header.point_format.id == 8
    assert not np.asarray(coloured.nir).any()
    for name in ("X", "Y", "Z", "intensity", "gps_time"):
        assert (before[name] == coloured[name]).all()
    one = place / "one"
    rendered.write_block(one, rendered.shots()[:1], epsg=None)
    assert main(["colour", str(place / "cloud.laz"), "--images", str(one), "-o", str(place / "one.laz")]) == 0
    few = laspy.read(place / "one.laz")
    unseen = np.asarray(few.views) == 0
    assert 0.2 < unseen.mean() < 0.9
    assert not np.stack([few.red, few.green, few.blue])[:, unseen].any()
    assert set(np.asarray(few.views)) == {0, 1}


# a second block drawn and laid; in the quick suite: a warm car that passes is voted out (test_hamlet)
@pytest.mark.soak
def test_what_passes_by_is_voted_out(place: Path, coloured: laspy.LasData) -> None:
    """A bright car in one picture only, where five or more others see the ground."""
    folder = place / "car"
    rendered.write_block(folder, rendered.shots(), epsg=None)
    with rasterio.open(folder / "00.png") as file:
        shown = file.read()
    shown[:, 200:280, 300:380] = 255
    with rasterio.open(folder / "00.png", "w", driver="PNG", width=640, height=480, count=3, dtype="uint8") as file:
        file.write(shown)
    assert main(["colour", str(place / "cloud.laz"), "--images", str(folder), "-o", str(place / "car.laz")]) == 0
    other = laspy.read(place / "car.laz")
    several = np.asarray(other.views) >= 5
    change = np.abs(np.asarray(other.blue, float) - np.asarray(coloured.blue, float))[several] / 65535.0
    assert (change > 0.1).mean() < 1e-3


def test_near_infrared_and_temperatures_are_attributes_of_their_own(place: Path, tmp_path: Path) -> None:
    """Two cameras of one plane: numbers of 16 bits, and of a thermal camera in hundredths of a kelvin."""
    shot, camera = rendered.shots()[5], rendered.CAMERA
    for name, value in (("nir", 30_000), ("heat", 29_315)):
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", width=camera.width_px, height=camera.height_px, count=1, dtype="uint16"
        ) as file:  # fmt: skip
            file.write(np.full((1, camera.height_px, camera.width_px), value, np.uint16))
    nothing = np.full((2, 3), np.nan)
    write_poses(
        tmp_path / "poses.csv",
        ImagePoses(
            ("nir.tif", "heat.tif"), np.full(2, NO_TIME), np.tile(shot.place_m, (2, 1)),
            np.deg2rad(np.tile(shot.angles_deg, (2, 1))), nothing, nothing,
        ),
    )  # fmt: skip
    response = {"scale": 0.01, "offset": -273.15}
    cameras = (
        RigCamera("nir", camera, image_prefix="nir", bands=("nir",)),
        RigCamera("heat", camera, image_prefix="heat", bands=("temperature",), response=response),
    )
    write_rig(tmp_path / "rig.yaml", Rig(cameras))
    assert main(["colour", str(place / "cloud.laz"), "--images", str(tmp_path), "-o", str(tmp_path / "o.laz")]) == 0
    found = laspy.read(tmp_path / "o.laz")
    seen = np.asarray(found.views) > 0
    assert found.header.point_format.id == 8
    assert set(np.asarray(found.nir[seen])) == {30_000}
    np.testing.assert_allclose(np.asarray(found.temperature[seen]), 20.0, rtol=0, atol=1e-3)
    assert np.isnan(np.asarray(found.temperature)[~seen]).all()


def test_an_old_point_format_gets_colours_too(place: Path, tmp_path: Path) -> None:
    measured, _ = rendered.points(2.0, 3)
    rendered.write_cloud(tmp_path / "old.las", measured, epsg=None, point_format=1)
    words = ["--images", str(place / "images"), "-o", str(tmp_path / "o.las")]
    assert main(["colour", str(tmp_path / "old.las"), *words]) == 0
    assert laspy.read(tmp_path / "o.las").header.point_format.id == 3


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda folder: (folder / "poses.csv").unlink(), "holds no poses.csv; expected a folder of `swath images`"),
        (lambda folder: [path.unlink() for path in folder.glob("*.png")], "none of 16 images can be used"),
        (
            lambda folder: (folder / "rig.yaml").write_text(
                (folder / "rig.yaml").read_text().replace("[640, 480]", "[64, 48]")
            ),
            "has 640 x 480 pixels, camera cam0 of the rig 64 x 48",
        ),
        (
            lambda folder: (folder / "rig.yaml").write_text((folder / "rig.yaml").read_text() + "  bands: [a, b, c]\n"),
            "band 'a': expected a name of a point attribute",
        ),
    ],
)
def test_a_folder_that_will_not_do_is_one_sentence(
    place: Path, tmp_path: Path, spoil: object, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert callable(spoil)
    folder = tmp_path / "images"
    folder.mkdir()
    for path in (place / "images").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    spoil(folder)
    out = tmp_path / "o.laz"
    assert main(["colour", str(place / "cloud.laz"), "--images", str(folder), "-o", str(out)]) in (1, 2)
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert list(tmp_path.iterdir()) == [folder]


def test_a_picture_that_is_damaged_is_named_and_the_rest_goes_on(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "images"
    rendered.write_block(folder, rendered.shots()[:4], epsg=None)
    (folder / "01.png").write_bytes(b"no picture")
    whole = (folder / "02.png").read_bytes()
    (folder / "02.png").write_bytes(whole[:2000])  # its size can be read, and not what it shows
    assert main(["colour", str(place / "cloud.laz"), "--images", str(folder), "-o", str(tmp_path / "o.laz")]) == 0
    told = capsys.readouterr()
    assert "01.png: is no picture that can be read" in told.err
    assert "02.png: is no picture that can be read (it ends before" in told.err
    assert "by 2 images" in told.out


@pytest.mark.parametrize("suffix", ["jpg", "tif", "png"])
def test_half_a_picture_is_none(tmp_path: Path, suffix: str) -> None:
    values = np.random.default_rng(1).integers(0, 255, (3, 120, 160)).astype("u1")
    path = tmp_path / f"half.{suffix}"
    driver = {"jpg": "JPEG", "tif": "GTiff", "png": "PNG"}[suffix]
    with rasterio.open(path, "w", driver=driver, width=160, height=120, count=3, dtype="uint8") as file:
        file.write(values)
    assert pictures.picture(path).shape == (120, 160, 3)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CaptureError, match="is no picture that can be read"):
        pictures.picture(path)
