"""Cameras: pixels where geometry says, files as cameras write them, and the autopilot's notes of exposures."""

import csv
import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pyproj
import pytest
import yaml
from PIL import Image
from pymavlink import mavutil

from flightlog.errors import ConfigError, UsageError
from simulator import cameras
from simulator.cameras import CameraOptions, built
from simulator.config import Options
from simulator.grid import ZONE_EPSG, on_grid
from simulator.optics import EQUIDISTANT, Lens, rays
from simulator.render import render
from simulator.simulation import Job, Simulation
from simulator.textures import BANDS, LOOKS, TABLE

SMALL = CameraOptions(width_px=240, height_px=180, focal_px=190.0, interval_s=1.0, first_s=1.5, line_delay_s=2e-4)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Simulation]:
    folder = tmp_path_factory.mktemp("flown")
    options = Options()
    options = replace(
        options,
        lidar=replace(options.lidar, dark=True),
        flight=replace(options.flight, higher_m=12.0),
        rtk=replace(options.rtk, hz=5.0),
        mount=replace(options.mount, gps_position_m=(0.0, 0.0, 0.3)),
    )
    thermal = replace(SMALL, bands=("temperature",), feedback=False)
    rig = {"rgb": replace(SMALL, feedback_delay_s=0.02), "warm": thermal}
    return folder, render(Job("field", 8.0, 3, folder, options, 1, cameras=rig))


@pytest.mark.parametrize(
    "lens",
    [
        Lens("radtan", 300.0, (158.0, 121.0), (-0.12, 0.03, 0.001, -0.002, 0.004)),
        Lens(EQUIDISTANT, 160.0, (161.0, 118.0), (-0.02, 0.004, -0.001, 0.0002)),
    ],
)
def test_lenses_are_those_of_opencv_and_rays_go_back_to_their_pixels(lens: Lens) -> None:
    out = np.empty((240 * 320, 3))
    rays(lens.model == EQUIDISTANT, lens.numbers(), 0, np.tile(np.eye(3), (240, 1, 1)), 320, 1, out)
    row, column = np.mgrid[:240, :320]
    np.testing.assert_allclose(lens.project(out), np.column_stack([column.ravel(), row.ravel()]), rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1.0, rtol=0, atol=1e-12)
    points = out[::997] * 7.0
    matrix = np.array(
        [[lens.focal_px, 0.0, lens.centre_px[0]], [0.0, lens.focal_px, lens.centre_px[1]], [0.0, 0.0, 1.0]]
    )
    if lens.model == EQUIDISTANT:
        found = cv2.fisheye.projectPoints(
            points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(lens.coefficients)
        )[0]
    else:
        found = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(lens.coefficients))[0]
    np.testing.assert_allclose(lens.project(points), found[:, 0], rtol=0, atol=1e-6)


def test_map_coordinates_are_those_of_proj() -> None:
    transformer = pyproj.Transformer.from_crs(4326, ZONE_EPSG, always_xy=True)
    latitude, longitude = np.array([58.394, 57.0, 60.1]), np.array([15.574, 12.2, 17.9])
    np.testing.assert_allclose(
        np.array(on_grid(latitude, longitude)), np.array(transformer.transform(longitude, latitude)), rtol=0, atol=1e-4
    )


def test_every_material_has_a_look() -> None:
    assert {material.name for material in TABLE} == set(LOOKS)


def test_marks_lie_where_the_picture_shows_their_points(flown: tuple[Path, Simulation]) -> None:
    """The reference is the ray through each pixel, which knows nothing of projections."""
    _, simulation = flown
    studio = simulation.studio
    one = studio.exposures[4]
    camera = studio.cameras[one.camera]
    place, mat = studio.poses(camera, studio.row_times_s(one))
    row = 150
    out = np.empty((240, 3))
    rays(False, camera.lens.numbers(), row, mat[row : row + 1], 240, 1, out)
    ground = place[row] + out * (-place[row, 2] / out[:, 2])[:, None]
    pixels = studio.pixels_of(one, ground)
    seen = np.isfinite(pixels).all(axis=1)
    assert seen.sum() > 200
    np.testing.assert_allclose(
        pixels[seen], np.column_stack([np.arange(240), np.full(240, row)])[seen], rtol=0, atol=0.02
    )


def test_files_are_those_of_a_camera_with_a_clock_of_its_own(flown: tuple[Path, Simulation]) -> None:
    folder, simulation = flown
    truth = json.loads((folder / "truth.json").read_text())
    files = sorted(path.name for path in (folder / "images").glob("rgb_*.jpg"))
    assert len(files) == truth["cameras"]["rgb"]["images"] == 7
    one = next(e for e in simulation.studio.exposures if simulation.studio.name_of(e) == files[2])
    with Image.open(folder / "images" / files[2]) as image:
        detail = image.getexif().get_ifd(0x8769)
        assert image.size == (240, 180)
        assert np.asarray(image).std() > 5.0
    stamp = datetime.strptime(detail[0x9003], "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC).timestamp() + float(
        "0." + detail[0x9291]
    )
    true_s = simulation.clocks.utc.start_ns * 1e-9 + one.time_s
    assert stamp - true_s == pytest.approx(0.05, abs=0.0011)


