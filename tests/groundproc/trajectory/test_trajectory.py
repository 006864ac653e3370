"""Poses between knots against motions that are known exactly; gaps; trajectory.csv."""

import csv
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from flightlog.errors import CoverageError, LogError
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.table import COLUMNS, read_trajectory, write_trajectory
from groundproc.trajectory.trajectory import HOLD, Trajectory, joined

Array = npt.NDArray[np.float64]
FRAME = LocalFrame(58.394, 15.574, 61.3)
START_NS = 1_779_272_223_000_000_000


def wxyz(rotation: Rotation) -> Array:
    return np.roll(rotation.as_quat(), 1, axis=-1)


def angle_between(quat: Array, rotation: Rotation) -> Array:
    """Angle [rad] between quaternions, scalar first, and scipy's rotations."""
    return np.asarray((Rotation.from_quat(np.roll(quat, -1, axis=-1)).inv() * rotation).magnitude())


def trajectory(
    time_ns: npt.NDArray[np.int64], position: Array, velocity: Array, turned: Rotation, rate: Array, **changed: object
) -> Trajectory:
    covered = np.append(np.ones(len(time_ns) - 1, bool), False)
    sigma = np.ones((len(time_ns), 3))
    values = {"sigma_position_m": sigma, "sigma_attitude_rad": sigma * 0.01, "covered": covered} | changed
    return Trajectory(
        FRAME, time_ns, position, velocity, wxyz(turned), np.broadcast_to(rate, (len(time_ns), 3)), **values
    )  # type: ignore[arg-type]


def uneven(count: int, seed: int) -> tuple[npt.NDArray[np.int64], Array]:
    """Knots 5 to 60 ms apart, and their seconds since the first."""
    time_ns = START_NS + np.cumsum(np.random.default_rng(seed).integers(5_000_000, 60_000_000, count))
    return time_ns, (time_ns - time_ns[0]) * 1e-9


def steady(seconds: float = 1.0, step_ns: int = 10_000_000, **changed: object) -> Trajectory:
    """Level flight to the east, turning right at 20 deg/s."""
    time_ns = START_NS + np.arange(0, round(seconds * 1e9) + 1, step_ns, dtype=np.int64)
    t = (time_ns - START_NS) * 1e-9
    rate = np.array([0.0, 0.0, -np.deg2rad(20.0)])
    path = np.stack([4.0 * t, 0 * t, 0 * t], axis=1)
    speed = np.tile([4.0, 0.0, 0.0], (len(t), 1))
    return trajectory(time_ns, path, speed, Rotation.from_rotvec(t[:, None] * rate), rate, **changed)


@settings(max_examples=40, deadline=None)
@given(coefficients=st.lists(st.floats(-5, 5), min_size=12, max_size=12), seed=st.integers(0, 1000))
def test_a_cubic_motion_is_followed_exactly(coefficients: list[float], seed: int) -> None:
    time_ns, t = uneven(20, seed)
    c = np.array(coefficients).reshape(4, 3)
    position = c[0] + t[:, None] * (c[1] + t[:, None] * (c[2] + t[:, None] * c[3]))
    velocity = c[1] + t[:, None] * (2 * c[2] + 3 * t[:, None] * c[3])
    at_ns = np.random.default_rng(seed).integers(time_ns[0], time_ns[-1], 200)
    u = ((at_ns - time_ns[0]) * 1e-9)[:, None]
    poses = trajectory(time_ns, position, velocity, Rotation.identity(20), np.zeros(3)).at(at_ns)
    np.testing.assert_allclose(poses.position_m, c[0] + u * (c[1] + u * (c[2] + u * c[3])), rtol=0, atol=1e-9)


