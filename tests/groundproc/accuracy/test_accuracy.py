"""Metrics of accuracy on disturbances whose effect is known."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from flightlog import frames
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from groundproc.accuracy import patches, poses
from groundproc.accuracy.alignment import Rigid, align, best_rigid
from groundproc.accuracy.cloud import choose_section, judge_cloud
from groundproc.accuracy.ground import CELL_M, STRIP_NS, Ground, cell_keys
from groundproc.accuracy.judge import judge
from groundproc.accuracy.patches import Moments, patch_keys
from groundproc.accuracy.truth import Truth, on_lidar_clock, read_truth, shot_numbers
from groundproc.estimation import methods
from groundproc.estimation.method import gather
from groundproc.flight.flight import read_flight
from groundproc.flight.pairing import legs
from groundproc.flight.timeline import Line
from groundproc.survey import Survey
from groundproc.trajectory.table import from_poses
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def truth(judged_flight: Any) -> Truth:
    return read_truth(judged_flight.folder)


@pytest.fixture
def reader(truth: Truth) -> Iterator[LogReader]:
    with LogReader(truth.log) as opened:
        yield opened


def on_grid(truth: Truth) -> Trajectory:
    """The true trajectory with its knots where poses are compared."""
    first, last = int(truth.trajectory.time_ns[0]), int(truth.trajectory.time_ns[-1])
    step = poses.GRID_NS
    grid = np.arange(-(-first // step) * step, last + 1, step, dtype=np.int64)
    true = truth.trajectory.at(grid)
    none = np.full((len(grid), 3), np.nan)
    return from_poses(truth.frame, grid, true.position_m, true.quat_local_ins_wxyz, none, none)


def turned(trajectory: Trajectory, turns: Rotation) -> Trajectory:
    """Attitudes turned on in the local frame, positions as they are."""
    x, y, z, w = turns.as_quat().T
    quat = frames.quat_multiply(np.stack([w, x, y, z], axis=-1), trajectory.quat_local_ins_wxyz)
    return replace(trajectory, quat_local_ins_wxyz=quat)


# -- alignment


def test_a_rigid_motion_is_found_again() -> None:
    rng = np.random.default_rng(1)
    points, turn, shift = rng.normal(size=(50, 3)) * 20, Rotation.random(random_state=3), np.array([4e3, -7.0, 1.0])
    found = best_rigid(points, turn.apply(points) + shift)
    assert np.abs(found.mat - turn.as_matrix()).max() < 1e-12
    assert np.abs(found.points(points) - turn.apply(points) - shift).max() < 1e-9


def test_a_mirror_image_is_not_aligned_by_mirroring() -> None:
    points = np.random.default_rng(2).normal(size=(50, 3))
    found = best_rigid(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.mat) == pytest.approx(1.0)


def test_along_a_line_attitudes_tell_the_roll() -> None:
    line = np.linspace(0, 50, 200)[:, None] * np.array([[0.8, 0.6, 0.0]])
    mats = Rotation.from_rotvec(np.random.default_rng(3).normal(scale=0.1, size=(200, 3))).as_matrix()
    motion = Rotation.from_rotvec([0.3, 0.7, -2.0])
    found = align(motion.apply(line), motion.as_matrix() @ mats, line, mats)
    assert found.by_attitude
    assert np.abs(found.mat @ motion.as_matrix() - np.eye(3)).max() < 1e-9


# -- poses


def test_the_truth_has_no_error_and_another_frame_adds_none(truth: Truth) -> None:
    true = truth.trajectory
    turn, shift = Rotation.from_euler("z", 5.0, degrees=True), np.array([30.0, -7.0, 2.0])
    moved = turned(replace(true, position_m=turn.apply(true.position_m) + shift), turn)
    moved = replace(moved, velocity_m_s=turn.apply(true.velocity_m_s))
    figures = judge([], truth, moved, truth.mount).figures
    for name in ("ate_m", "ate_max_m", "rotation_rms_deg", "rpe_m", "rpe_deg", "ins_ate_m", "ins_rotation_rms_deg"):
        assert figures[name] < 1e-6, name
    assert figures["heading_settle_s"] == 0.0
    assert figures["heading_rms_deg"] < 1e-6
    # not aligned, it is off by what it was moved: 5 deg counter-clockwise is a heading 5 deg too small
    assert figures["absolute_heading_mean_deg"] == pytest.approx(-5.0, abs=1e-6)
    assert figures["absolute_heading_settle_s"] is None
    assert figures["covered_time_share"] == 1.0


def test_white_noise_of_positions(truth: Truth) -> None:
    grid, sigma_m = on_grid(truth), 0.05
    noise = np.random.default_rng(4).normal(scale=sigma_m, size=grid.position_m.shape)
    noisy = replace(grid, position_m=grid.position_m + noise)
    figures = judge([], truth, noisy, truth.mount).figures
    spread = 5.0 / np.sqrt(2.0 * noise.size)  # five sigma of an RMS of so many samples
    assert figures["ate_m"] == pytest.approx(sigma_m * np.sqrt(3.0), rel=spread)
    assert figures["rpe_m"] == pytest.approx(sigma_m * np.sqrt(6.0), rel=2.0 * spread)
    assert figures["rpe_deg"] < 1e-4


def test_drift_of_yaw(truth: Truth) -> None:
    grid = on_grid(truth)
    share = np.linspace(0.0, 1.0, len(grid))
    drifting = turned(grid, Rotation.from_rotvec(share[:, None] * [0.0, 0.0, -np.deg2rad(8.0)]))
    judged = judge([], truth, drifting, truth.mount)
    # INS positions are those of the truth: what is left is the drift alone, an equal distribution over 8 deg
    assert judged.figures["ins_ate_m"] < 1e-4
    assert judged.figures["ins_rotation_rms_deg"] == pytest.approx(8.0 / np.sqrt(3.0), rel=2e-3)
    # the constant comes off in the body, whose up sways by some degrees about the axis of the drift
    assert judged.figures["ins_rotation_rms_free_deg"] == pytest.approx(8.0 / np.sqrt(12.0), rel=0.02)
    assert judged.figures["absolute_heading_rms_deg"] == pytest.approx(8.0 / np.sqrt(3.0), rel=2e-3)
    seconds = float(grid.time_ns[-1] - grid.time_ns[0]) * 1e-9
    assert judged.figures["ins_rpe_deg"] == pytest.approx(8.0 / seconds, rel=2e-3)
    # 6 deg is the median of the second half; from 5 to 7 deg it is within 1 deg, and then no longer
    assert judged.figures["heading_settle_s"] is None
    error = judged.courses["heading_error_deg"]
    assert error[-1] - error[0] == pytest.approx(8.0, abs=0.05)


def test_a_boresight_is_a_constant_rotation_of_the_lidar_and_none_of_the_ins(truth: Truth) -> None:
    mount = truth.mount.with_lidar(yaw_deg=truth.mount.lidar.yaw_deg + 1.0)
    figures = judge([], truth, truth.trajectory, mount).figures
    assert figures["ins_rotation_rms_deg"] < 1e-6
    # the lever arm of 0.16 m turned by 1 deg moves the positions, and so the alignment, a little
    assert figures["rotation_rms_deg"] == pytest.approx(1.0, abs=0.01)
    assert figures["rotation_rms_free_deg"] < 0.01
    assert np.linalg.norm(figures["body_offset_deg"]) == pytest.approx(1.0, abs=0.01)


def test_a_shift_in_time_is_told_from_other_errors(truth: Truth) -> None:
    # its states come 3 ms later than they were, and a heading that is off by up to 8 deg hides it
    late = replace(truth.trajectory, time_ns=truth.trajectory.time_ns + 3_000_000)
    share = np.linspace(0.0, 1.0, len(late))
    drift = Rotation.from_rotvec(share[:, None] * [0.0, 0.0, np.deg2rad(8.0)])
    figures = judge([], truth, turned(late, drift), truth.mount).figures
    assert figures["time_error_ms"] == pytest.approx(-3.0, abs=0.15)
    assert judge([], truth, truth.trajectory, truth.mount).figures["time_error_ms"] == pytest.approx(0.0, abs=1e-6)


def test_errors_of_a_mount_by_axes(truth: Truth) -> None:
    right, forward, up = truth.mount.lidar.position_m
    # pitch is the last turn but one about x, and there is no roll to speak of in between
    mount = truth.mount.with_lidar(pitch_deg=truth.mount.lidar.pitch_deg + 0.2, position_m=(right + 0.03, forward, up))
    figures = judge([], truth, truth.trajectory, mount).figures
    assert figures["boresight_error_deg"] == pytest.approx((0.2, 0.0, 0.0), abs=0.005)
    assert figures["lever_error_m"] == pytest.approx((0.03, 0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(("factor", "within"), [(1.0, 0.9545), (2.0, 0.6827)])
def test_sigmas_that_are_right_and_half_as_large_as_they_should_be(truth: Truth, factor: float, within: float) -> None:
    grid, rng = on_grid(truth), np.random.default_rng(5)
    sigma_m, sigma_rad = np.full_like(grid.position_m, 0.5), np.full_like(grid.position_m, 0.01)
    # turns about the body's axes are errors of pitch, roll and heading where the aircraft is level to some degrees
    vectors = rng.normal(scale=factor * 0.01, size=grid.position_m.shape)
    quat = frames.quat_multiply(grid.quat_local_ins_wxyz, frames.quat_exp(vectors))
    stated = replace(
        grid,
        position_m=grid.position_m + rng.normal(scale=factor * 0.5, size=grid.position_m.shape),
        quat_local_ins_wxyz=quat,
        sigma_position_m=sigma_m,
        sigma_attitude_rad=sigma_rad,
    )
    figures = judge([], truth, stated, truth.mount).figures
    for name in ("position", "attitude"):
        assert figures[f"{name}_within_2_sigma"] == pytest.approx(within, abs=0.02), name
        assert figures[f"{name}_error_over_sigma"] == pytest.approx(0.6745 * factor, rel=0.05), name


def test_a_heading_settles() -> None:
    time_ns = np.arange(0, 20_000_000_000, 10_000_000, dtype=np.int64)
    seconds = time_ns * 1e-9
    assert poses.settle_s(time_ns, 5.0 * np.exp(-seconds / 2.0)) == pytest.approx(2.0 * np.log(5.0), abs=0.011)
    assert poses.settle_s(time_ns, np.full(len(time_ns), 0.9)) == 0.0
    assert poses.settle_s(time_ns, np.where(seconds < 19.0, 5.0, 0.0)) is None, "one second at the end is no settling"
    assert poses.settle_s(time_ns, np.where(seconds > 19.9, 2.0, 0.0)) is None


def test_the_constant_of_a_heading_error_may_lie_at_the_half_turn() -> None:
    error = poses.wrapped_deg(179.0 + np.linspace(0.0, 4.0, 101))
    assert poses.settled_offset_deg(error) % 360.0 == pytest.approx(182.0, abs=0.05)


# -- clocks


def test_labels_of_utc_do_not_count(truth: Truth) -> None:
    lines = (Line(123_456_789_012, 58e-6, 5_000_000_000), Line(987_000_000_000_000_000))
    true = truth.trajectory
    time_ns = true.time_ns
    for line in lines:
        time_ns = line(time_ns)
    back = on_lidar_clock(replace(true, time_ns=time_ns), lines, truth)
    assert np.abs(back.time_ns - true.time_ns).max() <= 2
    assert np.abs(back.position_m - true.position_m).max() < 1e-6


def test_perfect_instruments_leave_next_to_nothing(perfect_flight: Any) -> None:
    """The whole way from the log, with the estimated tie of the clocks: an error of 1 ms would be 5 mm and 0.05 deg."""
    truth = read_truth(perfect_flight.folder)
    with LogReader(truth.log) as reader:
        flight = read_flight([reader], "ins")
        timeline = legs(flight.runs, flight.boots, truth.nominal_mount.mat_ins_lidar(), "auto")
        given = gather([reader], flight, timeline, truth.nominal_mount, Survey(method="ins"))
        made = methods.estimate(given, lambda stage, size: None)
    placed = on_lidar_clock(made.trajectory, timeline[0].lidar_line, truth)
    figures = judge([], truth, placed, made.mount).figures
    # positions at 10 Hz in whole cm and 1e-7 deg, attitudes at 25 Hz
    assert figures["ate_m"] < 0.05
    assert figures["absolute_rms_m"] < 0.05
    assert figures["rotation_rms_deg"] < 0.2
    assert figures["absolute_heading_rms_deg"] < 0.2


def test_shots_are_told_apart_though_stamps_are_cut_to_microseconds() -> None:
    firing, laser = np.divmod(np.arange(3200), 32)
    exact = 7_000_000_123 + firing * 46_080 + laser * 1_152
    rank = np.zeros(3200, np.int64)
    numbers = shot_numbers(exact, laser.astype(np.uint8), rank, 7_000_000_123)
    assert (np.diff(numbers) == 2).all()
    cut = (7_000_000_123 + firing * 46_080) // 1000 * 1000 + laser * 1_152
    assert (shot_numbers(cut, laser.astype(np.uint8), rank, 7_000_000_123) == numbers).all()


# -- clouds


def test_the_true_trajectory_makes_the_floor(truth: Truth, reader: LogReader) -> None:
    figures = judge([reader], truth, truth.trajectory, truth.mount, section=choose_section(truth)).figures
    assert figures["unmatched"] == 0
    assert figures["covered_share"] == 1.0
    assert figures["points"] > 100_000
    # 15 mm of noise, steps of 2 mm, and the encoder's 0.004 deg at some 20 m
    assert 0.015 < figures["point_rms_m"] < 0.0155
    for name in ("cloud", "facade", "ground_revolution", "ground_strip"):
        assert figures[f"{name}_floor_ratio"] == pytest.approx(1.0, abs=1e-9), name
    assert figures["facade_patches"] > 20
    # the noise along the beam, seen across a wall: less than the noise, and not much less
    assert 0.008 < figures["facade_m"] < 0.015


def test_a_shift_adds_to_the_points_and_alignment_takes_it_off(truth: Truth, reader: LogReader) -> None:
    shift_m = np.array([0.3, 0.0, 0.4])
    moved = replace(truth.trajectory, position_m=truth.trajectory.position_m + shift_m)
    errors = judge_cloud([reader], truth, moved, truth.mount, Rigid.identity()).figures
    expected = np.hypot(errors.floor_point_rms_m, 0.5)
    assert errors.point_rms_m == pytest.approx(expected, rel=1e-3)
    assert errors.point_median_m == pytest.approx(0.5, rel=0.03)
    # as long as all moves together, walls are as thin and the ground is as even as ever
    assert errors.facade_floor_ratio == pytest.approx(1.0, abs=1e-6)
    assert errors.ground_strip_floor_ratio == pytest.approx(1.0, abs=1e-6)
    assert judge([reader], truth, moved, truth.mount).figures["cloud_floor_ratio"] == pytest.approx(1.0, abs=1e-6)


def test_a_wrong_boresight_makes_walls_thick(truth: Truth, reader: LogReader) -> None:
    figures = judge([reader], truth, truth.trajectory, truth.nominal_mount).figures
    assert figures["cloud_floor_ratio"] > 5.0
    assert figures["facade_floor_ratio"] > 1.2


def test_a_gap_in_the_trajectory_is_told(truth: Truth, reader: LogReader) -> None:
    true = truth.trajectory
    middle = int(true.time_ns[len(true) // 2])
    figures = judge([reader], truth, true.before(middle), truth.mount).figures
    assert figures["covered_share"] == pytest.approx(0.5, abs=0.1)
    assert figures["covered_time_share"] == pytest.approx(0.5, abs=0.01)
    assert figures["cloud_floor_ratio"] == pytest.approx(1.0, abs=1e-9)


def test_both_returns_find_their_echoes(simulated: Callable[..., Any]) -> None:
    from simulator.config import Options

    options = Options()
    options = replace(options, lidar=replace(options.lidar, returns="dual"))
    truth = read_truth(simulated("judged_dual", "village", 1.5, options, every=3, points=True).folder)
    with LogReader(truth.log) as reader:
        errors = judge_cloud([reader], truth, truth.trajectory, truth.mount, Rigid.identity()).figures
    assert errors.points > 50_000
    assert errors.unmatched < 1e-4 * errors.points
    assert errors.point_rms_m < 0.0155


def test_truth_that_is_not_there_is_one_sentence(tmp_path: Path, perfect_flight: Any) -> None:
    with pytest.raises(LogError, match=r"truth\.json"):
        read_truth(tmp_path)
    with pytest.raises(LogError, match="--truth-points"):
        read_truth(perfect_flight.folder).hits()


# -- facades and ground


def wall(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """True points on a wall that looks south at north 20 m, and its normals."""
    points = np.stack([rng.uniform(0, 20, count), np.full(count, 20.0), rng.uniform(0, 6, count)], axis=1)
    return points, np.tile([0.0, -1.0, 0.0], (count, 1))


def test_thickness_of_one_sheet_and_of_two() -> None:
    rng, moments = np.random.default_rng(6), Moments(3)
    hits, normals = wall(rng, 60_000)
    noisy = hits + rng.normal(scale=0.01, size=(len(hits), 1)) * normals
    apart = noisy + 0.03 * np.where(rng.random((len(hits), 1)) < 0.5, normals, -normals)
    for part in np.array_split(np.arange(len(hits)), 7):  # piece by piece, as they come
        keys = patch_keys(hits[part], normals[part], np.zeros(len(part), np.int64))
        moments.add(keys, hits[part], hits[part], noisy[part], apart[part])
    assert len(moments) == 30
    assert patches.flat_patches(moments).all()
    spread = 5.0 / np.sqrt(2.0 * len(hits))
    assert patches.trimmed_mean(patches.thickness_m(moments, 1)) == pytest.approx(0.01, rel=spread)
    assert patches.trimmed_mean(patches.thickness_m(moments, 2)) == pytest.approx(np.hypot(0.01, 0.03), rel=spread)


@pytest.mark.parametrize("turn_deg", [2.0, 10.0])
def test_thickness_does_not_mind_where_the_wall_stands(turn_deg: float) -> None:
    rng, moments = np.random.default_rng(7), Moments(3)
    hits, normals = wall(rng, 20_000)
    noisy = hits + rng.normal(scale=0.01, size=(len(hits), 1)) * normals
    elsewhere = Rotation.from_euler("zx", [turn_deg, -turn_deg], degrees=True).apply(noisy) + np.array(
        [500.0, 900.0, 40.0]
    )
    moments.add(patch_keys(hits, normals, np.zeros(len(hits), np.int64)), hits, hits, noisy, elsewhere)
    # the noise turns with the wall and so has a part in the fit's own abscissae: (10 mm * sin 10 deg / 0.58 m)^2 is nothing
    np.testing.assert_allclose(patches.thickness_m(moments, 2), patches.thickness_m(moments, 1), rtol=1e-4)


def test_a_wall_smeared_over_metres_is_metres_thick() -> None:
    rng, moments = np.random.default_rng(11), Moments(3)
    hits, normals = wall(rng, 20_000)
    smeared = hits + rng.normal(scale=4.0, size=(len(hits), 1)) * normals
    moments.add(patch_keys(hits, normals, np.zeros(len(hits), np.int64)), hits, hits, smeared, hits)
    # a slope that the smear shows by chance counts as one: that is some percent
    assert patches.trimmed_mean(patches.thickness_m(moments, 1)) == pytest.approx(4.0, rel=0.15)
    assert patches.trimmed_mean(patches.thickness_m(moments, 2)) < 1e-6


def test_what_is_not_flat_is_no_patch() -> None:
    rng, moments = np.random.default_rng(8), Moments(3)
    hits, normals = wall(rng, 20_000)
    rough = hits + rng.normal(scale=0.02, size=(len(hits), 1)) * normals
    moments.add(patch_keys(hits, normals, np.zeros(len(hits), np.int64)), rough, rough, rough, rough)
    assert not patches.flat_patches(moments).any()


def test_windows_are_no_wall() -> None:
    names = (
        "house south",
        "house south glass",
        "house south reveals",
        "house south indoors",
        "tree 3 leaves",
        "garage",
    )
    assert patches.facade_surfaces(names).tolist() == [True, False, False, False, False, True]


def test_ground_of_revolutions_and_strips() -> None:
    """A hump of heights that each strip and each revolution adds is what is found, and the second set has none."""
    rng, ground = np.random.default_rng(9), Ground(2)
    places = CELL_M * (np.stack([*np.divmod(np.arange(2500), 50), np.zeros(2500)], axis=1) + 0.5)
    surface = np.zeros(len(places), np.int32)
    keys = cell_keys(places, surface)
    assert len(np.unique(keys)) == 2500
    for revolution in range(40):
        time_ns = np.full(len(places), revolution * STRIP_NS // 10, np.int64)
        strip = revolution // 10
        height = 0.02 * (revolution % 2) + 0.1 * strip
        order = rng.permutation(len(places))
        heights = np.stack([places[:, 2] + height, places[:, 2]], axis=1)[order]
        ground.add(keys[order], heights, np.full(len(places), revolution), time_ns)
    ground.finish()
    # 39 steps from one revolution to the next: 0.02 m each, and three of them are from strip to strip, 0.1 m up and 0.02 m down
    steps = np.full(39, 0.02)
    steps[9::10] = 0.08
    found, none = ground.revolutions.rms_m()
    assert found == pytest.approx(np.sqrt(np.square(steps).mean()), rel=1e-9)
    assert none == 0.0
    # of strips 0 to 3 each is compared with the last visit of its cells two or more strips before: all were seen in the strip before
    assert ground.strips.cells == 0


def test_strips_are_compared_when_the_aircraft_comes_back() -> None:
    ground = Ground(2)
    places = CELL_M * (np.stack([*np.divmod(np.arange(2500), 50), np.zeros(2500)], axis=1) + 0.5)
    keys = cell_keys(places, np.zeros(len(places), np.int32))
    for revolution, (here, height) in enumerate([(0, 0.0), (1, 5.0), (1, 5.0), (0, 0.3), (1, 5.4)]):
        heights = np.stack([np.full(len(places), height), np.zeros(len(places))], axis=1)
        stamps = np.full(len(places), revolution * STRIP_NS, np.int64)
        ground.add(keys + here * (1 << 46), heights, np.full(len(places), revolution), stamps)
    ground.finish()
    # place 0 after three strips, +0.3 m; place 1 after two, +0.4 m
    assert ground.strips.cells == 2 * len(places)
    assert ground.strips.rms_m()[0] == pytest.approx(np.sqrt((0.09 + 0.16) / 2), rel=1e-9)
