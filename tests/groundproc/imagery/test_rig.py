from pathlib import Path

import numpy as np
import pytest

from flightlog.errors import ConfigError
from groundproc.imagery.rig import Rig, Spread, read_rig, write_rig

KALIBR = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.29, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.01]
  - [-1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  timeshift_cam_imu: 0.004
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, 0.0, 0.0, 0.0]
  distortion_model: equidistant
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
"""


def written(folder: Path, text: str) -> Rig:
    path = folder / "rig.yaml"
    path.write_text(text)
    return read_rig(path)


def test_a_camchain_of_kalibr_is_read_with_its_meaning(tmp_path: Path) -> None:
    first, second = written(tmp_path, KALIBR).cameras
    np.testing.assert_allclose(first.mat_cam_ins @ [0, 0, 0] + first.origin_cam_m, [0.01, 0.02, 0.03])
    np.testing.assert_allclose(first.mat_cam_ins @ first.lever_arm_m + first.origin_cam_m, 0.0, rtol=0, atol=1e-15)
    assert first.timeshift_s == 0.004
    np.testing.assert_allclose(second.origin_cam_m, [-0.10, 0.02, 0.03])
    np.testing.assert_allclose(second.mat_cam_ins, first.mat_cam_ins)
    np.testing.assert_allclose(first.camera.aspect, 457.3 / 458.6)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    text = (
        KALIBR
        + "  estimate: [f, k1]\n  sigma: {f: 8, boresight_deg: 1}\n  line_delay_s: 2e-5\n  bands: [green, red, nir]\n"
    )
    rig = written(tmp_path, text + "  image_prefix: msp/\n  black_level: 64\n  response: [1, 2]\n")
    write_rig(tmp_path / "again.yaml", rig)
    again = read_rig(tmp_path / "again.yaml")
    for one, other in zip(rig.cameras, again.cameras, strict=True):
        np.testing.assert_allclose(one.camera.lens(), other.camera.lens(), rtol=1e-15)
        np.testing.assert_allclose(one.mat_cam_ins, other.mat_cam_ins, rtol=0, atol=1e-15)
        for name in (
            "timeshift_s",
            "line_delay_s",
            "image_prefix",
            "bands",
            "response",
            "black_level",
            "estimate",
            "sigma",
        ):
            assert getattr(one, name) == getattr(other, name)
    assert again.cameras[1].line_delay_s == 2e-5


def test_the_longest_prefix_takes_an_image(tmp_path: Path) -> None:
    entry = "  intrinsics: [10, 10, 5, 5]\n  resolution: [10, 10]\n"
    rig = written(tmp_path, f"a:\n{entry}b:\n{entry}  image_prefix: msp/\nc:\n{entry}  image_prefix: '*_NIR.TIF'\n")
    found = [rig.camera_of(name) for name in ("x.jpg", "msp/x.jpg", "msp/IMG_NIR.TIF")]
    assert found == [0, 1, 2]
    assert Rig(rig.cameras[1:]).camera_of("x.jpg") is None


def test_of_cameras_that_no_prefix_tells_apart_the_size_of_the_picture_does(tmp_path: Path) -> None:
    small, large = (f"  intrinsics: [10, 10, 5, 5]\n  resolution: [{width}, 10]\n" for width in (10, 20))
    rig = written(tmp_path, f"a:\n{small}b:\n{large}c:\n{small}  bands: [NIR, Red edge, mine]\n  images: [x.jpg]\n")
    assert rig.camera_of("y.jpg", (20, 10)) == 1
    assert rig.camera_of("y.jpg") == 0
    assert rig.taking("y.jpg", (10, 10)) == [0, 2]
    assert rig.camera_of("x.jpg", (20, 10)) == 2
    assert rig.cameras[2].bands == ("nir", "red_edge", "mine")


def test_a_covariance_is_kept(tmp_path: Path) -> None:
    rig = written(tmp_path, KALIBR + "  covariance: {unknowns: [f, lever_x], matrix: [[4, 1], [1, 9]]}\n")
    spread = rig.cameras[1].spread
    assert isinstance(spread, Spread)
    assert (spread.sigma("f"), spread.sigma("lever_x"), spread.sigma("pu")) == (2.0, 3.0, None)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("distortion_model: radtan", "distortion_model: omni", "omni"),
        ("intrinsics: [458.6, 457.3, 367.2, 248.4]", "intrinsics: [1, 2]", "intrinsics"),
        ("intrinsics: [458.6, 457.3, 367.2, 248.4]", "intrinsics: [-1, 2, 3, 4]", "above 0"),
        ("resolution: [752, 480]", "resolution: [752]", "resolution"),
        ("- [0.0, 1.0, 0.0, 0.01]", "- [0.0, 2.0, 0.0, 0.01]", "no rotation"),
        ("- [0.0, 1.0, 0.0, 0.01]", "- [0.0, 1.0]", "T_cam_imu"),
        ("rostopic: /cam0/image_raw", "colour: red", "colour"),
        ("timeshift_cam_imu: 0.004", "estimate: [k4]", "k4"),
        ("timeshift_cam_imu: 0.004", "sigma: {f: -1}", "above 0"),
        ("timeshift_cam_imu: 0.004", "sigma: {warp: 1}", "warp"),
        ("timeshift_cam_imu: 0.004", "covariance: 3", "covariance"),
        ("timeshift_cam_imu: 0.004", "timeshift_cam_imu: soon", "soon"),
    ],
)  # fmt: skip
def test_what_is_no_rig_gets_one_sentence(tmp_path: Path, old: str, new: str, word: str) -> None:
    assert old in KALIBR
    with pytest.raises(ConfigError, match=f"rig.yaml: cam0.*{word}"):
        written(tmp_path, KALIBR.replace(old, new, 1))


def test_an_empty_rig_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no cameras"):
        written(tmp_path, "")
    with pytest.raises(ConfigError, match="cam0"):
        written(tmp_path, "cam0: 3\n")