def test_thermal_pictures_are_degrees(flown: tuple[Path, Simulation]) -> None:
    folder, _ = flown
    rig = yaml.safe_load((folder / "images" / "rig.yaml").read_text())
    with Image.open(folder / "images" / "warm_0003.png") as image:
        numbers = np.asarray(image).astype(float)
    degrees = rig["warm"]["response"]["scale"] * numbers + rig["warm"]["response"]["offset"]
    grass = LOOKS["grass"].celsius
    assert degrees.mean() == pytest.approx(grass, abs=1.5)


def test_the_autopilot_notes_each_exposure_on_the_link_and_on_its_card(flown: tuple[Path, Simulation]) -> None:
    folder, simulation = flown
    wanted = [e for e in simulation.studio.exposures if e.camera == 0]
    noted_us = [int(simulation.clocks.utc.shows_ns(e.time_s + 0.02)) // 1000 for e in wanted]
    log = mavutil.mavlink_connection(str(folder / "telemetry.tlog"))
    found = []
    while (message := log.recv_match(type="CAMERA_FEEDBACK")) is not None:
        found.append(message)
    log.close()
    assert [m.time_usec for m in found] == noted_us
    assert [m.img_idx for m in found] == [e.number for e in wanted]
    card = mavutil.mavlink_connection(str(folder / "board.bin"))
    rows = []
    while (message := card.recv_match(type="CAM")) is not None:
        rows.append(message)
    card.data_map.close()
    card.filehandle.close()
    boot_us = [int(simulation.clocks.boot.shows_ns(e.time_s + 0.02)) // 1000 for e in wanted]
    assert [row.TimeUS for row in rows] == boot_us


def test_check_points_are_seen_and_surveyed(flown: tuple[Path, Simulation]) -> None:
    folder, simulation = flown
    with (folder / "images" / "control.csv").open() as file:
        control = list(csv.DictReader(file))
    with (folder / "images" / "marks.csv").open() as file:
        marks = list(csv.DictReader(file))
    assert len(control) >= 8
    for row in control:
        assert sum(mark["point"] == row["name"] for mark in marks) >= 3
        # the field lies at height 0 of the local frame; the earth falls away by less than a millimetre
        assert float(row["z"]) == pytest.approx(simulation.origin.height_msl_m, abs=2e-3)


def test_rtk_positions_are_those_of_the_antenna(flown: tuple[Path, Simulation]) -> None:
    folder, simulation = flown
    rows = [line.split() for line in (folder / "rtk.pos").read_text().splitlines() if not line.startswith("%")]
    assert len(rows) == 40
    heights = np.array([float(row[4]) for row in rows])
    time_s = np.arange(40) / 5.0
    poses = simulation.flight.poses(time_s)
    antenna = poses.position_m + poses.mat_local_ins() @ np.array([0.0, 0.0, 0.3])
    off = heights - antenna[:, 2] - simulation.origin.height_msl_m - simulation.origin.undulation_m
    assert np.abs(off).max() < 0.15


def test_a_flight_without_cameras_is_the_same_flight(tmp_path: Path, flown: tuple[Path, Simulation]) -> None:
    folder, simulation = flown
    render(replace(simulation.job, directory=tmp_path, cameras={}))
    assert (tmp_path / "capture.pcap").read_bytes() == (folder / "capture.pcap").read_bytes()
    assert (tmp_path / "truth.csv").read_bytes() == (folder / "truth.csv").read_bytes()
    assert not (tmp_path / "images").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rgb: {bands: [red, violet, blue]}", "expected one or three of red"),
        ("rgb: {bands: [temperature, red, green]}", "expected it alone"),
        ("rgb: {distortion_coeffs: [1, 2, 3, 4, 5, 6]}", "expected 5 at most"),
        ("my camera: {}", "expected letters and digits"),
        ("[]", "holds no cameras"),
    ],
)
def test_a_rig_that_cannot_be_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        cameras.rig(str(tmp_path / "rig.yaml"))


def test_a_rig_that_is_not_there_is_refused() -> None:
    with pytest.raises(UsageError, match="known are four, rgb, small"):
        cameras.rig("nothing")


@pytest.mark.parametrize("name", cameras.names())
def test_named_rigs_can_be_built(name: str) -> None:
    for camera, options in cameras.rig(name).items():
        one = built(camera, options, 4)
        assert set(one.options.bands) <= set(BANDS)
        np.testing.assert_allclose(one.mat_cam_ins @ one.mat_cam_ins.T, np.eye(3), rtol=0, atol=1e-12)
