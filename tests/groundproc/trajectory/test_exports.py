"""A trajectory in the formats of other programs: what is written comes back to the digits of the format, by witnesses that are not ours."""

import contextlib
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flightlog import frames
from flightlog.clock import gps_week_to_utc_ns
from flightlog.errors import SwathError
from flightlog.mount import Mount
from groundproc.cli import main
from groundproc.flight.positions.fixes import outside_fixes
from groundproc.flight.positions.reading import read_solution
from groundproc.flight.positions.solution import INS
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.estimate import Estimate, write_estimate
from groundproc.trajectory.table import read_trajectory, write_trajectory
from groundproc.trajectory.trajectory import Trajectory

WEEK = 2300
FRAME = LocalFrame(58.394123456789, 15.574987654321, 61.25)
COUNT = 300
STEP_S = 0.02


@pytest.fixture(scope="module")
def flown() -> Trajectory:
    """Six seconds of a circle of 40 m at 3 km from the origin that goes over the end of a GPS week, with honest velocities and rates."""
    seconds = np.arange(COUNT) * STEP_S
    time_ns = gps_week_to_utc_ns(WEEK + 1, 0) - 3_000_000_000 + np.arange(COUNT, dtype=np.int64) * 20_000_000 + 123_456
    turn = 0.4 * seconds
    circle = np.stack([40 * np.sin(turn), 40 * np.cos(turn), 2 * seconds], axis=1)
    circle += np.array([3000.0, -500.0, 80.0])
    velocity = np.stack([16 * np.cos(turn), -16 * np.sin(turn), np.full(COUNT, 2.0)], axis=1)
    heading = np.pi / 2 + turn  # along the way, clockwise
    quat = frames.quat_from_mat(frames.mat_local_ins(heading, np.full(COUNT, 0.1), np.full(COUNT, -0.2)))
    rate_local = np.tile([0.0, 0.0, -0.4], (COUNT, 1))
    rate = np.einsum("nji,nj->ni", frames.mat_from_quat(quat), rate_local)
    covered = np.append(np.ones(COUNT - 1, np.bool_), False)
    sigma = np.tile([0.02, 0.03, 0.05], (COUNT, 1))
    return Trajectory(
        FRAME, time_ns, circle, velocity, quat, rate, sigma, np.deg2rad(np.tile([0.1, 0.2, 0.5], (COUNT, 1))), covered
    )


def quality(height: str) -> None:
    """Beside a trajectory.csv, the two things that it does not say itself."""
    frame = {"latitude_deg": FRAME.latitude_deg, "longitude_deg": FRAME.longitude_deg, "height_m": FRAME.height_m}
    Path("quality.json").write_text(json.dumps({"height": {"reference": height}, "local_frame": frame}))


