"""Positions from outside as rows: their matrix against differences, their weight against the sigma of a mean of errors that last."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.observations.observation import Outcome
from groundproc.estimation.observations.outside import (
    LEAST_SIGMA_M,
    LEAST_SIGMA_RAD,
    Outside,
    observed,
    outside_factors,
)
from groundproc.estimation.observations.pieces import laid_by_pieces
from groundproc.estimation.observations.rows import Factor, Unknowns, turned
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
INTERVALS = 60
START_NS = 1_779_000_000_000_000_000
DELAY, ARM = "outside.delay", "outside.lever"
LEVER = np.array([0.1, -0.2, 0.3])
MAT_SENSOR_INS = turned(np.array([0.35, 0.02, -0.01]))


def pose_at(seconds: npt.NDArray[np.floating[Any]]) -> tuple[Array, Array]:
    turn = np.stack([0.2 * np.sin(3 * seconds), 0.15 * np.cos(4 * seconds), 0.8 * seconds], axis=1)
    return frames.quat_exp(turn), np.stack([4 * seconds, np.sin(2 * seconds), 8 + 0.3 * np.cos(3 * seconds)], axis=1)


@pytest.fixture
def path() -> Path:
    quat, place = pose_at(np.arange(INTERVALS * STEPS + 1) * STEP_NS * 1e-9)
    return Path(START_NS, quat, place)


def outside(error_m: Array | None = None, every_s: float = 0.2) -> Outside:
    """The motion's own positions and attitudes, by its formula."""
    seconds = np.arange(0.05, INTERVALS * 0.1 - 0.05, every_s)
    quat, place = pose_at(seconds)
    mat = frames.mat_from_quat(quat)
    count = len(seconds)
    spread = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.0], [0.5, 0.0, 9.0]]) * 1e-4
    return Outside(
        "better.pos",
        START_NS + np.rint(seconds * 1e9).astype(np.int64),
        place + mat @ LEVER + (0.0 if error_m is None else error_m),
        np.tile(spread, (count, 1, 1)),
        LEVER,
        np.full(count, 20.0),
        frames.quat_from_mat(mat @ MAT_SENSOR_INS),
        np.tile(np.eye(3) * 1e-6, (count, 1, 1)),
        0.01,
    )


def unknowns() -> Unknowns:
    found = Unknowns(INTERVALS)
    for name, size in (("world.turn", 3), ("world.shift", 3), ("ins.turn", 3), (DELAY, 1), (ARM, 3)):
        found.add(name, np.ones(size))
    return found


def factors(
    given: Outside, path: Path, delay_s: float = 0.0, mat: Array = MAT_SENSOR_INS, arm_m: Array | None = None
) -> list[Factor]:
    source = observed(given)
    clock, arm = replace(source.clock, delay_s=np.array([delay_s])), source.arm
    if arm_m is not None:
        arm = replace(arm, off_m=arm_m)
    return outside_factors(given, path, unknowns(), clock, arm, mat, "ins.turn")


def test_a_true_path_leaves_nothing(path: Path) -> None:
    for factor in factors(outside(), path):
        # straight lines between poses of 5 ms: 4 m/s^2 of swing make 12 um
        assert np.abs(factor.residual).max() < 0.01


@pytest.mark.parametrize("name", ["world.turn", "world.shift", DELAY, ARM, "ins.turn"])
def test_rows_follow_what_is_common(path: Path, name: str) -> None:
    size = 1e-4

    def moved(change: Array) -> Array:
        if name == DELAY:
            found = factors(outside(), path, float(change[0]))
        elif name == ARM:
            found = factors(outside(), path, arm_m=change)
        elif name == "ins.turn":
            found = factors(outside(), path, mat=turned(change) @ MAT_SENSOR_INS)
        else:
            turn, shift = (change, np.zeros(3)) if name == "world.turn" else (np.zeros(3), change)
            found = factors(outside(), path.turned(turned(turn), shift))
        return np.concatenate([factor.residual for factor in found])

    place = unknowns().names[name]
    stated = np.concatenate([factor.matrix.toarray()[:, place] for factor in factors(outside(), path)])
    steps = size * np.eye(place.stop - place.start)
    found = np.stack([(moved(step) - moved(-step)) / (2 * size) for step in steps], axis=1)
    # velocities and rates are those of 25 ms, of a motion of up to 4 rad/s
    if name == DELAY:
        assert np.abs(stated - found).max() < 0.15 * np.abs(found).max()
    else:
        np.testing.assert_allclose(stated, found, rtol=0, atol=2e-3 * np.abs(found).max())


