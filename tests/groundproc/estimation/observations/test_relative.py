"""Steps of another odometry as rows: their matrix against differences of their own residual."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.observations.relative import RelativePoses, observed, relative_factors, steps_of
from groundproc.estimation.observations.rows import Factor, Unknowns, turned
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
INTERVALS = 40
START_NS = 1_779_000_000_000_000_000
LEVER = np.array([0.1, -0.2, 0.3])
MAT_SENSOR_INS = turned(np.array([0.35, 0.02, -0.01]))
COVARIANCE = np.diag(np.square([0.01, 0.01, 0.02, 1e-3, 1e-3, 2e-3])) + 2e-6 * np.ones((6, 6)) / 10


def pose_at(seconds: npt.NDArray[np.floating[Any]]) -> tuple[Array, Array]:
    turn = np.stack([0.2 * np.sin(3 * seconds), 0.15 * np.cos(4 * seconds), 0.8 * seconds], axis=1)
    return frames.quat_exp(turn), np.stack([4 * seconds, np.sin(2 * seconds), 8 + 0.3 * np.cos(3 * seconds)], axis=1)


@pytest.fixture
def path() -> Path:
    return Path(START_NS, *pose_at(np.arange(INTERVALS * STEPS + 1) * STEP_NS * 1e-9))


def source() -> RelativePoses:
    """The motion's own steps by its formula, stated in a frame that is anywhere."""
    seconds = np.arange(0.05, INTERVALS * 0.1 - 0.05, 0.4)
    quat, place = pose_at(seconds)
    mat = frames.mat_from_quat(quat)
    anywhere = np.array([0.3, -0.2, 1.1])
    stated = frames.quat_from_mat(turned(anywhere) @ mat @ MAT_SENSOR_INS)
    point = (place + mat @ LEVER) @ turned(anywhere).T + [100.0, -50.0, 7.0]
    covariance = np.tile(COVARIANCE, (len(seconds) - 1, 1, 1))
    time_ns = START_NS + np.rint(seconds * 1e9).astype(np.int64)
    return observed(steps_of("other odometry", time_ns, point, stated, covariance, LEVER, 0.01), arm_sigma_m=0.05)


def unknowns() -> Unknowns:
    found = Unknowns(INTERVALS)
    for name in ("world.turn", "world.shift", "ins.turn"):
        found.add(name, np.ones(3))
    source().unknowns(found)
    return found


def factor(path: Path, mat: Array = MAT_SENSOR_INS, **changes: Any) -> Factor:
    (found,) = relative_factors(replace(source(), **changes), path, unknowns(), mat, "ins.turn")
    return found


def test_a_true_path_leaves_nothing_wherever_it_lies(path: Path) -> None:
    """Straight lines between poses of 5 ms: 4 m/s^2 of swing make 12 um, of sigmas of 1 cm."""
    assert np.abs(factor(path).residual).max() < 0.02
    elsewhere = path.turned(turned(np.array([0.02, -0.3, 2.0])), np.array([10.0, 20.0, 30.0]))
    np.testing.assert_allclose(factor(elsewhere).residual, factor(path).residual, rtol=0, atol=1e-6)


def test_steps_are_weighed_by_their_whole_covariance(path: Path) -> None:
    """Against the dense covariance of one step: the cost of residuals is theirs, correlations of shift and turn included."""
    off = np.array([-0.01, 0.005, -0.01, 0.0, 0.0, 0.0])
    shifted = replace(source().given, shift_m=source().given.shift_m - off[:3])
    found = factor(path, given=shifted).residual.reshape(-1, 6) - factor(path).residual.reshape(-1, 6)
    np.testing.assert_allclose(np.square(found).sum(axis=1), off @ np.linalg.solve(COVARIANCE, off), rtol=1e-6)


def test_a_wrong_step_loses_its_weight(path: Path) -> None:
    shift = source().given.shift_m.copy()
    shift[3] += 1.0
    wrong = factor(path, given=replace(source().given, shift_m=shift)).matrix.toarray().reshape(len(shift), -1)
    share = np.linalg.norm(wrong, axis=1) / np.linalg.norm(
        factor(path).matrix.toarray().reshape(len(shift), -1), axis=1
    )
    assert share[3] < 0.3
    np.testing.assert_allclose(np.delete(share, 3), 1.0)


@pytest.mark.parametrize("name", ["ins.turn", "relative.delay", "relative.lever"])
def test_rows_follow_the_source(path: Path, name: str) -> None:
    size = 1e-3 if name.endswith("delay") else 1e-4

    def moved(change: Array) -> Array:
        if name == "ins.turn":
            return factor(path, turned(change) @ MAT_SENSOR_INS).residual
        if name.endswith("delay"):
            return factor(path, clock=replace(source().clock, delay_s=change)).residual
        return factor(path, arm=replace(source().arm, off_m=change)).residual

    place = unknowns().names[name]
    stated = factor(path).matrix.toarray()[:, place]
    steps = size * np.eye(place.stop - place.start)
    found = np.stack([(moved(step) - moved(-step)) / (2 * size) for step in steps], axis=1)
    # velocities and rates are those of 25 ms, and the step's own turn of some tenths of a radian changes the rotation vector's axes
    share = 0.2 if name.endswith("delay") else 0.02
    assert np.abs(stated - found).max() < share * np.abs(found).max()


def test_rows_follow_the_path(path: Path) -> None:
    stated = factor(path).matrix.toarray()
    for column in (6 * 10, 6 * 15 + 1, 6 * 20 + 2, 6 * 12 + 3, 6 * 21 + 4, 6 * 30 + 5):
        step = np.zeros((INTERVALS + 3) * 6)
        step[column] = 1e-4
        ahead, behind = (factor(path.corrected(s * step.reshape(-1, 6))).residual for s in (1.0, -1.0))
        np.testing.assert_allclose(
            stated[:, column], (ahead - behind) / 2e-4, rtol=0, atol=5e-3 * np.abs(stated[:, column]).max()
        )


def test_a_path_that_covers_no_step_has_no_rows(path: Path) -> None:
    far = replace(source().given, time_ns=source().given.time_ns + 10**12)
    assert relative_factors(replace(source(), given=far), path, unknowns(), MAT_SENSOR_INS, None) == []
