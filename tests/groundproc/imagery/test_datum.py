"""What all poses of a trajectory and its cloud are off together."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
import pytest
from imageblock import disturbed, fly, relief, site, true_camera, write_block

from flightlog.mount import Mount
from groundproc.cli import main
from groundproc.trajectory.covariance import uncorrelated
from groundproc.trajectory.estimate import Estimate, read_estimate, write_estimate

Array = npt.NDArray[np.float64]
SHIFT_M = np.array([0.012, -0.03, 0.02])
STATED_M = 0.02
STIFF_M = np.array([0.003, 0.003, 0.003])


def write_cloud(path: Path) -> None:
    """The ground as a lidar on that trajectory has it: shifted with it."""
    rng = np.random.default_rng(3)
    plan = np.column_stack([rng.uniform(-40, 150, 200_000), rng.uniform(-40, 140, 200_000)])
    places = np.column_stack([plan, relief(plan) + rng.normal(0, 0.01, len(plan))]) + SHIFT_M
    header = laspy.LasHeader(point_format=6, version="1.4")
    points = site().map(places)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(points.min(axis=0))
    header.add_crs(pyproj.CRS.from_epsg(32633))
    record = laspy.LasData(header)
    record.x, record.y, record.z = points.T
    record.write(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stiff trajectory, right to 3 mm in itself, that lies 4 cm off as a whole; its estimate says that it may by 2 cm."""
    folder = tmp_path_factory.mktemp("datum")
    truth = true_camera()
    flown = fly(truth, seed=3, points=500)
    stiff = disturbed(flown, 8, STIFF_M, np.array([0.005, 0.005, 0.005]))
    count = len(stiff)
    datum = np.diag([STATED_M**2] * 3 + [1e-8] * 3)
    stiff = replace(
        stiff,
        position_m=stiff.position_m + SHIFT_M,
        sigma_position_m=np.tile(np.hypot(STIFF_M, STATED_M), (count, 1)),
        correlation=uncorrelated(stiff.time_ns[::100]),
        datum=datum,
    )
    guess = replace(
        truth, sigma={"boresight_deg": 1.0, "timeshift_s": 0.1, "lever_arm_m": 0.005, "f": 10.0}, estimate=("f",)
    )
    write_block(flown, folder, guess, stiff, 0.3, 12)
    write_estimate(folder, Estimate(stiff, Mount(), "as drawn", method="adjusted"))
    write_cloud(folder / "cloud.laz")
    return folder


def adjusted(folder: Path, *more: str, control: str = "control.csv") -> dict[str, Any]:
    files = ("points.csv", "rig.yaml", "trajectory.csv", "times.csv", control)
    options = ("--image-points", "--rig", "--trajectory", "--times", "--control")
    words = [word for name, file in zip(options, files, strict=True) for word in (name, str(folder / file))]
    out = folder / f"out{len(more)}{control}"
    assert main(["images", *words, *more, "-o", str(out)]) in (0, 3)
    found: dict[str, Any] = json.loads((out / "bundle.json").read_text())
    return found


def check_errors(told: dict[str, Any]) -> tuple[Array, Array]:
    errors = np.array([[one["dx"], one["dy"], one["dz"]] for one in told["check"]])
    sigmas = np.array([[one["sx"], one["sy"], one["sz"]] for one in told["check"]])
    return errors, sigmas


def test_an_estimate_keeps_what_all_poses_share(folder: Path) -> None:
    datum = read_estimate(folder).trajectory.datum
    assert datum is not None
    np.testing.assert_array_equal(np.diag(datum), [STATED_M**2] * 3 + [1e-8] * 3)


@pytest.mark.parametrize(
    "cloud",
    [
        pytest.param(False, id="without lidar"),
        # with the cloud once more; in the quick suite the cloud moves with all of it (below)
        pytest.param(True, marks=pytest.mark.soak, id="with the cloud of that trajectory"),
    ],
)
def test_sigmas_of_points_hold_the_datum_of_the_trajectory(folder: Path, cloud: bool) -> None:
    told = adjusted(folder, *(("--cloud", str(folder / "cloud.laz")) if cloud else ()))
    assert 0.9 < told["sigma0"] < 1.1
    errors, sigmas = check_errors(told)
    # where it lies nobody can know; in itself the block is right, and it says both
    np.testing.assert_allclose(errors.mean(axis=0)[:2], SHIFT_M[:2], rtol=0, atol=0.008)
    assert (errors - errors.mean(axis=0)).std(axis=0)[:2].max() < 0.012
    assert (np.abs(errors) < 2.0 * sigmas).mean() > 0.9
    assert STATED_M < np.median(sigmas[:, :2]) < 1.5 * STATED_M


def test_control_moves_trajectory_cloud_and_block_together(folder: Path) -> None:
    """Four points of 1 cm against a hundred stiff poses and a cloud: without a datum these would win."""
    rows = (folder / "control.csv").read_text().splitlines()
    lines = [rows[0], *(row.replace(",check", ",control") if n % 5 == 0 else row for n, row in enumerate(rows[1:]))]
    (folder / "held.csv").write_text("\n".join(lines) + "\n")
    told = adjusted(folder, "--cloud", str(folder / "cloud.laz"), control="held.csv")
    errors, sigmas = check_errors(told)
    assert len(errors) == 16
    assert np.sqrt(np.mean(errors**2, axis=0)).max() < 0.016
    assert (np.abs(errors) < 2.0 * sigmas).mean() > 0.9
    found, sigma = np.array(told["trajectory_shift_m"]), np.array(told["trajectory_shift_sigma_m"])
    assert (np.abs(found - SHIFT_M) < 3.0 * sigma + 0.001).all()
    assert sigma.max() < 0.5 * STATED_M