def test_rows_follow_the_path(path: Path) -> None:
    """Some coefficients of the spline, each by differences: rows are means of a second, taken at its middle."""
    whole = factors(outside(every_s=1.0), path)

    def residual(of: Path) -> Array:
        return np.concatenate([f.residual for f in factors(outside(every_s=1.0), of)])

    for column in (6 * 20, 6 * 20 + 2, 6 * 20 + 3, 6 * 31 + 5, 6 * 40 + 1):
        step = np.zeros((INTERVALS + 3) * 6)
        step[column] = 1e-4
        change = residual(path.corrected(step.reshape(-1, 6))) - residual(path.corrected(-step.reshape(-1, 6)))
        stated = np.concatenate([f.matrix.toarray()[:, column] for f in whole])
        np.testing.assert_allclose(stated, change / 2e-4, rtol=0, atol=2e-3 * max(np.abs(stated).max(), 1.0))


def test_the_mean_is_as_well_known_as_lasting_errors_allow(path: Path) -> None:
    """Information on a shift of the whole, against the variance of the mean of an autoregressive process by its sum."""
    given = outside()
    rows = factors(given, path)[0].matrix.toarray()[:, unknowns().names["world.shift"]]
    found = np.linalg.inv(rows.T @ rows)
    count = 6
    keep = np.exp(-np.abs(np.subtract.outer(np.arange(count), np.arange(count))) / 20.0)
    exact = (given.covariance_m2[0] + LEAST_SIGMA_M**2 * np.eye(3)) * keep.mean()
    ratio = np.diag(found) / np.diag(exact)
    # six seconds are short against errors of 20 s: careful, and by no more than the white noise of infinite length is
    assert (ratio > 1.0).all()
    assert (ratio < (1 + np.exp(-1 / 20)) / (1 - np.exp(-1 / 20)) / count).all() or (ratio < 9.0).all()


def test_a_wrong_fix_loses_its_weight_and_a_shift_of_all_does_not(path: Path) -> None:
    error = np.zeros((len(outside().time_ns), 3))
    error[10:15] = [0.0, 0.0, 2.0]
    usual, shifted, wrong = (factors(outside(e), path)[0] for e in (None, np.full_like(error, 3.0), error))
    place = unknowns().names["world.shift"]
    weight = [np.linalg.norm(f.matrix.toarray()[:, place].reshape(-1, 9), axis=1) for f in (usual, shifted, wrong)]
    np.testing.assert_allclose(weight[1], weight[0])
    assert np.count_nonzero(weight[2] < 0.3 * weight[0]) == 1
    assert np.count_nonzero(weight[2] > 0.99 * weight[0]) == len(weight[0]) - 1


def test_what_lies_outside_the_path_or_has_no_sigma_of_attitude_is_no_row(path: Path) -> None:
    given = outside()
    assert factors(replace(given, time_ns=given.time_ns + 10**12), path) == []
    assert [f.name for f in factors(replace(given, quat=None), path)] == ["outside position"]
    unknown = np.full_like(given.covariance_m2, np.nan)
    assert [f.name for f in factors(replace(given, attitude_covariance_rad2=unknown), path)] == ["outside position"]


def test_pieces_between_blind_stretches_are_laid_on_the_positions(path: Path) -> None:
    """From 2 to 4 s nothing is seen; what comes after is a metre off and turned, with what lies between drifting there."""
    view = np.ones(INTERVALS, np.bool_)
    view[20:40] = False
    share = np.clip((np.arange(len(path.quat)) / STEPS - 20) / 20, 0.0, 1.0)[:, None]
    turn = np.array([0.0, 0.0, 0.05])
    strayed = Path(
        START_NS,
        frames.quat_multiply(frames.quat_exp(share * turn), path.quat),
        path.position_m + share * (path.position_m @ (turned(turn) - np.eye(3)).T + [0.6, -0.9, 1.1]),
    )
    given = outside()

    def laid(seen: npt.NDArray[np.bool_], sigma_m: float = 0.02) -> Path:
        return laid_by_pieces(strayed, given.time_ns, given.position_m, given.lever_m, sigma_m, seen)

    found = laid(view)
    off = np.linalg.norm(found.position_m - path.position_m, axis=1)
    seen = np.repeat(view, STEPS)
    # 8 m of path tell a heading to what the noise of nothing leaves; medians of a curved path are no mean
    assert off[:-1][seen].max() < 0.02
    # between, where the place itself goes 8 m on while the turn grows by 0.05 rad: a quarter of the product, bent
    assert off.max() < 0.25 * 8.0 * 0.05 * 1.2
    assert np.abs(np.diff(off)).max() < 0.01
    wrong = frames.quat_log(frames.quat_multiply(found.quat, frames.quat_inverse(path.quat)))
    assert np.abs(wrong[:-1][seen]).max() < 0.01
    assert laid(np.ones(INTERVALS, np.bool_)) is strayed
    assert laid(view, sigma_m=1.0) is strayed


