"""What an autopilot notes of exposures, in every kind of log, against the simulator's truth."""

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from flightlog.errors import CaptureError
from groundproc.cli import main
from groundproc.imagery.exposures import exposures_of, of_flight
from groundproc.imagery.poses import NO_TIME, read_poses
from groundproc.imagery.rig import read_rig
from groundproc.imagery.session import Task, begin
from groundproc.imagery.site import georeferenced
from groundproc.imagery.tables import read_control, read_marks
from groundproc.imagery.times import by_camera, times_of
from simulator.cameras import CameraOptions
from simulator.config import Options
from simulator.render import render
from simulator.simulation import Job, Simulation

CAMERA = CameraOptions(width_px=64, height_px=48, focal_px=50.0, interval_s=0.7, feedback_lost=0.3, samples=1)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Simulation]:
    folder = tmp_path_factory.mktemp("flown")
    options = Options()
    options = replace(options, lidar=replace(options.lidar, dark=True), flight=replace(options.flight, higher_m=12.0))
    rig = {"a": CAMERA, "b": replace(CAMERA, interval_s=1.1, feedback_lost=0.0, clock_offset_s=3601.2)}
    return folder, render(Job("field", 14.0, 4, folder, options, 1, cameras=rig))


@pytest.mark.parametrize(("name", "within_s"), [("flight.mcap", 1e-6), ("telemetry.tlog", 1e-6), ("board.bin", 0.13)])
def test_every_log_tells_when_the_cameras_exposed(flown: tuple[Path, Simulation], name: str, within_s: float) -> None:
    """The card's clock is tied by fixes that come in 0.12 s after their epoch: a constant, which a block estimates.

    It is 12 ppm slow, which a line tells only from a minute on.
    """
    folder, simulation = flown
    noted = exposures_of(folder / name)
    assert noted is not None
    pairs = sorted((int(simulation.clocks.utc.shows_ns(e.time_s)) // 1000 * 1000, e.camera) for e in simulation.noted)
    true_ns = np.array([time_ns for time_ns, _ in pairs])
    np.testing.assert_array_equal(noted.camera, [camera for _, camera in pairs])
    off_s = (noted.utc_ns - true_ns) * 1e-9
    assert np.ptp(off_s) < 14 * 12e-6 + 2e-6
    assert np.abs(off_s).max() < within_s


def test_images_of_two_cameras_get_their_own_exposures_and_those_that_were_not_noted_their_own_clock_s(
    flown: tuple[Path, Simulation],
) -> None:
    folder, simulation = flown
    taken = simulation.studio.exposures
    true_ns = simulation.clocks.utc.shows_ns(np.array([one.time_s for one in taken]))
    camera = np.array([one.camera for one in taken])
    shift_ns = np.where(camera == 0, 50_000_000, 3_601_200_000_000)
    exif_ns = (true_ns + shift_ns) // 1_000_000 * 1_000_000
    timed = times_of(folder / "flight.mcap", [simulation.studio.name_of(one) for one in taken], exif_ns, camera)
    assert 0 < timed.own.sum() == len(taken) - len(simulation.noted)
    off_ns = np.abs(timed.utc_ns - true_ns)
    assert off_ns[~timed.own].max() <= 1_000
    assert off_ns[timed.own].max() <= 2_000_000
    assert timed.offset_s == pytest.approx(-0.05, abs=1e-3)


def test_the_parts_of_a_flight_are_one_and_each_exposure_counts_once(flown: tuple[Path, Simulation]) -> None:
    folder, _ = flown
    log = folder / "flight.mcap"
    once, twice = exposures_of(log), of_flight((log, folder / "telemetry.tlog", log))
    assert once is not None
    assert twice is not None
    np.testing.assert_array_equal(twice.utc_ns, once.utc_ns)
    np.testing.assert_array_equal(twice.camera, once.camera)
    assert of_flight(()) is None


def test_a_trajectory_goes_with_the_exposures_that_the_logs_of_its_flight_note(flown: tuple[Path, Simulation]) -> None:
    """Camera b shows another hour: its own clock would put its images an hour off."""
    folder, simulation = flown
    images = folder / "images"
    given = {"trajectory": folder / "truth.csv", "rig": images / "rig.yaml"}
    session = begin(
        Task(folder / "out", (images,), **given, noted=(folder / "flight.mcap",)), lambda stage, count: None
    )
    true_ns = {
        simulation.studio.name_of(one): int(simulation.clocks.utc.shows_ns(one.time_s))
        for one in simulation.studio.exposures
    }
    off_ns = [
        abs(time_ns - true_ns[name]) for name, time_ns in zip(session.names, session.time_ns.tolist(), strict=True)
    ]
    assert max(off_ns) <= 2_000_000
    assert session.timed is not None
    assert "CAMERA_FEEDBACK" in session.timed.note


def test_two_cameras_on_one_trigger_expose_together(flown: tuple[Path, Simulation]) -> None:
    folder, _ = flown
    noted = exposures_of(folder / "flight.mcap")
    assert noted is not None
    single = replace(noted, camera=np.zeros_like(noted.camera))
    both = np.unique(single.utc_ns)
    exif_ns = np.concatenate([both, both + 5 * 10**9])
    timed = by_camera(single, exif_ns, np.repeat([0, 1], len(both)), "x")
    np.testing.assert_array_equal(timed.utc_ns, np.tile(both, 2))


def tlog(path: Path, messages: list[Any]) -> Path:
    packer = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    data = b""
    for n, message in enumerate(messages):
        data += struct.pack(">Q", 1_700_000_000_000_000 + n * 1000) + message.pack(packer)
    path.write_bytes(data)
    return path


def test_triggers_since_boot_are_tied_to_utc_by_system_time(tmp_path: Path) -> None:
    utc_us = 1_700_000_000_000_000
    messages: list[object] = [
        ardupilotmega.MAVLink_system_time_message(utc_us + n * 1_000_000, 60_000 + n * 1_000) for n in range(3)
    ]
    messages += [ardupilotmega.MAVLink_camera_trigger_message(61_500_000 + n * 2_000_000, n) for n in range(4)]
    noted = exposures_of(tlog(tmp_path / "a.tlog", messages))
    assert noted is not None
    assert noted.source == "CAMERA_TRIGGER"
    assert noted.utc_ns.tolist() == [(utc_us + 1_500_000 + n * 2_000_000) * 1000 for n in range(4)]


def test_messages_that_a_link_repeats_count_once(tmp_path: Path) -> None:
    one = ardupilotmega.MAVLink_camera_feedback_message(
        1_700_000_000_000_000, 1, 0, 1, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
    )
    noted = exposures_of(tlog(tmp_path / "a.tlog", [one, one]))
    assert noted is not None
    assert len(noted.utc_ns) == 1


def test_a_log_without_exposures_is_named(tmp_path: Path) -> None:
    path = tlog(tmp_path / "a.tlog", [ardupilotmega.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)])
    with pytest.raises(CaptureError, match=r"a\.tlog: notes no exposures; expected CAMERA_FEEDBACK"):
        times_of(path, ["a", "b"], np.full(2, NO_TIME))


def test_positions_without_a_log_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rtk.pos").write_text("")
    assert main(["images", str(tmp_path), "--positions", str(tmp_path / "rtk.pos"), "-o", str(tmp_path / "out")]) == 2
    assert "--positions: nothing uses it without a flight log" in capsys.readouterr().err


def test_the_simulator_s_poses_rig_and_marks_agree_with_the_geometry_of_this_room(
    flown: tuple[Path, Simulation],
) -> None:
    """Two lens models, two map projections and two conventions of angles, written apart, put points on the same pixels."""
    images = flown[0] / "images"
    poses, rig = read_poses(images / "truth" / "poses.csv"), read_rig(images / "truth" / "rig.yaml")
    control, marks = read_control(images / "control.csv"), read_marks(images / "marks.csv")
    site = georeferenced(32633, control.place_m)
    place, points = site.local(poses.place_m), site.local(control.place_m)
    mat = site.mat_local_grid(place) @ poses.mat_grid_camera()
    image = np.array([poses.images.index(name) for name in marks.image])
    point = np.array([control.name.index(name) for name in marks.point])
    seen = np.einsum("nji,nj->ni", mat[image], points[point] - place[image])
    for camera in rig.cameras:
        own = np.array([camera.takes(name) for name in marks.image])
        pixels, reached = camera.camera.project(seen[own])
        assert reached.sum() > 30
        off = (pixels - marks.pixel[own]) / marks.sigma_px[own, None]
        assert np.abs(off.mean(axis=0)).max() < 4.0 / np.sqrt(own.sum())
        assert np.abs(off.std(axis=0) - 1.0).max() < 4.0 / np.sqrt(2.0 * own.sum())
