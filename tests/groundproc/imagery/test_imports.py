import json
from pathlib import Path

import numpy as np
import pytest

from flightlog.errors import CaptureError
from groundproc.imagery.camera import Camera
from groundproc.imagery.colmap import camera_line, fitted, read_cameras
from groundproc.imagery.imports import load_rig

CAMERAS = [
    Camera(640, 480, 500.0, (319.5, 239.5)),
    Camera(640, 480, 500.0, (322.0, 238.0), "radtan", (-0.1, 0.01, 1e-3, -1e-3), 1.01),
    Camera(640, 480, 500.0, (322.0, 238.0), "radtan", (-0.1, 0.01, 1e-3, -1e-3, 0.002)),
    Camera(640, 480, 300.0, (322.0, 238.0), "equidistant", (-0.1, 0.01, 1e-3, -1e-3)),
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_camera_comes_back_from_colmap_s_text(tmp_path: Path, camera: Camera) -> None:
    (tmp_path / "cameras.txt").write_text("# a comment\n" + camera_line(1, camera) + "\n")
    again = read_cameras(tmp_path / "cameras.txt").cameras[0].camera
    pixels = np.random.default_rng(0).uniform([0, 0], [639, 479], (50, 2))
    np.testing.assert_allclose(again.unproject(pixels)[0], camera.unproject(pixels)[0], rtol=0, atol=1e-12)


def test_colmap_s_pixel_is_half_a_pixel_on() -> None:
    assert camera_line(3, CAMERAS[0]) == "3 PINHOLE 640 480 500 500 320 240"


def test_a_photogrammetric_camera_is_written_as_the_one_that_fits_it() -> None:
    camera = Camera(5616, 3744, 3828.0, (2820.0, 1874.0), "brown_photogrammetric", (2.2e-4, -1.9e-7), 1.0, 0.00641)
    pixels = np.random.default_rng(0).uniform([100, 100], [5500, 3600], (200, 2))
    found, _ = fitted(camera).project(camera.unproject(pixels)[0])
    assert np.abs(found - pixels).max() < 1.0


def test_opensfm_s_lengths_are_shares_of_the_longer_side(tmp_path: Path) -> None:
    models = {
        "v2 dji": {"projection_type": "brown", "width": 4000, "height": 3000, "focal_x": 0.7, "focal_y": 0.7, "c_x": 0.01,
                   "c_y": -0.02, "k1": 0.1, "k2": 0.0, "p1": 1e-3, "p2": 0.0, "k3": 0.0},
        "fish": {"projection_type": "fisheye", "width": 2000, "height": 2000, "focal": 0.4, "k1": 0.01, "k2": 0.0},
    }  # fmt: skip
    (tmp_path / "camera_models.json").write_text(json.dumps(models))
    first, second = (one.camera for one in load_rig(tmp_path / "camera_models.json").cameras)
    assert (first.focal_px, first.model) == (2800.0, "radtan")
    np.testing.assert_allclose(first.centre_px, (1999.5 + 40.0, 1499.5 - 80.0))
    assert (second.focal_px, second.model) == (800.0, "equidistant")


def test_whose_an_image_is_stands_in_the_models_of_other_programs(tmp_path: Path) -> None:
    lines = "".join(camera_line(number, CAMERAS[0]) + "\n" for number in (1, 2))
    (tmp_path / "cameras.txt").write_text(lines)
    (tmp_path / "images.txt").write_text(
        "# a comment\n1 1 0 0 0 0 0 0 2 a b.jpg\n\n2 1 0 0 0 0 0 0 1 c.jpg\n10 10 -1\n"
    )
    colmap = load_rig(tmp_path / "cameras.txt")
    assert [colmap.camera_of(name) for name in ("c.jpg", "a b.jpg")] == [0, 1]
    camera = {"projection_type": "perspective", "width": 10, "height": 10, "focal": 1.0, "k1": 0.0, "k2": 0.0}
    tree = [{"cameras": {"p": camera, "q": camera}, "shots": {"a.jpg": {"camera": "q"}, "b.jpg": {"camera": "p"}}}]
    (tmp_path / "reconstruction.json").write_text(json.dumps(tree))
    opensfm = load_rig(tmp_path / "reconstruction.json")
    assert [opensfm.camera_of(name) for name in ("a.jpg", "b.jpg")] == [1, 0]


@pytest.mark.parametrize(
    ("name", "text", "word"),
    [
        ("cameras.txt", "", "no cameras"),
        ("cameras.txt", "1 FOV 10 10 5 5 5 5 0.1", "FOV"),
        ("cameras.txt", "1 PINHOLE 10 10 5", "fu"),
        ("cameras.txt", "1 PINHOLE 10 10 -5 5 5 5", "above 0"),
        ("a.json", "{", "no JSON"),
        ("a.json", "[]", "no cameras"),
        ("a.json", '{"a": {"projection_type": "dual"}}', "dual"),
        ("a.json", '{"a": {"width": 10}}', "expected numbers"),
    ],
)
def test_what_is_no_rig_gets_one_sentence(tmp_path: Path, name: str, text: str, word: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=word):
        load_rig(tmp_path / name)