def test_a_full_covariance_of_a_pose_ties_position_to_attitude(path: Path) -> None:
    """One pose a second, off by known amounts: the cost is that of the dense 6 x 6, but for the factor that lasting errors take."""
    given = outside(every_s=1.0)
    count = len(given.time_ns)
    crossed = np.array([[2e-5, 0.0, 0.0], [0.0, -1e-5, 5e-6], [0.0, 0.0, 1e-5]])
    off, turn = np.array([0.02, -0.01, 0.03]), np.array([1e-3, 2e-3, -1e-3])
    assert given.quat is not None
    assert given.attitude_covariance_rad2 is not None
    wrong = replace(
        given,
        position_m=given.position_m - off,
        quat=frames.quat_multiply(np.tile(frames.quat_exp(-turn[None]), (count, 1)), given.quat),
        cross_covariance=np.tile(crossed, (count, 1, 1)),
    )
    (factor,) = factors(wrong, path)
    assert factor.name == "outside pose"
    dense = np.block(
        [
            [given.covariance_m2[0] + LEAST_SIGMA_M**2 * np.eye(3), crossed],
            [crossed.T, given.attitude_covariance_rad2[0] + LEAST_SIGMA_RAD**2 * np.eye(3)],
        ]
    )
    residual = np.concatenate([off, turn])
    keep = np.exp(-1.0 / 20.0)
    expected = residual @ np.linalg.solve(dense, residual) * (1.0 - keep) / (1.0 + keep)
    # the path is straight between poses of 5 ms: 12 um and 50 urad of it
    np.testing.assert_allclose(np.square(factor.residual.reshape(-1, 6)).sum(axis=1), expected, rtol=0.05)
    apart = factors(replace(wrong, cross_covariance=None), path)
    assert [each.name for each in apart] == ["outside position", "outside attitude"]
    # the rows are those of the two, whitened together
    white = np.linalg.inv(np.linalg.cholesky(dense))
    alone = [np.linalg.cholesky(dense[k : k + 3, k : k + 3]) for k in (0, 3)]
    plain = np.concatenate(
        [lower @ each.matrix.toarray().reshape(count, 3, -1) for lower, each in zip(alone, apart, strict=True)], 1
    )
    np.testing.assert_allclose(factor.matrix.toarray().reshape(count, 6, -1), white @ plain, rtol=0, atol=1e-6)


def test_each_source_reports_its_own_residuals_of_whole_poses_too(path: Path) -> None:
    logs: list[dict[str, Any]] = [{"outside position_rms": 0.5, "outside2 pose_rms": 3.0}]
    outcome = Outcome(path, logs, [], False)
    first, second = observed(outside()), observed(replace(outside(), source="images"), "outside2")
    assert [each.report(outcome)["outside"][0]["residual_rms"] for each in (first, second)] == [0.5, 3.0]
    assert first.warnings(outcome) == []
    assert "differs from images by 3.0 times" in second.warnings(outcome)[0]


def test_each_source_has_a_clock_and_a_lever_arm_of_its_own(path: Path) -> None:
    del path
    found = Unknowns(INTERVALS)
    for source in (observed(outside()), observed(replace(outside(), delay_sigma_s=0.02), "images", arm_sigma_m=0.03)):
        source.unknowns(found)
    assert {name: sigma.tolist() for name, sigma in found.sigma.items()} == {
        "outside.delay": [0.01], "images.delay": [0.02], "images.lever": [0.03] * 3,
    }  # fmt: skip
    assert found.unit == {"outside.delay": "s", "images.delay": "s", "images.lever": "m"}
    source = observed(outside(), "images", arm_sigma_m=0.03)
    solution = {
        "images.delay": np.array([0.004]),
        "images.lever": np.array([0.01, 0.0, -0.02]),
        "outside.delay": np.ones(1),
    }
    source.take(solution, Path(0, np.zeros((1, 4)), np.zeros((1, 3))))
    np.testing.assert_allclose(source.clock.delay_s, [0.004])
    np.testing.assert_allclose(source.arm.lever_m, LEVER + np.array([0.01, 0.0, -0.02]))
    joined = source.joined({"images.delay": np.array([0.005]), "images.lever": LEVER}, [])
    held = Unknowns(INTERVALS)
    joined.unknowns(held)
    assert not held.names
    np.testing.assert_allclose(joined.arm.lever_m, LEVER)
