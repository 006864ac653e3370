"""Turns between the knots: a gyro's noise in the path of a lidar that spins in a room, and what the walls say of it."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.adjustment import fine
from groundproc.estimation.adjustment.fine import BACK_S, apart, gyro_information, refined, solved
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE, Slice
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
START_NS = 1_779_000_000_000_000_000
SLICES = 25
BEFORE = 3
"""Slices of the grid before the path begins."""
DENSITY = np.deg2rad(0.13)
RETURNS = 8000
WALL_M = 9.7
VOXEL_M = 1.0
"""A voxel then sees a hundred returns and more, and no wall is on a border of voxels."""


@pytest.fixture(scope="module")
def true() -> Path:
    seconds = np.arange(SLICES * STEPS + 1) * STEP_NS * 1e-9
    turn = np.stack([0.1 * np.sin(3 * seconds), 0.1 * np.cos(4 * seconds), 0.4 * seconds], axis=1)
    place = np.stack([np.sin(seconds), np.cos(seconds), 0.3 * np.cos(3 * seconds)], axis=1)
    return Path(START_NS, frames.quat_exp(turn), place)


@pytest.fixture(scope="module")
def pieces(true: Path) -> list[Slice]:
    """Returns from six walls with 15 mm of noise; the lasers look along one azimuth at a time, ten turns a second."""
    rng = np.random.default_rng(1)
    found = []
    for number in range(SLICES):
        since_ns = np.sort(rng.integers(0, SLICE_NS, RETURNS))
        g = (number * SLICE_NS + since_ns) / STEP_NS
        step, share = g.astype(int), (g % 1.0)[:, None]
        azimuth, elevation = 2.0 * np.pi * since_ns / SLICE_NS, rng.uniform(-0.5, 0.2, RETURNS)
        flat = np.cos(elevation)
        ray = np.stack([np.sin(azimuth) * flat, np.cos(azimuth) * flat, np.sin(elevation)], axis=1)
        mats = frames.mat_from_quat(true.quat)
        mat = mats[step] + share[:, :, None] * (mats[step + 1] - mats[step])
        place = true.position_m[step] + share * (true.position_m[step + 1] - true.position_m[step])
        out = np.einsum("nij,nj->ni", mat, ray)
        reach = ((WALL_M - np.sign(out) * place) / np.abs(out)).min(axis=1) + 0.015 * rng.normal(size=RETURNS)
        xyz = (reach[:, None] * ray).astype(np.float32)
        found.append(Slice(BEFORE + number, START_NS + number * SLICE_NS + since_ns, xyz))
    return found


def noisy(true: Path) -> Path:
    """With a gyro's noise that the knots bring back within a tenth of a second."""
    rng = np.random.default_rng(2)
    step_s = STEP_NS * 1e-9
    keep = np.exp(-step_s / BACK_S)
    off = np.zeros((len(true.quat), 3))
    for i in range(1, len(off)):
        off[i] = keep * off[i - 1] + DENSITY * np.sqrt(step_s) * rng.normal(size=3)
    return Path(START_NS, frames.quat_multiply(true.quat, frames.quat_exp(off)), true.position_m)


def off_rad(path: Path, true: Path) -> Array:
    return frames.quat_log(frames.quat_multiply(frames.quat_inverse(true.quat), path.quat))


def at(path: Path, pieces: list[Slice]) -> Path:
    return refined(path, pieces, START_NS - BEFORE * SLICE_NS, DENSITY, VOXEL_M)


def test_what_all_returns_say_takes_half_of_the_noise_out(true: Path, pieces: list[Slice]) -> None:
    """Its variance, that is: a return of 2 cm at 10 m tells a turn to 0.1 deg, 250 of them in 5 ms two axes to 7 mdeg or so."""
    path = noisy(true)
    made = at(path, pieces)
    before, after = (np.square(off_rad(each, true)).mean() for each in (path, made))
    assert after < 0.5 * before
    assert made.position_m is path.position_m
    assert len(made.quat) == len(path.quat)


def test_a_path_without_noise_gets_next_to_none(true: Path, pieces: list[Slice]) -> None:
    """A third of what the gyro is believed to have."""
    made = at(true, pieces)
    believed = DENSITY * np.sqrt(0.5 * BACK_S)
    assert np.sqrt(np.square(off_rad(made, true)).mean()) < believed / 3.0


