"""Wide images of a rig of four cameras, against what one camera in its middle would have seen."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rendered
from scipy import ndimage

from groundproc.cli import main
from groundproc.imagery.camera import Camera
from groundproc.imagery.painting.wide import nearest_rotation
from groundproc.imagery.poses import ImagePoses, read_poses, write_poses
from groundproc.imagery.rig import Rig, RigCamera, read_rig, write_rig
from groundproc.imagery.rotations import mat_world_camera

pytestmark = pytest.mark.filterwarnings("ignore:Dataset has no geotransform")

CAMERA = Camera(320, 240, 300.0, (158.0, 121.5), "radtan", (-0.08, 0.02, 0.0005, -0.0003))
TILTS = ((-14.0, -20.0), (-14.0, 20.0), (14.0, -20.0), (14.0, 20.0))
"""Omega and phi of each camera [deg]: a wide field from four."""
ARMS = ((-0.2, 0.1, 0.0), (0.2, 0.1, 0.02), (-0.2, -0.1, 0.0), (0.2, -0.1, -0.02))
PLACES = ((0.0, -6.0, 34.0), (-4.0, 5.0, 36.0))
START_NS = 1_700_000_000_000_000_000


def write_rig_flight(folder: Path) -> None:
    """Two instants of four cameras with exposures of their own, 3 ms between the first and the last; and one image alone."""
    folder.mkdir()
    names, places, angles, stamps = [], [], [], []
    for instant, middle in enumerate(PLACES):
        for number, (tilt, arm) in enumerate(zip(TILTS, ARMS, strict=True)):
            shot = rendered.Shot(np.add(middle, arm), (*tilt, 0.0), 0.8 + 0.1 * number)
            names.append(f"c{number}_{instant}.png")
            write_picture(folder / names[-1], rendered.picture(shot, CAMERA))
            places.append(shot.place_m)
            angles.append(shot.angles_deg)
            stamps.append(START_NS + instant * 10**9 + number * 10**6)
    names.append("c0_alone.png")
    write_picture(folder / names[-1], rendered.picture(rendered.Shot(np.array(PLACES[0]), (0.0, 0.0, 0.0)), CAMERA))
    places, angles, stamps = [*places, PLACES[0]], [*angles, (0.0, 0.0, 0.0)], [*stamps, START_NS + 5 * 10**9]
    nothing = np.full((len(names), 3), np.nan)
    write_poses(
        folder / "poses.csv",
        ImagePoses(tuple(names), np.array(stamps), np.array(places), np.deg2rad(angles), nothing, nothing),
    )
    write_rig(folder / "rig.yaml", Rig(tuple(RigCamera(f"c{n}", CAMERA, image_prefix=f"c{n}_") for n in range(4))))


def write_picture(path: Path, shown: np.ndarray) -> None:
    height, width, planes = shown.shape
    with rasterio.open(path, "w", driver="PNG", width=width, height=height, count=planes, dtype="uint8") as file:
        file.write(np.moveaxis(shown, -1, 0))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wide")
    write_rig_flight(folder / "images")
    measured, _ = rendered.points(60.0, 1)
    rendered.write_cloud(folder / "cloud.laz", measured, epsg=None)
    return folder


@pytest.fixture(scope="module")
def made(place: Path) -> Path:
    words = ["--images", str(place / "images"), "-o", str(place / "wide")]
    assert main(["wide", str(place / "cloud.laz"), *words]) == 0
    return place / "wide"


def test_it_shows_what_one_camera_in_the_middle_would_have_seen(made: Path) -> None:
    """Compared away from edges of the box, where one pixel decides between roof and ground; no part is off by half a pixel."""
    poses, camera = read_poses(made / "poses.csv"), read_rig(made / "rig.yaml").cameras[0].camera
    assert len(poses) == 2
    for number, name in enumerate(poses.images):
        np.testing.assert_allclose(poses.place_m[number], PLACES[number], rtol=0, atol=0.01)
        with rasterio.open(made / name) as file:
            shown = np.moveaxis(file.read(), 0, -1) / 255.0
        shot = rendered.Shot(poses.place_m[number], tuple(np.rad2deg(poses.angles_rad[number])))
        truth = rendered.picture(shot, camera) / 255.0
        row, column = np.mgrid[: camera.height_px, : camera.width_px]
        rays, _ = camera.unproject(np.stack([column.ravel(), row.ravel()], axis=1).astype(float))
        world = rays @ mat_world_camera(*poses.angles_rad[number][:, None])[0].T
        distance, _ = rendered.hit(poses.place_m[number], world)
        depth = distance.reshape(camera.height_px, camera.width_px)
        jump = ndimage.maximum_filter(depth, 3) - ndimage.minimum_filter(depth, 3) > 1.0
        plain = ~ndimage.binary_dilation(jump, iterations=4)
        at = shot.place_m + world * distance[:, None]
        covered = ((np.abs(at[:, 0]) < 24.0) & (np.abs(at[:, 1]) < 19.0)).reshape(depth.shape)
        seen = (shown > 0).all(axis=-1)
        assert seen[covered & plain].mean() > 0.97
        some = seen & plain & covered
        factor = np.median((shown / np.maximum(truth, 0.01))[some], axis=0)
        error = shown / factor - truth
        assert np.sqrt((error[some] ** 2).mean()) < 0.012
        slope = np.stack(np.gradient(truth[..., 0]), axis=-1)[some]
        shift, *_ = np.linalg.lstsq(slope, error[..., 0][some], rcond=None)
        assert np.abs(shift).max() < 0.3


def test_figures_tell_what_it_is_made_of(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = json.loads((made / "wide.json").read_text())
    assert told["cameras"] == ["c0", "c1", "c2", "c3"]
    assert told["sources"][0] == [f"c{n}_0.png" for n in range(4)]
    assert told["alone"] == 1
    assert told["bands"] == ["red", "green", "blue"]
    assert told["spread_deg"] < 1e-4
    # 40 deg between the axes, and the width of a picture
    assert 90.0 < told["field_deg"] < 105.0


def test_cameras_that_expose_apart_make_no_wide_image(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--images", str(place / "images"), "--within", "0.0001", "-o", str(tmp_path / "out")]
    assert main(["wide", str(place / "cloud.laz"), *words]) == 2
    told = capsys.readouterr().err
    assert "no two cameras expose within 0.0001 s" in told
    assert told.count("\n") == 1


def test_the_nearest_rotation_of_a_mean_is_between() -> None:
    one, other = (mat_world_camera(*np.deg2rad([[a], [0.0], [0.0]]))[0] for a in (10.0, 20.0))
    between = mat_world_camera(*np.deg2rad([[15.0], [0.0], [0.0]]))[0]
    np.testing.assert_allclose(nearest_rotation(one + other), between, rtol=0, atol=1e-12)