@pytest.fixture
def table(flown: Trajectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Trajectory:
    """trajectory.csv in the working folder with heights above the ellipsoid, as it is read."""
    monkeypatch.chdir(tmp_path)
    write_trajectory(Path("trajectory.csv"), flown)
    quality("ellipsoid")
    return read_trajectory(Path("trajectory.csv"))


def back(name: str, week: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, positions and attitudes of a file in the frame of the flight."""
    solution = read_solution(Path(name), week=week)
    assert solution.point == INS
    assert solution.height_reference == "ellipsoid"
    fixes = outside_fixes(solution, FRAME, np.zeros(3), sigma_m=(1, 1, 1))
    return fixes.time_ns, fixes.position_m, fixes.quat_local_ins_wxyz


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """The largest angle between attitudes [rad]."""
    return float(np.linalg.norm(frames.quat_log(frames.quat_multiply(frames.quat_inverse(a), b)), axis=1).max())


# trajectory.csv itself keeps 0.1 mm of height, 1e-9 deg of place and 1e-5 deg of attitude; what each format adds is in the tolerances
TABLE_M = 0.5e-4 + 1.2e-4 / 2
TABLE_RAD = np.deg2rad(0.5e-5) * np.sqrt(3)


@pytest.mark.parametrize(
    ("name", "position_m", "attitude_rad"),
    [("t.tum", 1e-6, 4e-9), ("t.kitti", 1e-6, 4e-9), ("sbet_t.out", 2e-8, 1e-9), ("t.sbet", 2e-8, 1e-9)],
)
def test_poses_come_back_to_the_digits_of_the_format(
    table: Trajectory, flown: Trajectory, name: str, position_m: float, attitude_rad: float
) -> None:
    assert main(["export", "trajectory.csv", "-o", name]) == 0
    time_ns, position, quat = back(name, WEEK)
    np.testing.assert_array_equal(time_ns, flown.time_ns)
    assert np.abs(position - flown.position_m).max() < TABLE_M + position_m
    assert angle_between(quat, flown.quat_local_ins_wxyz) < TABLE_RAD + attitude_rad


def test_a_pos_keeps_positions_times_and_sigmas_and_says_that_it_is_the_way_of_the_imu(
    table: Trajectory, flown: Trajectory
) -> None:
    assert main(["export", "trajectory.csv", "-o", "t.pos"]) == 0
    time_ns, position, quat = back("t.pos")
    assert np.abs(time_ns - flown.time_ns).max() <= 500  # microseconds
    assert np.abs(position - flown.position_m).max() < TABLE_M + 0.5e-4 + 0.6e-4
    assert quat is None
    solution = read_solution(Path("t.pos"))
    np.testing.assert_allclose(solution.sigma_m, flown.sigma_position_m, rtol=0, atol=0.6e-4)


def test_tum_is_what_its_readers_expect(table: Trajectory, flown: Trajectory) -> None:
    main(["export", "trajectory.csv", "-o", "t.tum"])
    rows = np.loadtxt("t.tum")  # as evo and rpg_trajectory_evaluation read it
    assert rows.shape == (COUNT, 8)
    # doubles of today's seconds are a quarter of a microsecond apart
    np.testing.assert_allclose(rows[:, 0], flown.time_ns * 1e-9, rtol=0, atol=np.spacing(2e9))
    # x of the body is along the way but for the pitch, z is up but for pitch and roll
    forward = Rotation.from_quat(rows[:, 4:]).apply([1.0, 0.0, 0.0])
    along = flown.velocity_m_s[:, :2] / np.linalg.norm(flown.velocity_m_s[:, :2], axis=1)[:, None]
    np.testing.assert_allclose(forward[:, :2], np.cos(0.1) * along, rtol=0, atol=1e-6)
    np.testing.assert_allclose(forward[:, 2], np.sin(0.1), rtol=0, atol=1e-6)
    left = Rotation.from_quat(rows[:, 4:]).apply([0.0, 1.0, 0.0])
    np.testing.assert_allclose(
        left[:, 2], -np.sin(0.2) * np.cos(0.1), rtol=0, atol=1e-6
    )  # a negative roll lowers the left side


def test_kitti_is_the_same_poses_as_matrices(table: Trajectory) -> None:
    main(["export", "trajectory.csv", "-o", "t.kitti"])
    main(["export", "trajectory.csv", "-o", "t.tum"])
    matrix, rows = np.loadtxt("t.kitti").reshape(-1, 3, 4), np.loadtxt("t.tum")
    np.testing.assert_allclose(matrix[:, :, 3], rows[:, 1:4], rtol=0, atol=2e-6)
    np.testing.assert_allclose(matrix[:, :, :3], Rotation.from_quat(rows[:, 4:]).as_matrix(), rtol=0, atol=1e-8)
    np.testing.assert_array_equal(np.loadtxt("t_times.txt"), rows[:, 0])


def test_an_sbet_is_seventeen_doubles_of_the_users_guide(table: Trajectory, flown: Trajectory) -> None:
    main(["export", "trajectory.csv", "-o", "sbet_1.out"])
    rows = np.array(list(struct.iter_unpack("<17d", Path("sbet_1.out").read_bytes())))
    # seconds of the week, on over its end
    np.testing.assert_allclose(
        rows[[0, -1], 0], [604_797.000123456, 604_797.000123456 + (COUNT - 1) * STEP_S], rtol=0, atol=1e-9
    )
    east, north, up = flown.velocity_m_s.T
    inner = slice(
        1, -1
    )  # of a table the velocities at its ends are one-sided; the meridians converge by 0.05 deg at 3 km
    np.testing.assert_allclose(rows[inner, 4], north[inner], rtol=0, atol=0.03)
    np.testing.assert_allclose(rows[inner, 5], east[inner], rtol=0, atol=0.03)
    np.testing.assert_allclose(rows[inner, 6], -up[inner], rtol=0, atol=0.03)
    np.testing.assert_allclose(rows[:, 7:9], np.tile([-0.2, 0.1], (COUNT, 1)), rtol=0, atol=1e-3)
    assert np.abs(rows[:, 9]).max() <= np.pi
    np.testing.assert_array_equal(rows[:, 10], 0.0)
    # a turn to the right: centripetal acceleration of 6.4 m/s2 to the right of the way, level; body rates of the turn
    mat = frames.mat_from_quat(flown.quat_local_ins_wxyz)
    turn = 0.4 * np.arange(COUNT) * STEP_S
    centre = -6.4 * np.stack([np.sin(turn), np.cos(turn), np.zeros(COUNT)], axis=1)
    right, forward, top = np.einsum("nji,nj->ni", mat, centre)[5:-5].T
    found = np.stack([rows[5:-5, 11], rows[5:-5, 12], -rows[5:-5, 13]], axis=1)
    # 0.1 mm of the table, differenced twice over 20 ms, is 0.25 m/s2
    np.testing.assert_allclose(found, np.stack([forward, right, top], axis=1), rtol=0, atol=0.6)
    np.testing.assert_allclose(found.mean(axis=0), [forward.mean(), right.mean(), top.mean()], rtol=0, atol=0.05)
    np.testing.assert_allclose(rows[inner, 16], 0.4 * np.cos(0.1) * np.cos(0.2), rtol=0, atol=1e-3)


def test_an_sbet_states_its_sigmas_in_the_file_beside(table: Trajectory, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "trajectory.csv", "-o", "sbet_1.out"]) == 0
    assert "smrmsg_1.out" in capsys.readouterr().out
    solution = read_solution(Path("sbet_1.out"), week=WEEK)
    np.testing.assert_allclose(solution.sigma_m, np.tile([0.02, 0.03, 0.05], (COUNT, 1)), rtol=1e-4)
    assert solution.attitude_covariance_rad2 is not None
    sigma = np.rad2deg(np.sqrt(np.einsum("nii->ni", solution.attitude_covariance_rad2)))
    np.testing.assert_allclose(sigma, np.tile([0.1, 0.2, 0.5], (COUNT, 1)), rtol=1e-4)
    assert solution.velocity_covariance_m2_s2 is not None
    assert np.isnan(solution.velocity_covariance_m2_s2).any(axis=(1, 2)).all()  # nobody stated them
    main(["export", "trajectory.csv", "-o", "other.out"])
    assert "smrmsg" not in capsys.readouterr().out


@pytest.mark.parametrize("name", ["t.tum", "t.kitti", "sbet_t.out"])
def test_every_format_becomes_a_table_again(table: Trajectory, flown: Trajectory, name: str) -> None:
    main(["export", "trajectory.csv", "-o", name])
    assert main(["export", name, "-o", "again.csv", "--week", str(WEEK)]) == 0
    found, wanted = read_trajectory(Path("again.csv"), FRAME), read_trajectory(Path("trajectory.csv"), FRAME)
    np.testing.assert_array_equal(found.time_ns, wanted.time_ns)
    np.testing.assert_allclose(found.position_m, wanted.position_m, rtol=0, atol=2e-4)
    # axes of a local frame at 3 km from the other lean by 0.03 deg
    assert angle_between(found.quat_local_ins_wxyz, wanted.quat_local_ins_wxyz) < np.deg2rad(0.06)


def test_heights_above_the_sea_become_those_above_the_ellipsoid_by_the_geoid_or_are_refused(
    table: Trajectory, flown: Trajectory, capsys: pytest.CaptureFixture[str]
) -> None:
    quality("msl")
    assert main(["export", "trajectory.csv", "-o", "t.sbet"]) != 0
    assert "give the geoid's height with --geoid" in capsys.readouterr().err
    assert not Path("t.sbet").exists()
    assert main(["export", "trajectory.csv", "-o", "t.sbet", "--geoid", "29.5"]) == 0
    high = read_solution(Path("t.sbet"), week=WEEK).height_m
    low = read_trajectory(Path("trajectory.csv")).frame.height_m
    assert high[0] - low == pytest.approx(29.5, abs=1e-6)
    assert main(["export", "trajectory.csv", "-o", "t.pos"]) == 0
    assert read_solution(Path("t.pos")).height_reference == "msl"
    assert main(["export", "trajectory.csv", "-o", "t.tum"]) == 0
    assert read_solution(Path("t.tum")).height_reference == "msl"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["trajectory.csv", "-o", "t.xyz"], ".tum, .kitti, .sbet"),
        (["trajectory.csv", "-o", "t"], ".tum, .kitti, .sbet"),
        (["none.csv", "-o", "t.tum"], "none.csv: no such file"),
        (["text.txt", "-o", "t.tum"], "expected a trajectory"),
        (["trajectory.csv", "-o", "there.tum"], "--force to write over"),
        (["trajectory.csv", "-o", "there.kitti"], "there_times.txt: exists already"),
        (["trajectory.csv", "-o", "t.tum", "--height", "msl"], "are ellipsoid, as it is written there"),
        (["trajectory.csv", "-o", "t.sbet", "--geoid", "3"], "above the ellipsoid already"),
        (["trajectory.csv", "-o", "t.tum", "--geoid", "3"], "--geoid 3: is for .sbet"),
        (["trajectory.csv", "-o", "t.laz"], "expected a cloud"),
        (["lost.tum", "-o", "t.csv"], "# origin LATITUDE LONGITUDE HEIGHT"),
        (["odd.tum", "-o", "t.csv"], "a quaternion of length 2"),
        (["lone.kitti", "-o", "t.csv"], "expected them in lone_times.txt"),
        (["alone/trajectory.csv", "-o", "t.sbet"], "give --height ellipsoid or msl"),
    ],
)
def test_what_cannot_be_exported_is_one_sentence_and_leaves_nothing(
    table: Trajectory, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("text.txt").write_text("no trajectory\n")
    Path("there.tum").write_text("")
    Path("there_times.txt").write_text("")
    Path("lost.tum").write_text("1.5 0 0 0 0 0 0 1\n2.5 0 0 0 0 0 0 1\n3.5 0 0 0 0 0 0 1\n")
    Path("odd.tum").write_text("# origin 58 15 0 msl\n1.5 0 0 0 0 0 0 2\n2.5 0 0 0 0 0 0 1\n3.5 0 0 0 0 0 0 1\n")
    Path("lone.kitti").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    Path("alone").mkdir()
    Path("alone/trajectory.csv").write_bytes(Path("trajectory.csv").read_bytes())
    before = sorted(Path().rglob("*"))
    assert main(["export", *words]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert sorted(Path().rglob("*")) == before


def test_a_folder_of_products_is_exported_without_the_rounding_of_its_table(flown: Trajectory, tmp_path: Path) -> None:
    write_estimate(tmp_path, Estimate(replace(flown), Mount(), "as made up"))
    assert main(["export", str(tmp_path / "trajectory.csv"), "-o", str(tmp_path / "t.tum")]) == 0
    rows = np.loadtxt(tmp_path / "t.tum")
    np.testing.assert_allclose(rows[:, 1:4], flown.position_m, rtol=0, atol=0.6e-6)
    line = next(
        text for text in (tmp_path / "t.tum").read_text().splitlines() if "origin" in text and text.count(" ") == 5
    )
    assert line == f"# origin {FRAME.latitude_deg!r} {FRAME.longitude_deg!r} {FRAME.height_m!r} unknown"


def test_a_tum_or_kitti_cut_off_anywhere_is_poses_or_a_named_error(table: Trajectory) -> None:
    main(["export", "trajectory.csv", "-o", "t.tum"])
    main(["export", "trajectory.csv", "-o", "t.kitti"])
    for name in ("t.tum", "t.kitti", "t_times.txt"):
        content = Path(name).read_bytes()
        for cut in range(0, 400, 7):
            Path(name).write_bytes(content[:cut])
            with contextlib.suppress(SwathError):
                read_solution(Path("t.kitti" if "times" in name else name))
        Path(name).write_bytes(content)
