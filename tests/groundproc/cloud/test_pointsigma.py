"""Sigmas of points against draws of the errors that they are made of, and against the simulator's truth."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import laspy
import numpy as np
import numpy.typing as npt
import pytest
from truepoints import compared, shares, sizes

from flightlog import frames, hdl32e
from flightlog.constants import HOUR_NS
from flightlog.logfile import LogReader
from flightlog.mount import LidarMount, Mount
from groundproc.accuracy.truth import read_truth
from groundproc.cli import main
from groundproc.cloud.pointsigma import LARGEST_M, Errors, MountErrors
from groundproc.flight.flight import read_flight
from groundproc.flight.pairing import legs
from groundproc.geodesy import LocalFrame
from groundproc.numerics.robust import sigma
from groundproc.sensors.model import Ranging
from groundproc.survey import Survey
from groundproc.trajectory.covariance import Correlation
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from conftest import Simulated

Array = npt.NDArray[np.float64]

FRAME = LocalFrame(58.394, 15.574, 61.3)
START_NS = 1_779_272_223_000_000_000
MOUNT = Mount(LidarMount((0.1, 0.2, -0.16), 3.0, -20.0, 2.0))
RANGING = Ranging(0.015, 2.79e-3, 0.6)
"""Of an HDL-32E, but that its angles are taken for exact."""
EXACT = Ranging(1e-9, 0.0, 0.6)
FIRM = MountErrors(np.zeros(3), np.zeros(3))
DRAWS = 40_000


def quat_wxyz(heading: Array, pitch: Array, roll: Array) -> Array:
    return np.asarray(frames.quat_from_mat(frames.mat_local_ins(heading, pitch, roll)))


def standing(sigma: Array, matrix: Array, attitude: tuple[float, float, float]) -> Trajectory:
    """A second on the spot, the covariance of its pose given by sigmas and correlations."""
    time_ns = START_NS + np.array([0, 10**9], np.int64)
    zero = np.zeros((2, 3))
    quat = np.tile(quat_wxyz(*(np.array([each]) for each in attitude))[0], (2, 1))
    return Trajectory(
        FRAME, time_ns, np.tile([5.0, -3.0, 40.0], (2, 1)), zero, quat, zero, np.tile(sigma[:3], (2, 1)),
        np.tile(sigma[3:], (2, 1)), np.array([True, False]), correlation=Correlation(time_ns, np.tile(matrix, (2, 1, 1))),
    )  # fmt: skip


def correlated(rng: np.random.Generator) -> Array:
    """A correlation matrix with nothing near zero."""
    root = rng.normal(size=(6, 4))
    full = root @ root.T + 0.2 * np.eye(6)
    scale = np.sqrt(np.diag(full))
    return np.asarray(full / scale[:, None] / scale)


def sensor_at(attitude: Array, position: Array, turn: Array | None = None) -> tuple[Array, Array]:
    """Matrices "local from sensor" and places of the sensor, for attitudes (roll, pitch, heading), shape (n, 3)."""
    mat = frames.mat_local_ins(attitude[:, 2], attitude[:, 1], attitude[:, 0])
    place = position + mat @ MOUNT.lidar_position_m()
    sensor = mat @ MOUNT.mat_ins_lidar()
    if turn is not None:  # small, about the sensor's own axes
        x, y, z = turn.T
        zero = np.zeros_like(x)
        cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
        sensor = sensor @ (np.eye(3) + cross)
    return sensor, place


def sigma_of(
    trajectory: Trajectory, xyz: Array, ranging: Ranging, mount_errors: MountErrors = FIRM, slant: float | None = None
) -> tuple[float, float]:
    """What is said of a point of the middle of the second."""
    time_ns = np.array([START_NS + 500_000_000])
    attitude = trajectory.at(time_ns)
    mat = frames.mat_from_quat(attitude.quat_local_ins_wxyz)
    origin = attitude.position_m + mat @ MOUNT.lidar_position_m()
    errors = Errors.of(time_ns, trajectory, MOUNT, mount_errors)
    told = None if slant is None else np.array([slant], np.float32)
    horizontal, vertical = errors.sigmas_m(xyz[None], time_ns, origin, ranging, told)
    return float(horizontal[0]), float(vertical[0])


@pytest.mark.parametrize("seed", range(4))
def test_pose_and_boresight_move_a_point_as_draws_of_their_errors_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    attitude = np.array([rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), rng.uniform(0, 6.2)])  # roll, pitch, heading
    sigma = np.array([1.3, 0.7, 2.1, 0.02, 0.03, 0.05])
    matrix = correlated(rng)
    turn_rad = np.array([0.01, 0.03, 0.02])
    beam = rng.normal(size=3) * [1, 1, 0.4]
    beam *= rng.uniform(5, 80) / np.linalg.norm(beam)
    trajectory = standing(sigma, matrix, (attitude[2], attitude[1], attitude[0]))
    position = np.array([5.0, -3.0, 40.0])
    error = rng.multivariate_normal(np.zeros(6), matrix * sigma[:, None] * sigma, DRAWS)
    mats, places = sensor_at(attitude + error[:, 3:], position + error[:, :3], rng.normal(size=(DRAWS, 3)) * turn_rad)
    drawn = mats @ beam + places
    mats, places = sensor_at(attitude[None], position[None])
    true = mats[0] @ beam + places[0]
    spread = (drawn - true).std(axis=0)
    told = sigma_of(trajectory, true, EXACT, MountErrors(turn_rad, np.zeros(3)))
    # draws tell a sigma to 1 / sqrt(2 n), 0.35 %; turns of 0.05 rad are linear to 0.05^2; two digits are told: 5 % at worst
    assert told[0] == pytest.approx(np.sqrt(0.5 * (spread[0] ** 2 + spread[1] ** 2)), rel=0.06)
    assert told[1] == pytest.approx(spread[2], rel=0.06)


@pytest.mark.parametrize("range_m", [5.0, 30.0, 90.0])
@pytest.mark.parametrize("down_deg", [0.0, 35.0, 80.0])
def test_range_and_footprint_move_a_point_as_draws_of_them_do(range_m: float, down_deg: float) -> None:
    rng = np.random.default_rng(1)
    down = np.deg2rad(down_deg)
    unit = np.array([np.cos(down) * 0.6, np.cos(down) * 0.8, -np.sin(down)])
    aside = np.cross(unit, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    # a uniform disc of the beam's width, and a range of its noise
    within = np.sqrt(rng.random(DRAWS)) * 0.5 * RANGING.divergence_rad
    angle = rng.uniform(0, 2 * np.pi, DRAWS)
    across = within[:, None] * (np.cos(angle)[:, None] * aside + np.sin(angle)[:, None] * np.cross(unit, aside))
    away = rng.normal(range_m, RANGING.sigma_m, DRAWS)
    spread = (away[:, None] * (unit + across) - range_m * unit).std(axis=0)
    trajectory = standing(np.zeros(6), np.eye(6), (0.0, 0.0, 0.0))
    origin = np.array([5.0, -3.0, 40.0]) + MOUNT.lidar_position_m()
    told = sigma_of(trajectory, origin + range_m * unit, RANGING)
    # in a file a sigma is a whole number of millimetres
    assert told[0] == pytest.approx(np.sqrt(0.5 * (spread[0] ** 2 + spread[1] ** 2)), abs=0.0006, rel=0.06)
    assert told[1] == pytest.approx(spread[2], abs=0.0006, rel=0.06)


@pytest.mark.parametrize("range_m", [10.0, 60.0])
def test_a_surface_fills_the_beam_and_only_its_angles_err(range_m: float) -> None:
    trajectory = standing(np.zeros(6), np.eye(6), (0.0, 0.0, 0.0))
    origin = np.array([5.0, -3.0, 40.0]) + MOUNT.lidar_position_m()
    steps = replace(RANGING, pointing_rad=1e-3)  # so coarse that it is seen beside the range
    level = sigma_of(trajectory, origin + np.array([range_m, 0.0, 0.0]), steps, slant=0.0)
    # along the beam the range, across it the angle: east, and north and up
    assert level[0] == pytest.approx(np.sqrt(0.5 * (0.015**2 + (1e-3 * range_m) ** 2)), rel=0.06)
    assert level[1] == pytest.approx(1e-3 * range_m, rel=0.06)
    assert sigma_of(trajectory, origin + np.array([range_m, 0.0, 0.0]), RANGING, slant=0.0)[1] == 0.0


def test_on_a_road_the_place_within_the_footprint_does_not_show(monterey_log: Path, tmp_path: Path) -> None:
    """A real HDL-32E that stands: beams that meet the road at 83 deg and more, the next one beside it.

    Were what answers anywhere in the footprint, ranges of neighbours would scatter by its length, a quarter of the diameter over the
    cosine of the incidence. Second differences take away the shape of the road.
    """
    assert main(["decode", str(monterey_log), "-o", str(tmp_path / "m.laz"), "--fov-deg", "0-360"]) == 0
    las = laspy.read(tmp_path / "m.laz")
    ratios = []
    for laser in (3, 5, 7):  # 8.0, 6.7 and 5.3 deg below the level
        rows = np.flatnonzero(np.asarray(las.laser) == laser)
        rows = rows[np.argsort(np.asarray(las.gps_time)[rows], kind="stable")]
        range_m, time_s = np.asarray(las.range)[rows], np.asarray(las.gps_time)[rows]
        second = range_m[2:] - 2 * range_m[1:-1] + range_m[:-2]
        there = (time_s[2:] - time_s[:-2] < 250e-6) & (range_m[1:-1] > 10) & (range_m[1:-1] < 20)
        assert there.sum() > 3000
        scatter = sigma(second[there]) / np.sqrt(6)
        down = np.deg2rad(-hdl32e.ELEVATION_DEG[laser])
        ratios.append(scatter / (0.25 * RANGING.divergence_rad * np.median(range_m[1:-1][there]) / np.tan(down)))
    assert max(ratios) < 0.2, ratios


def test_a_slanted_surface_lengthens_the_pulse_and_so_the_noise() -> None:
    trajectory = standing(np.zeros(6), np.eye(6), (0.0, 0.0, 0.0))
    origin = np.array([5.0, -3.0, 40.0]) + MOUNT.lidar_position_m()
    below = origin - [0.0, 0.0, 60.0]
    coarse = Ranging(0.15, 2.79e-3, 0.6)  # so coarse that it is told to a tenth of what the slant does
    flat, steep = (sigma_of(trajectory, below, coarse, slant=slant)[1] for slant in (0.0, 80.0))
    # the beam takes sigma = r a / 4 tan(80 deg) to cross the surface, 0.24 m; the pulse has a sigma of 0.6 / 2.355 m
    crossing_m, pulse_m = 60.0 * 2.79e-3 / 4 * np.tan(np.deg2rad(80)), 0.6 / 2.3548
    assert flat == pytest.approx(0.15)
    assert steep == pytest.approx(0.15 * np.sqrt(1 + (crossing_m / pulse_m) ** 2), rel=0.05)


def test_a_sigma_that_nobody_stated_is_not_made_up() -> None:
    trajectory = standing(np.array([np.nan, 1, 1, 0.1, 0.1, 0.1]), np.eye(6), (0.0, 0.0, 0.0))
    horizontal, vertical = sigma_of(trajectory, np.array([5.0, 10.0, 0.0]), RANGING)
    assert np.isnan(horizontal)
    assert vertical > 1.0


def test_a_sigma_beyond_what_a_file_holds_is_the_largest_that_it_does() -> None:
    trajectory = standing(np.array([500.0, 500.0, 1, 0.1, 0.1, 0.1]), np.eye(6), (0.0, 0.0, 0.0))
    assert sigma_of(trajectory, np.array([5.0, 10.0, 0.0]), RANGING)[0] == LARGEST_M


def true_estimate(folder: Path) -> Estimate:
    """The true poses and the true mount, as an estimate. What ties the log's clocks is not the truth: the poses are put on its UTC."""
    whole = read_truth(folder)
    with LogReader(whole.log) as reader:
        flight = read_flight([reader], "ins")
        lines = legs(flight.runs, flight.boots, whole.mount.mat_ins_lidar(), "auto")[0].lidar_line
    hours = round((lines[0].reference_ns - whole.lidar.start_ns) / HOUR_NS)
    utc_ns = whole.trajectory.time_ns + hours * HOUR_NS
    for line in lines:
        utc_ns = line(utc_ns)
    small = np.full((len(utc_ns), 3), 1e-9)
    exact = replace(
        whole.trajectory, time_ns=utc_ns, frame=whole.frame, sigma_position_m=small, sigma_attitude_rad=small
    )
    return Estimate(exact, whole.mount, "the truth", mount_source="the truth", mount_sigma=None)


