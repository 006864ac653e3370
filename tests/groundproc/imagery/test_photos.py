from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image

from flightlog.errors import CaptureError
from groundproc.imagery.camera import Camera
from groundproc.imagery.exifrig import named, rig_of
from groundproc.imagery.photos import Picture, files_of, look
from groundproc.imagery.pictures import gray
from groundproc.imagery.poses import NO_TIME
from groundproc.imagery.rig import Rig, RigCamera, read_rig, write_rig


def picture(path: Path, size: tuple[int, int] = (64, 48), exif: Image.Exif | None = None) -> Path:
    noise = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    Image.fromarray(noise).save(path, exif=exif or Image.Exif())
    return path


def dated(text: str, below: str = "", offset: str = "") -> Image.Exif:
    exif, detail = Image.Exif(), {0x9003: text}
    if below:
        detail[0x9291] = below
    if offset:
        detail[0x9011] = offset
    exif[0x8769] = detail
    return exif


def looked(path: Path) -> Picture:
    found = next(iter(look([path])))
    assert isinstance(found, Picture)
    return found


def test_the_time_of_an_image_has_its_sub_seconds_and_its_offset(tmp_path: Path) -> None:
    path = picture(tmp_path / "a.jpg", exif=dated("2023:11:14 22:13:20", "123456"))
    assert looked(path).exif_ns == 1_700_000_000_123_456_000
    path = picture(tmp_path / "b.jpg", exif=dated("2023:11:15 00:13:20", "5", "+02:00"))
    assert looked(path).exif_ns == 1_700_000_000_500_000_000
    assert looked(picture(tmp_path / "c.jpg")).exif_ns == NO_TIME
    assert looked(picture(tmp_path / "d.jpg", exif=dated("0000:00:00 00:00:00"))).exif_ns == NO_TIME


def test_names_are_paths_below_the_common_folder(tmp_path: Path) -> None:
    for name in ("rgb/a.jpg", "msp/b.tif"):
        (tmp_path / name).parent.mkdir()
        picture(tmp_path / name)
    (tmp_path / "msp" / "notes.txt").write_text("x")
    names = [one.name for one in look(files_of([tmp_path])) if isinstance(one, Picture)]
    assert sorted(names) == ["msp/b.tif", "rgb/a.jpg"]


def test_what_is_no_image_is_named_and_the_rest_goes_on(tmp_path: Path) -> None:
    (tmp_path / "bad.jpg").write_bytes(b"\xff\xd8\xff\xe0" + b"x" * 100)
    picture(tmp_path / "good.jpg")
    bad, good = look(files_of([tmp_path]))
    assert isinstance(good, Picture)
    assert isinstance(bad, tuple)
    assert bad[0] == "bad.jpg"
    assert "no image" in bad[1]
    whole = (tmp_path / "good.jpg").read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CaptureError, match="truncated"):
        gray(tmp_path / "cut.jpg", 1000)


def test_pixels_of_a_reduced_picture_are_means_of_the_file_s(tmp_path: Path) -> None:
    plane = np.zeros((400, 600), np.uint8)
    plane[200:, 300:] = 200
    Image.fromarray(plane).save(tmp_path / "a.png")
    found, size = gray(tmp_path / "a.png", 300)
    assert found.shape == (200, 300)
    assert size == 2.0
    # the edge between file pixels 299 and 300 is that between 149 and 150
    assert found[150, 149] < 100 < found[150, 150]


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
@pytest.mark.parametrize(
    ("planes", "dtype", "top"), [(5, "uint16", 4095), (3, "uint16", 4095), (2, "uint16", 900), (3, "float32", 1)]
)
def test_several_planes_of_more_than_eight_bits_are_one_picture(
    tmp_path: Path, planes: int, dtype: str, top: int
) -> None:
    """Bands of a multispectral camera, or 12 bits in 16: with all the grey levels that they have."""
    grey = np.add.outer(np.arange(40), np.arange(60)) / 98.0
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", width=60, height=40, count=planes, dtype=dtype) as file:
        file.write(np.stack([grey * top] * planes).astype(dtype))
        file.update_tags(TIFFTAG_DATETIME="2023:11:14 22:13:20")
    one = looked(path)
    assert (one.width_px, one.height_px, one.exif_ns) == (60, 40, 1_700_000_000_000_000_000)
    shown, size = gray(path, 100)
    assert size == 1.0
    inner = (grey > 0.05) & (grey < 0.95)
    assert np.corrcoef(shown[inner], grey[inner])[0, 1] > 0.9999
    assert len(np.unique(shown)) > 90


