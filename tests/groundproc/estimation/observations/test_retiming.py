"""The delay of the gyro that carries the motion: what a path does between its knots, put right by samples and told by surfaces."""

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.observations.planes import rows_of
from groundproc.estimation.observations.retiming import Retiming, retiming_column
from groundproc.estimation.observations.rows import Unknowns
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.motion import ImuTrack
from groundproc.estimation.odometry.spline import Path, smooth_path

Array = npt.NDArray[np.float64]
START_NS = 1_779_000_000_000_000_000
INTERVALS = 40
STEP_S = STEP_NS * 1e-9
LATE_S = 0.005
NAME = "lidar.delay"


def attitude_at(seconds: Array) -> Array:
    """Once round in 8 s, gusts of 9 and 14 Hz of 0.3 deg."""
    phase = 2.0 * np.pi * seconds[:, None] * [9.0, 14.0, 11.0] + [0.3, 1.0, 2.0]
    heading = np.stack([0.0 * seconds, 0.0 * seconds, np.pi * seconds / 4], axis=1)
    return frames.quat_multiply(frames.quat_exp(heading), frames.quat_exp(np.deg2rad(0.3) * np.sin(phase)))


def true_path() -> Path:
    seconds = np.arange(INTERVALS * STEPS + 1) * STEP_S
    return Path(START_NS, attitude_at(seconds), np.stack([np.sin(seconds), np.cos(seconds), 0.2 * seconds], axis=1))


def gyro(late_s: float) -> ImuTrack:
    """A gyro at 1 kHz whose readings are older than their stamps: differences over 0.2 ms of the true attitude."""
    seconds = np.arange(-0.2, INTERVALS * STEPS * STEP_S + 0.2, 1e-3)
    before, behind = attitude_at(seconds - late_s - 1e-4), attitude_at(seconds - late_s + 1e-4)
    rate = frames.quat_log(frames.quat_multiply(frames.quat_inverse(before), behind)) / 2e-4
    return ImuTrack("lidar", START_NS + np.rint(seconds * 1e9).astype(np.int64), rate, np.zeros_like(rate), 1e-3, 1.0)


def carried(track: ImuTrack, true: Path) -> Path:
    """A path that is right at its knots and goes by a gyro between them."""
    first = int(np.searchsorted(track.time_ns, START_NS - 500_000))
    steps = INTERVALS * STEPS
    each = np.arange(steps)[:, None] * 5 + np.arange(6) + first  # a step is five samples on, trapezium by trapezium
    rate = np.tensordot(track.rate_rad_s[each], np.array([0.1, 0.2, 0.2, 0.2, 0.2, 0.1]), axes=(1, 0))
    return smooth_path(START_NS, rate, true.quat[::STEPS], true.position_m[::STEPS])


def off_deg(path: Path, true: Path) -> float:
    """RMS of the attitude's error away from the ends."""
    inside = slice(2 * STEPS, -2 * STEPS)
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(true.quat[inside]), path.quat[inside]))
    return float(np.rad2deg(np.sqrt(np.square(turn).mean())))


def room(path: Path, count: int = 20_000) -> Clusters:
    """What a lidar sees of six walls, 9.7 m away, with a path's poses; 5 mm of noise."""
    rng = np.random.default_rng(1)
    step = np.sort(rng.integers(2 * STEPS, len(path.quat) - 2 * STEPS, count))
    ray = rng.normal(size=(count, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    out = np.einsum("nij,nj->ni", frames.mat_from_quat(path.quat)[step], ray)
    reach = ((9.7 - np.sign(out) * path.position_m[step]) / np.abs(out)).min(axis=1)
    xyz = (reach + 0.005 * rng.normal(size=count))[:, None] * ray
    return Clusters(
        START_NS + step * STEP_NS, xyz.astype(np.float32), np.zeros((count, 6), np.float32), np.full(count, 8, np.int32)
    )


def test_a_path_is_put_right_by_the_samples_of_its_gyro() -> None:
    """Gusts of 0.3 deg go through 0.28 rad more in 5 ms: 60 mdeg off; half and half again is the whole."""
    true, track = true_path(), gyro(LATE_S)
    path = carried(track, true)
    assert off_deg(path, true) > 0.04
    retiming = Retiming(NAME, 0.005, track)
    for _ in range(2):
        part = {NAME: np.array([LATE_S / 2.0])}
        path = retiming.retimed(path, part)
        retiming.take(part)
    assert off_deg(path, true) < 0.02 * 0.04 + 0.001
    np.testing.assert_allclose(path.quat[::STEPS], true.quat[::STEPS], rtol=0, atol=1e-9)


def test_where_the_gyro_was_silent_a_path_stays() -> None:
    true, whole = true_path(), gyro(LATE_S)
    seconds = (whole.time_ns - START_NS) * 1e-9
    kept = (seconds < 1.5) | (seconds > 2.5)
    track = ImuTrack("lidar", whole.time_ns[kept], whole.rate_rad_s[kept], whole.force_m_s2[kept], 1e-3, 1.0)
    path = carried(whole, true)
    found = Retiming(NAME, 0.005, track).retimed(path, {NAME: np.array([LATE_S])})
    gap = slice(round(1.7 / STEP_S), round(2.3 / STEP_S))
    np.testing.assert_allclose(found.quat[gap], path.quat[gap], rtol=0, atol=np.deg2rad(0.001))


def test_rows_change_by_the_column_as_the_gyro_is_retimed() -> None:
    true, track = true_path(), gyro(0.0)
    clusters, retiming, change = room(true, 4000), Retiming(NAME, 0.005, track), 2e-4
    turning = retiming.turning(true)
    rows = rows_of(clusters, true, 1.0, 10**6, cut=False, turning=turning)
    column = retiming_column(rows.jacobian, turning, clusters.time_ns[rows.cluster], true)
    step = (clusters.time_ns[rows.cluster] - START_NS) // STEP_NS
    moved = retiming.retimed(true, {NAME: np.array([change])})
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(true.quat), moved.quat))[step]
    expected = np.einsum("ni,ni->n", rows.jacobian[:, :3].astype(float), turn)
    # rates over 10 ms are a thirtieth too small at 14 Hz
    np.testing.assert_allclose(column.along(np.array([change])), expected, rtol=0, atol=0.05 * np.abs(expected).max())
    rng = np.random.default_rng(5)
    x, y = rng.normal(size=(2, rows.size))
    assert rows.size == rows.path_size + 1
    np.testing.assert_allclose(
        rows.apply(x), rows.spread(rows.along(x)), rtol=1e-5, atol=1e-5 * np.abs(rows.apply(x)).max()
    )
    assert x @ rows.apply(y) == pytest.approx(y @ rows.apply(x), rel=1e-6)


def test_surfaces_tell_a_delay_that_no_spline_follows() -> None:
    true, track = true_path(), gyro(LATE_S)
    clusters, path = room(true), carried(track, true)
    retiming = Retiming(NAME, 0.005, track)
    for _ in range(4):
        rows = rows_of(clusters, path, 1.0, 10**6, cut=False, turning=retiming.turning(path))
        part = {NAME: -rows.gradient()[rows.path_size :] / rows.corner[0]}
        path = retiming.retimed(path, part)
        retiming.take(part)
    sigma = float(rows.corner[0, 0] ** -0.5)
    assert sigma < 0.0003
    assert retiming.delay_s[0] == pytest.approx(LATE_S, abs=3.0 * sigma)
    unknowns = Unknowns(2)
    retiming.unknowns(unknowns)
    assert unknowns.value[NAME] is retiming.delay_s
