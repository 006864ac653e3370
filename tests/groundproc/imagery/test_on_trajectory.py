"""A block on a trajectory with known truth: what is observed, and what is not known before, comes out within its sigmas."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
import pytest
from imageblock import Flown, disturbed, fly, relief, site, true_camera, write_block

from flightlog import frames
from groundproc.cli import main
from groundproc.imagery.flown import stations_of
from groundproc.imagery.rig import Rig, RigCamera, read_rig
from groundproc.imagery.rotations import STRAIGHT_DOWN

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Flown]:
    folder = tmp_path_factory.mktemp("block")
    truth = true_camera(line_delay_s=2e-5)
    flown = fly(truth, seed=3)
    trajectory = disturbed(flown, 8, np.array([0.02, 0.02, 0.03]), np.array([0.05, 0.05, 0.1]))
    lens = replace(truth.camera, focal_px=1310.0, centre_px=(799.5, 599.5), coefficients=(-0.04, 0.01))
    guess = replace(
        truth, camera=lens, mat_cam_ins=STRAIGHT_DOWN.copy(), origin_cam_m=-STRAIGHT_DOWN @ np.array([0.05, 0.10, -0.08]),
        timeshift_s=0.0, estimate=("f", "pu", "pv", "k1", "k2"), sigma={"f": 20.0, "pu": 10.0, "pv": 10.0},
    )  # fmt: skip
    write_block(flown, folder, guess, trajectory, 0.5, 12)
    rng = np.random.default_rng(3)
    plan = np.column_stack([rng.uniform(-40, 150, 300_000), rng.uniform(-40, 140, 300_000)])
    cloud = site().map(np.column_stack([plan, relief(plan) + rng.normal(0, 0.02, len(plan))]))
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(cloud.min(axis=0))
    header.add_crs(pyproj.CRS.from_epsg(32633))
    record = laspy.LasData(header)
    record.x, record.y, record.z = cloud.T
    record.write(folder / "cloud.laz")
    return folder, flown


def adjusted(folder: Path, *more: str) -> tuple[dict[str, Any], RigCamera]:
    given = (
        ("image-points", "points.csv"),
        ("rig", "rig.yaml"),
        ("trajectory", "trajectory.csv"),
        ("times", "times.csv"),
    )
    words = [word for name, file in (*given, ("control", "control.csv")) for word in (f"--{name}", str(folder / file))]
    out = folder / "-".join(["out", *(Path(word).stem for word in more)])
    assert main(["images", *words, *more, "-o", str(out)]) == 0
    return json.loads((out / "bundle.json").read_text()), read_rig(out / "rig.yaml").cameras[0]


def check_errors(told: dict[str, Any]) -> tuple[Array, Array]:
    errors = np.array([[one["dx"], one["dy"], one["dz"]] for one in told["check"]])
    sigmas = np.array([[one["sx"], one["sy"], one["sz"]] for one in told["check"]])
    return errors, sigmas


def check_camera(found: RigCamera, truth: RigCamera) -> None:
    """Everything within three of its sigmas."""
    assert found.spread is not None
    spread = found.spread
    turn = frames.quat_log(frames.quat_from_mat(found.mat_cam_ins @ truth.mat_cam_ins.T))
    off = dict(zip(("boresight_x", "boresight_y", "boresight_z"), turn, strict=True))
    off |= dict(zip(("lever_x", "lever_y", "lever_z"), found.lever_arm_m - truth.lever_arm_m, strict=True))
    off["timeshift"] = found.timeshift_s - truth.timeshift_s
    values = truth.camera.values()
    off |= {name: value - values[name] for name, value in found.camera.values().items() if name in spread.unknowns}
    for name, value in off.items():
        sigma = spread.sigma(name)
        assert sigma is not None, name
        assert abs(value) < 3.3 * sigma, (name, value, sigma)


def test_camera_clock_and_mounting_are_found_without_control(block: tuple[Path, Flown]) -> None:
    folder, flown = block
    told, camera = adjusted(folder)
    assert 0.9 < told["sigma0"] < 1.1
    assert [one["accepted"] for one in told["held_out"]] == [True, True]
    check_camera(camera, flown.camera)
    errors, sigmas = check_errors(told)
    assert len(errors) == 20
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert max(rms[:2]) < 0.03
    assert rms[2] < 0.1
    assert (np.abs(errors) < 2.0 * sigmas).mean() > 0.85


def test_the_lidar_s_surface_holds_heights_and_focal_length(block: tuple[Path, Flown]) -> None:
    folder, flown = block
    told, camera = adjusted(folder, "--cloud", str(folder / "cloud.laz"))
    assert told["crs"] == "EPSG:32633"
    assert 0.9 < told["sigma0"] < 1.1
    check_camera(camera, flown.camera)
    errors, sigmas = check_errors(told)
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert max(rms[:2]) < 0.02
    assert rms[2] < 0.03
    assert (np.abs(errors) < 2.0 * sigmas).mean() > 0.85
    assert abs(camera.camera.focal_px / 1300.0 - 1.0) < 5e-4


def test_images_outside_of_the_flight_are_named_and_the_rest_goes_on(
    block: tuple[Path, Flown], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = block
    for name in ("points.csv", "rig.yaml", "trajectory.csv", "control.csv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    with (folder / "times.csv").open() as file:
        rows = list(csv.reader(file))
    rows[3][1] = str(int(rows[3][1]) + 3600 * 10**9)
    (tmp_path / "times.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    words = ["--image-points", "--rig", "--trajectory", "--times"]
    files = ["points.csv", "rig.yaml", "trajectory.csv", "times.csv"]
    given = [part for word, file in zip(words, files, strict=True) for part in (word, str(tmp_path / file))]
    assert main(["images", *given, "-o", str(tmp_path / "out")]) == 3
    told = json.loads((tmp_path / "out" / "bundle.json").read_text())
    assert told["counts"]["images"] == 23
    assert list(told["left_out"]) == [rows[3][0]]
    assert "outside of the trajectory" in capsys.readouterr().err


def test_poses_of_a_block_begin_another_one_and_are_no_observations(block: tuple[Path, Flown]) -> None:
    folder, _ = block
    adjusted(folder, "--hybrid-every", "5")
    before = folder / "out---hybrid-every-5"
    words = ["--image-points", folder / "points.csv", "--rig", folder / "rig.yaml", "--start", before / "poses.csv"]
    assert main(["images", *map(str, words), "-o", str(folder / "free")]) == 0
    told, known = (json.loads((out / "bundle.json").read_text()) for out in (folder / "free", before))
    counts, free = told["counts"], 5
    assert counts["images"] == known["counts"]["images"]
    assert told["unknowns"] == 6 * counts["images"] + 3 * counts["points"] + free - 7
    assert told["observations"] == counts["image_rows"] + counts["camera_rows"]
    assert 0.9 < told["sigma0"] < 1.1


def test_stamps_of_whole_seconds_count_for_the_way_of_a_second(block: tuple[Path, Flown]) -> None:
    """Variance along the way of what is cut off, 6 m/s, six images cut alike, and little across it."""
    _, flown = block
    rig, none = Rig((flown.camera,)), np.zeros(len(flown.stamp_ns), np.int64)
    known = disturbed(flown, 8, np.array([0.02, 0.02, 0.03]), np.array([0.05, 0.05, 0.1]))
    whole, fine = (
        stations_of(known, rig, none, flown.stamp_ns // 10**9 * 10**9, cut)[0].priors.covariance
        for cut in (True, False)
    )
    grown = (whole - fine)[len(whole) // 2]
    assert np.sqrt(grown[0, 0]) == pytest.approx(6.0 * (6.0 * 0.08) ** 0.5, rel=0.05)
    assert grown[1, 1] < 0.01 * grown[0, 0]