def test_a_place_without_images_is_told(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="holds no images"):
        files_of([tmp_path])
    with pytest.raises(CaptureError, match="no such file"):
        files_of([tmp_path / "x.jpg"])


def test_dji_images_say_where_they_were_and_how_they_looked(recordings: Path) -> None:
    found = looked(recordings / "images" / "brighton" / "DJI_0018.JPG")
    assert found.fix is not None
    np.testing.assert_allclose(
        (found.fix.latitude_deg, found.fix.longitude_deg), (46.842607083, -91.994559889), rtol=0, atol=1e-8
    )
    assert (found.relative_m, found.width_px) == (39.8, 1600)
    assert found.mat_enu_camera is not None
    np.testing.assert_allclose(found.mat_enu_camera @ [0, 0, 1], [0, 0, -1], rtol=0, atol=0.01)  # down
    np.testing.assert_allclose(
        found.mat_enu_camera @ [0, -1, 0], [0.5**0.5, 0.5**0.5, 0], rtol=0, atol=0.01
    )  # up is north-east
    rig, numbers, _ = rig_of([found])
    assert numbers == [0]
    assert 700 < rig.cameras[0].camera.focal_px < 1100


def test_the_sequoia_s_cameras_are_those_of_its_xmp(recordings: Path, tmp_path: Path) -> None:
    folder = recordings / "images" / "garfield"
    pictures = [one for one in look(files_of([folder])) if isinstance(one, Picture)]
    rig, numbers, notes = rig_of(pictures)
    assert notes == []
    assert len(pictures) == len(numbers)
    assert len(rig.cameras) == 5
    by_band = {one.bands: one for one in rig.cameras}
    assert set(by_band) == {("red",), ("green",), ("nir",), ("red_edge",), ("red", "green", "blue")}
    # who reads what is written knows whose an image is
    write_rig(tmp_path / "rig.yaml", rig)
    again = read_rig(tmp_path / "rig.yaml")
    assert [again.camera_of(one.name) for one in pictures] == numbers
    assert {one.image_prefix for one in again.cameras} == {"*_RED.TIF", "*_GRE.TIF", "*_NIR.TIF", "*_REG.TIF", "rgb/"}
    nir = by_band[("nir",)].camera
    assert nir.model == "fisheye_polynomial"
    np.testing.assert_allclose(nir.focal_px * np.pi / 2, 1671.556624069)
    np.testing.assert_allclose(nir.centre_px[0], 2.544297 / 0.00375 - 0.5, rtol=0, atol=0.1)
    rgb = next(one for one in rig.cameras if one.camera.model == "radtan")
    np.testing.assert_allclose(rgb.line_delay_s * rgb.camera.height_px, 0.0475)


@pytest.mark.parametrize(
    ("images", "prefixes"),
    [
        (("a/1.jpg", "b/1.jpg"), ["a/", "b/"]),
        (("left_1.jpg", "right_1.jpg", "left_2.jpg"), ["left_", "right_"]),
        (("DJI_0001.jpg", "DJI_0002.jpg", "DJI_0003.jpg"), ["", ""]),
    ],
)
def test_a_rig_of_several_cameras_says_whose_an_image_is(images: tuple[str, ...], prefixes: list[str]) -> None:
    """By folders or names where these tell, else one by one."""
    camera = Camera(10, 10, 10.0, (4.5, 4.5))
    numbers = [0, 1, 0][: len(images)]
    rig = named(Rig((RigCamera("a", camera), RigCamera("b", camera))), images, numbers)
    assert [rig.camera_of(name) for name in images] == numbers
    assert [one.image_prefix for one in rig.cameras] == prefixes