def test_where_the_poses_are_the_truth_the_errors_are_those_of_the_beam(judged_flight: "Simulated") -> None:
    """Over ranges and incidences 68 and 95 %, and errors of the size of their sigma."""
    folder = judged_flight.folder
    found = compared(folder, true_estimate(folder), survey=replace(Survey(), boresight_sigma_deg=0.0))
    assert len(found.points) > 100_000
    range_m, slant = found.points["range"], found.points["incidence"]
    # beams nearly level are told in height to less than the millimetre in which a sigma is stored
    stored = (found.points["sigma_h"] > 0.0) & (found.points["sigma_v"] > 0.0)
    judged = 0
    for low, high in pairwise([0.0, 8.0, 15.0, 30.0, 100.0]):
        for begin, end in ((0, 40), (40, 65), (65, 90)):
            chosen = stored & (range_m >= low) & (range_m < high) & (slant >= begin) & (slant < end)
            if chosen.sum() < 2000:
                continue
            judged += 1
            within, (level, height) = shares(found, chosen), sizes(found, chosen)
            # sigma_h is of the mean of two axes: where all of the error is in one, 0.76 and 0.92 of both are within
            assert 0.66 < within[1][0] < 0.78, (low, begin, within)
            assert 0.90 < within[2][0] < 0.97, (low, begin, within)
            # the simulator's ranges are as good on slanted surfaces: too wide beyond 30 m
            least, most = (0.93, (0.76, 0.98)) if low < 30.0 or begin < 65 else (0.75, (0.85, 0.995))
            assert 0.66 < within[1][1] < most[0], (low, begin, within)
            assert 0.93 < within[2][1] < most[1], (low, begin, within)
            assert least < level < 1.06, (low, begin, level)
            assert least < height < 1.06, (low, begin, height)
    assert judged >= 8


def test_errors_of_one_flight_are_within_two_sigma(judged_flight: "Simulated") -> None:
    """The GNSS is one draw in it, which lasts as long as the flight: so two sigma, not one."""
    out = judged_flight.folder / "sigma"
    words = ["process", str(judged_flight.log), "--method", "filtered", "--until", "trajectory", "-o", str(out)]
    assert main([*words, "--force"]) in (0, 3)
    found = compared(judged_flight.folder, out)
    assert min(shares(found, np.ones(len(found.points), bool))[2]) > 0.95