def test_any_knots_are_joined_as_scipys_hermite_spline_joins_them() -> None:
    rng = np.random.default_rng(4)
    time_ns, t = uneven(30, 4)
    position, velocity = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
    at_ns = rng.integers(time_ns[0], time_ns[-1] + 1, 500)
    poses = trajectory(time_ns, position, velocity, Rotation.identity(30), np.zeros(3)).at(at_ns)
    expected = CubicHermiteSpline(t, position, velocity, axis=0)((at_ns - time_ns[0]) * 1e-9)
    np.testing.assert_allclose(poses.position_m, expected, rtol=0, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(
    rate=st.tuples(*[st.floats(-6.0, 6.0)] * 3),
    start=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    seed=st.integers(0, 1000),
)
def test_a_turn_at_constant_rate_is_followed_exactly(
    rate: tuple[float, float, float], start: tuple[float, float, float], seed: int
) -> None:
    """Through every heading, +-180 deg included, with quaternions of either sign."""
    rng = np.random.default_rng(seed)
    time_ns, t = uneven(25, seed)
    base = Rotation.from_rotvec(start)
    turned = base * Rotation.from_rotvec(t[:, None] * np.array(rate))
    made = trajectory(time_ns, np.zeros((25, 3)), np.zeros((25, 3)), turned, np.array(rate))
    flipped = made.quat_local_ins_wxyz * rng.choice([-1.0, 1.0], (25, 1))
    made = trajectory(
        time_ns, np.zeros((25, 3)), np.zeros((25, 3)), Rotation.from_quat(np.roll(flipped, -1, axis=1)), np.array(rate)
    )
    at_ns = rng.integers(time_ns[0], time_ns[-1] + 1, 200)
    expected = base * Rotation.from_rotvec(((at_ns - time_ns[0]) * 1e-9)[:, None] * np.array(rate))
    poses = made.at(at_ns)
    assert angle_between(poses.quat_local_ins_wxyz, expected).max() < 1e-7
    np.testing.assert_allclose(np.linalg.norm(poses.quat_local_ins_wxyz, axis=1), 1.0, rtol=0, atol=1e-12)


def test_a_changing_rate_is_followed_to_the_fourth_order_of_the_step() -> None:
    """Oscillation about skew axes with knots every 40 and every 20 ms: half the step, at most a tenth of the error."""
    worst = []
    fine = np.linspace(0.0, 2.0, 200_001)
    rates = np.stack([0.8 * np.sin(9 * fine), 0.6 * np.cos(7 * fine), 0.9 * np.sin(5 * fine + 1)], axis=1)
    steps = Rotation.from_rotvec(0.5 * (rates[1:] + rates[:-1]) * 1e-5)
    quats, current = [Rotation.identity().as_quat()], Rotation.identity()
    for chunk in range(0, 200_000, 200):  # poses every 2 ms, each by 200 small turns
        for step in steps[chunk : chunk + 200]:
            current = current * step
        quats.append(current.as_quat())
        if chunk >= 40_000:
            break
    truth = Rotation.from_quat(np.array(quats))
    count = len(quats)
    for every in (20, 10):
        knots = np.arange(0, count, every)
        time_ns = START_NS + knots.astype(np.int64) * 2_000_000
        zero = np.zeros((len(knots), 3))
        made = trajectory(time_ns, zero, zero, truth[knots], rates[knots * 200])
        inside = np.arange(0, knots[-1] + 1)
        poses = made.at(START_NS + inside.astype(np.int64) * 2_000_000)
        worst.append(angle_between(poses.quat_local_ins_wxyz, truth[inside]).max())
    assert worst[0] < 1e-4
    assert worst[1] < worst[0] / 8


def test_a_time_outside_is_refused_and_never_extrapolated() -> None:
    made = steady()
    first, last = made.time_ns[0], made.time_ns[-1]
    made.at(np.array([first, last]))
    for time_ns in (first - 1, last + 1, 0, 2**62):
        with pytest.raises(CoverageError, match="no pose at"):
            made.at(np.array([first, time_ns]))
        assert made.where_covered(np.array([first, time_ns, last]))[1].tolist() == [True, False, True]


def test_a_gap_is_not_interpolated_over() -> None:
    made = steady()
    covered = made.covered.copy()
    covered[40:45] = False
    gap = steady(covered=covered)
    t = gap.time_ns
    asked = np.array([t[40] - 1, t[40], t[42] + 5, t[45] - 1, t[45], t[46]])
    assert gap.where_covered(asked)[1].tolist() == [True, False, False, False, True, True]
    with pytest.raises(CoverageError, match="less its gaps"):
        gap.at(asked)


def test_any_order_of_times_gives_the_same_poses() -> None:
    made = steady()
    times = np.random.default_rng(1).integers(made.time_ns[0], made.time_ns[-1], 1000)
    order = np.argsort(times)
    mixed, sorted_ = made.at(times), made.at(times[order])
    assert (mixed.position_m[order] == sorted_.position_m).all()
    assert (mixed.quat_local_ins_wxyz[order] == sorted_.quat_local_ins_wxyz).all()
    assert made.at(np.empty(0, np.int64)).position_m.shape == (0, 3)


def test_a_held_grid_gives_the_pose_of_the_nearest_knot() -> None:
    made = steady(interpolation=HOLD)
    times = made.time_ns[:-1, None] + np.array([0, 1, 4_999_999, 5_000_001, 9_999_999])
    nearest = np.arange(len(made) - 1)[:, None] + np.array([0, 0, 0, 1, 1])
    poses = made.at(times.ravel())
    assert (poses.position_m == made.position_m[nearest.ravel()]).all()
    assert (poses.quat_local_ins_wxyz == made.quat_local_ins_wxyz[nearest.ravel()]).all()


def test_parts_are_joined_with_a_gap_and_cut_again() -> None:
    made = steady()
    early, late = made.part(slice(0, 40)), made.part(slice(50, None))
    both = joined([late, early])
    assert len(both) == 40 + len(made) - 50
    asked = np.array([made.time_ns[39], made.time_ns[39] + 1, made.time_ns[45], made.time_ns[50]])
    assert both.where_covered(asked)[1].tolist() == [False, False, False, True]
    assert len(made.before(int(made.time_ns[10]))) == 11
    assert len(made.after(int(made.time_ns[10]))) == len(made) - 11
    with pytest.raises(CoverageError, match="expected later"):
        joined([made, early])
    with pytest.raises(CoverageError):
        joined([])


# trajectory.csv -------------------------------------------------------------------------------------------------------


def test_the_table_holds_what_it_says(tmp_path: Path) -> None:
    made = steady()
    write_trajectory(tmp_path / "trajectory.csv", made)
    with (tmp_path / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == len(made)
    row = rows[50]
    assert int(row["utc_ns"]) == made.time_ns[50]
    assert [float(row[f"{n}_m"]) for n in ("east", "north", "up")] == [2.0, 0.0, 0.0]
    # half a second of turning right at 20 deg/s from north
    assert float(row["heading_deg"]) == pytest.approx(10.0, abs=1e-5)
    assert float(row["roll_deg"]) == float(row["pitch_deg"]) == 0.0
    assert float(row["height_m"]) == pytest.approx(61.3, abs=1e-3)
    assert (float(row["longitude_deg"]) - 15.574) * 111_320 * np.cos(np.deg2rad(58.394)) == pytest.approx(2.0, rel=0.01)
    assert [float(row[f"sigma_{n}"]) for n in ("east_m", "up_m")] == [1.0, 1.0]
    assert float(row["sigma_heading_deg"]) == pytest.approx(np.rad2deg(0.01), abs=1e-4)


def test_headings_run_from_0_to_below_360(tmp_path: Path) -> None:
    heading_deg = np.array([0.0, -1e-7, 1e-7, 359.9999999, 359.9, 180.0, -180.0, 90.0])
    turned = Rotation.from_euler("Z", -heading_deg[:, None], degrees=True)
    time_ns = START_NS + np.arange(8, dtype=np.int64) * 10_000_000
    write_trajectory(tmp_path / "t.csv", trajectory(time_ns, np.zeros((8, 3)), np.zeros((8, 3)), turned, np.zeros(3)))
    with (tmp_path / "t.csv").open() as file:
        written = [float(row["heading_deg"]) for row in csv.DictReader(file)]
    np.testing.assert_allclose(written, [0, 0, 0, 0, 359.9, 180, 180, 90], rtol=0, atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_written_and_read_it_is_the_same_trajectory(seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("csv") / "trajectory.csv"
    time_ns, t = uneven(60, seed)
    rate = rng.normal(size=3)
    turned = Rotation.from_rotvec(rng.normal(size=3)) * Rotation.from_rotvec(t[:, None] * rate)
    speed = rng.normal(size=3) * 5
    write_trajectory(
        path, trajectory(time_ns, rng.normal(size=3) * 100 + t[:, None] * speed, np.tile(speed, (60, 1)), turned, rate)
    )
    made = trajectory(time_ns, np.zeros((60, 3)), np.zeros((60, 3)), turned, rate)
    again = read_trajectory(path, FRAME)
    assert (again.time_ns == time_ns).all()
    # 1e-9 deg is 0.1 mm, heights are to 0.1 mm; angles to 1e-5 deg each
    with path.open() as file:
        rows = list(csv.DictReader(file))
    local = np.array([[float(r[f"{n}_m"]) for n in ("east", "north", "up")] for r in rows])
    np.testing.assert_allclose(again.position_m, local, rtol=0, atol=2e-4)
    assert angle_between(again.quat_local_ins_wxyz, turned).max() < np.deg2rad(3e-5)
    np.testing.assert_allclose(again.sigma_attitude_rad, made.sigma_attitude_rad, rtol=0, atol=1e-6)
    # between the knots too: velocities and rates come from differences
    at_ns = rng.integers(time_ns[0], time_ns[-1], 100)
    expected = CubicHermiteSpline(t, local, np.tile(speed, (60, 1)), axis=0)((at_ns - time_ns[0]) * 1e-9)
    np.testing.assert_allclose(again.at(at_ns).position_m, expected, rtol=0, atol=5e-4)


def test_the_minimum_of_columns_is_read_and_others_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "theirs.csv"
    path.write_text(
        "heading_deg, utc_ns,remark,pitch_deg,roll_deg,height_m,longitude_deg,latitude_deg\n"
        f"350,{START_NS},take-off,0,0,70,15.574,58.394\n20,{START_NS + 500_000_000},2,0,0,70,15.574,58.394\n\n"
        f"20,{START_NS + 1_600_000_001},3,0,0,70,15.574,58.394\n"
    )
    made = read_trajectory(path)
    assert made.frame == LocalFrame(58.394, 15.574, 70.0)
    assert np.isnan(made.sigma_position_m).all()
    # the short way through north
    assert (
        angle_between(
            made.at(np.array([START_NS + 250_000_000])).quat_local_ins_wxyz, Rotation.from_euler("Z", -5, degrees=True)
        )
        < 1e-3
    )
    # more than a second is a gap
    assert made.where_covered(np.array([START_NS + 1_000_000_000]))[1].tolist() == [False]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "utc_ns"),
        ("a,b\n1,2\n", "utc_ns"),
        ("utc_ns,latitude_deg\n1,2\n", "longitude_deg is missing"),
        (",".join(COLUMNS[:10]) + "\n", "0 rows"),
        (",".join(COLUMNS[:10]) + "\n5,1,1,1,1,1,1,1,1,1\n", "1 rows"),
        (",".join(COLUMNS[:10]) + "\n5,1,1,1,1,1,1,1,1,1\n5,1,1,1,1,1,1,1,1,1\n", "increasing"),
        (",".join(COLUMNS[:10]) + "\n5,1,1,1,1,1,1,1,1,x\n", "line 2"),
        (",".join(COLUMNS[:10]) + "\n5.5,1,1,1,1,1,1,1,1,1\n", "line 2"),
        (",".join(COLUMNS[:10]) + "\n5,1,1\n", "line 2"),
        (",".join(COLUMNS[:10]) + "\n5,nan,1,1,1,1,1,1,1,1\n6,1,1,1,1,1,1,1,1,1\n", "line 2"),
        (",".join(COLUMNS[:10]) + "\n5,1,1,1,1,1,1,1,1,1\n6,91,1,1,1,1,1,1,1,1\n", "line 3"),
        (",".join(COLUMNS[:10]) + f"\n{2**70},1,1,1,1,1,1,1,1,1\n", "line 2"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_trajectory_is_refused_in_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(LogError, match=said) as caught:
        read_trajectory(path)
    assert str(path) in str(caught.value)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read"):
        read_trajectory(tmp_path / "none.csv")