def test_parts_of_a_flight_go_on_where_the_one_before_ended(
    true: Path, pieces: list[Slice], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two poses the turns differ by the gyro's noise over 5 ms, at the borders of the parts as elsewhere."""
    path = noisy(true)
    monkeypatch.setattr(fine, "CHUNK", 10)
    made = at(path, pieces)
    steps = np.diff(off_rad(made, path), axis=0)
    borders = np.array([10, 20]) * STEPS
    assert np.linalg.norm(steps[borders - 1], axis=1).max() < np.linalg.norm(steps, axis=1).max() + 1e-9
    assert np.linalg.norm(steps[borders - 1], axis=1).max() < 4.0 * DENSITY * np.sqrt(STEP_NS * 1e-9)
    before, after = (np.square(off_rad(each, true)).mean() for each in (path, made))
    assert after < 0.7 * before  # a second's map is not as good as that of two and a half


def test_two_parts_at_once_give_what_one_after_the_other_does(
    true: Path, pieces: list[Slice], monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for the order of a few sums, at the poses beside the slice between them."""
    path = noisy(true)
    parted = at(path, pieces)
    monkeypatch.setattr(fine, "apart", lambda clusters: [[], [], clusters])
    np.testing.assert_allclose(parted.quat, at(path, pieces).quat, rtol=0, atol=1e-13)


def test_parts_share_no_pose_and_slices_out_of_order_are_not_parted() -> None:
    def seen(*numbers: int) -> list[npt.NDArray[np.void]]:
        found = []
        for number in numbers:
            some = np.zeros(3, CLUSTER_DTYPE)
            some["time_ns"] = START_NS + number * SLICE_NS + np.array([0, SLICE_NS // 2, SLICE_NS])
            found.append(some)
        return found

    slices = seen(0, 1, 2, 3, 4)
    assert [list(map(id, part)) for part in apart(slices)] == [
        list(map(id, part)) for part in (slices[:2], slices[3:], slices[2:3])
    ]
    for some in (seen(0, 3, 2, 1, 4), seen(0, 1, 1, 1, 2), seen(0, 1), seen()):
        assert [len(part) for part in apart(some)] == [0, 0, len(some)]


def test_where_the_lidar_sees_nothing_the_path_stays(true: Path, pieces: list[Slice]) -> None:
    path = noisy(true)
    half = [piece for piece in pieces if piece.number < BEFORE + 10]
    made = at(path, half)
    np.testing.assert_array_equal(made.quat[10 * STEPS + 1 :], path.quat[10 * STEPS + 1 :])
    np.testing.assert_array_equal(at(path, []).quat, path.quat)


def test_pieces_beyond_the_path_are_passed_over(true: Path, pieces: list[Slice]) -> None:
    def further() -> Iterator[Slice]:
        first = pieces[0]
        yield Slice(0, first.time_ns - BEFORE * SLICE_NS, first.xyz_m)
        yield from pieces
        yield Slice(BEFORE + SLICES, first.time_ns + SLICES * SLICE_NS, first.xyz_m)

    path = noisy(true)
    made = refined(path, further(), START_NS - BEFORE * SLICE_NS, DENSITY, VOXEL_M)
    np.testing.assert_array_equal(made.quat, at(path, pieces).quat)


def test_the_banded_system_is_solved_as_the_dense_one() -> None:
    rng = np.random.default_rng(3)
    quat = frames.quat_exp(np.cumsum(0.05 * rng.normal(size=(7, 3)), axis=0))
    diagonal, beside = gyro_information(quat, DENSITY)
    dense = np.zeros((21, 21))
    for i in range(7):
        dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = diagonal[i]
    for i in range(6):
        dense[3 * i : 3 * i + 3, 3 * i + 3 : 3 * i + 6] = beside[i]
        dense[3 * i + 3 : 3 * i + 6, 3 * i : 3 * i + 3] = beside[i].T
    right = rng.normal(size=(7, 3))
    expected = np.linalg.solve(dense, right.ravel()).reshape(7, 3)
    np.testing.assert_allclose(
        solved(diagonal, beside, right), expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max()
    )


def test_the_gyros_noise_is_that_of_a_process_that_something_brings_back() -> None:
    """Its covariance, the inverse: equal variances of density^2 tau / 2, and what is left of them after each step."""
    count = 6
    diagonal, beside = gyro_information(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), DENSITY)
    dense = np.diag(diagonal[:, 0, 0]) + np.diag(beside[:, 0, 0], 1) + np.diag(beside[:, 0, 0], -1)
    lag = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    expected = 0.5 * DENSITY**2 * BACK_S * np.exp(-lag * STEP_NS * 1e-9 / BACK_S)
    np.testing.assert_allclose(np.linalg.inv(dense), expected, rtol=1e-9)
