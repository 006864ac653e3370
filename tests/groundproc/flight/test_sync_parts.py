"""The parts of the gyros' synchronisation, each against a plain calculation or a law of its own."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from flightlog.errors import SyncError
from groundproc.flight.sync import GyroTrack, correlation, synchronise
from groundproc.flight.sync.fit import _bias_projector, _covariance, _weights, fit
from groundproc.flight.sync.tracks import low_pass

Array = npt.NDArray[np.float64]
S = 10**9


def track(seconds: float, hz: float, name: str = "a gyro", seed: int = 1, start_ns: int = 0) -> GyroTrack:
    """Noise of 10 deg/s below some hertz: rates that no other stretch repeats."""
    time_s = np.arange(0.0, seconds, 1.0 / hz)
    grid = np.arange(0.0, seconds + 1.0, 0.005)
    smooth = low_pass(np.random.default_rng(seed).normal(size=(len(grid), 3)), 3.0, 200.0)
    smooth *= np.deg2rad(10.0) / smooth.std()
    rates = np.stack([np.interp(time_s, grid, axis) for axis in smooth.T], axis=1)
    return GyroTrack(name, start_ns + np.rint(time_s * S).astype(np.int64), rates)


# Tracks --------------------------------------------------------------------------------------------------------------


def test_the_rate_of_a_track_is_the_median_of_its_steps() -> None:
    times = np.cumsum([0, 10, 10, 10, 500, 10, 12, 10]) * 10**6
    assert GyroTrack("a", times, np.zeros((8, 3))).rate_hz == 100.0
    for few in (0, 1):
        assert GyroTrack("a", times[:few], np.zeros((few, 3))).rate_hz == 0.0
    assert GyroTrack("a", times[:2], np.zeros((2, 3))).rate_hz == 100.0


@pytest.mark.parametrize("rate_hz", [100.0, 400.0])
@pytest.mark.parametrize("cutoff_hz", [2.0, 5.0])
def test_a_low_pass_keeps_what_is_constant_and_half_the_power_at_its_cut_off(rate_hz: float, cutoff_hz: float) -> None:
    time_s = np.arange(0.0, 10.0, 1.0 / rate_hz)
    middle = slice(len(time_s) // 4, 3 * len(time_s) // 4)
    values = np.stack([np.sin(2 * np.pi * cutoff_hz * time_s), np.full(len(time_s), 3.0)], axis=1)
    found = low_pass(values, cutoff_hz, rate_hz)
    # a Gaussian's kernel ends at four sigma, which leaves out 6e-5 of it
    assert (found[middle, 0] ** 2).mean() == pytest.approx(0.5 * (values[middle, 0] ** 2).mean(), rel=1e-3)
    np.testing.assert_allclose(found[:, 1], 3.0)
    # no delay: what is left of the sine crosses zero where it did
    np.testing.assert_allclose(found[middle, 0], np.sqrt(0.5) * values[middle, 0], rtol=0, atol=1e-3)


# Correlation -----------------------------------------------------------------------------------------------------------


def test_sums_over_all_lags_are_those_of_two_loops() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(7, 3)), rng.normal(size=(5, 2))
    found = correlation._lagged(a, b)
    assert found.shape == (len(a) + len(b) - 1, 2, 3)
    for place, lag in enumerate(range(1 - len(a), len(b))):
        expected = sum(np.outer(b[i + lag], a[i]) for i in range(len(a)) if 0 <= i + lag < len(b))
        np.testing.assert_allclose(found[place], expected, rtol=0, atol=1e-12)


def test_the_rotation_of_a_correlation_is_the_one_that_aligns_the_vectors_best() -> None:
    rng = np.random.default_rng(3)
    turned = Rotation.random(rng=4)
    a = rng.normal(size=(50, 3))
    b = turned.apply(a) + 0.05 * rng.normal(size=(50, 3))
    found = correlation._rotation(b.T @ a, None)
    expected, _ = Rotation.align_vectors(b, a)
    np.testing.assert_allclose(found, expected.as_matrix(), rtol=0, atol=1e-12)
    # a mirrored axis is kept where the data insist
    mirrored = correlation._rotation((b * [1, 1, -1]).T @ a, np.eye(3))
    assert np.linalg.det(mirrored) == pytest.approx(-1.0)
    # vectors in a plane do not tell what is across it: the mount does, and without one a rotation is taken, no reflection
    flat = a * [1.0, 1.0, 0.0]
    mount = turned.as_matrix()
    assert correlation._rotation(flat.T @ flat, mount) is mount
    assert np.linalg.det(correlation._rotation(turned.apply(flat).T @ flat, None)) == pytest.approx(1.0)


@pytest.mark.parametrize("offset_s", [-4.0, 0.0, 12.34])
def test_the_peak_of_a_track_with_a_later_part_of_itself_is_one_at_the_true_shift(offset_s: float) -> None:
    whole = track(60.0, 200.0)
    part = slice(2000, 9000, 8)
    ins = GyroTrack("b", whole.time_ns[part] + round(offset_s * S), whole.rate_rad_s[part])
    peak = correlation.correlate(whole, ins, None, None, 15.0)
    assert abs(peak.offset_ns - offset_s * S) <= 0.5 * S / correlation.GRID_HZ
    assert 0.95 < peak.height <= 1.001
    offsets, score = peak.curve
    assert np.diff(offsets).tolist() == [S / correlation.GRID_HZ] * (len(offsets) - 1)
    assert score[np.argmin(np.abs(offsets - peak.offset_ns))] == score.max() == peak.height
    away = np.abs(offsets - peak.offset_ns) > S
    assert peak.rival == score[away].max() < 0.7
    np.testing.assert_allclose(peak.mat_ins_lidar, np.eye(3), rtol=0, atol=0.02)
    # at least 10 s in common at either end of what was tried
    assert offsets.min() > ins.time_ns[0] - whole.time_ns[-1] + 9.5 * S
    assert offsets.max() < ins.time_ns[-1] - whole.time_ns[0] - 9.5 * S


def test_odds_are_those_of_two_gaussian_models_over_independent_values() -> None:
    """n/2 log((1 - rival^2) / (1 - peak^2)), n being twice the bandwidth of 1 Hz times the time in common."""
    whole = track(60.0, 200.0)
    ins = GyroTrack("b", whole.time_ns[2000:9000:8], whole.rate_rad_s[2000:9000:8])
    peak = correlation.correlate(whole, ins, None, None, 15.0)
    values = 2.0 * len(ins.time_ns) / 25.0
    expected = 0.5 * values * np.log((1 - peak.rival**2 + 1e-9) / (1 - min(peak.height, 1.0) ** 2 + 1e-9))
    assert peak.log_odds == pytest.approx(expected, rel=1e-6)


def test_a_search_about_what_is_expected_tries_nothing_farther_off() -> None:
    whole = track(60.0, 200.0)
    ins = GyroTrack("b", whole.time_ns[::8] + 5 * S, whole.rate_rad_s[::8])
    peak = correlation.correlate(whole, ins, None, 4 * S, 2.0)
    offsets, _ = peak.curve
    assert (offsets.min(), offsets.max()) == (2 * S, 6 * S)
    with pytest.raises(
        SyncError, match=r"^gyros of a gyro and b: no shift within 2 s of what the receive times say overlaps by 10 s$"
    ):
        correlation.correlate(whole, ins, None, 1000 * S, 2.0)


@pytest.mark.parametrize("short", ["the lidar", "the autopilot"])
def test_each_gyro_needs_eight_samples_over_ten_seconds(short: str) -> None:
    """Said with its name, and what there was."""

    def given(name: str) -> GyroTrack:
        whole = track(30.0, 100.0 if name == "the lidar" else 25.0, name)
        part = slice(0, round(9.5 * whole.rate_hz)) if name == short else slice(None)
        return GyroTrack(name, whole.time_ns[part], whole.rate_rad_s[part])

    match = rf"^gyro of {short}: \d+ samples in 9\.[45] s, expected at least 10 s$"
    with pytest.raises(SyncError, match=match):
        correlation.correlate(given("the lidar"), given("the autopilot"), None, None, 15.0)


def test_a_gyro_that_hardly_moved_is_named_with_what_it_did() -> None:
    whole = track(40.0, 100.0, "the lidar")
    still = GyroTrack("the autopilot", whole.time_ns[::4], 0.01 * whole.rate_rad_s[::4])
    match = r"^gyro of the autopilot: 0\.\d\d deg/s rms above 0\.2 Hz, expected at least 1\.0; there is no motion to correlate$"
    with pytest.raises(SyncError, match=match):
        correlation.correlate(whole, still, None, None, 15.0)


def test_a_gyro_too_slow_for_every_filter_is_refused() -> None:
    slow = track(60.0, 7.0, "the lidar")
    ins = GyroTrack("b", slow.time_ns, slow.rate_rad_s)
    with pytest.raises(SyncError, match=r"^gyro of the lidar: 7\.0 Hz, expected at least 8 Hz$"):
        synchronise(slow, ins)


# The fit -----------------------------------------------------------------------------------------------------------------


def test_whatever_bends_slowly_is_a_bias_and_is_taken_out_whole() -> None:
    time_s = np.sort(np.random.default_rng(5).uniform(0.0, 90.0, 900))
    unbias = _bias_projector(time_s)
    knots = np.linspace(time_s[0], time_s[-1], 4)  # every 30 s
    bent = np.stack([np.interp(time_s, knots, level) for level in ([1, -2, 3, 5], [9, 9, 9, 9], [0, 0, 1, 0])], axis=1)
    # a millionth of a ridge over some 300 samples a knot
    np.testing.assert_allclose(unbias(bent), 0.0, rtol=0, atol=1e-6)
    fast = np.sin(2 * np.pi * time_s)[:, None] * [1.0, 2.0, 3.0]
    np.testing.assert_allclose(unbias(fast + bent), unbias(fast), rtol=0, atol=1e-6)
    assert (unbias(fast) ** 2).mean() == pytest.approx((fast**2).mean(), rel=0.02)
    np.testing.assert_allclose(bent.T @ unbias(fast), 0.0, rtol=0, atol=1e-4)


def test_a_short_track_has_biases_at_its_two_ends() -> None:
    time_s = np.linspace(0.0, 12.0, 100)
    unbias = _bias_projector(time_s)
    np.testing.assert_allclose(unbias((3.0 - time_s)[:, None] * np.ones(3)), 0.0, rtol=0, atol=1e-5)
    assert np.abs(unbias(np.abs(time_s - 6.0)[:, None] * np.ones(3))).max() > 1.0


def test_samples_weigh_what_their_axis_and_their_slope_allow() -> None:
    """Noise of 1, 2 and 4 on the axes, and stamps off by 0.5 of a slope."""
    rng = np.random.default_rng(6)
    level = np.array([1.0, 2.0, 4.0])
    moved = rng.normal(0.0, 6.0, (20_000, 3))
    residual = rng.normal(size=moved.shape) * level + rng.normal(size=moved.shape) * 0.5 * moved
    weight, curvature = _weights(residual, moved)
    variance = level**2 + 0.25 * moved**2
    inlier = np.abs(residual) < 1.4 * np.sqrt(variance)
    # variances are learnt from 20 000 values an axis, and squares cut at 25: to some percent
    np.testing.assert_allclose(weight[inlier] * variance[inlier], 1.0, rtol=0, atol=0.1)
    np.testing.assert_allclose(curvature[inlier] * variance[inlier], 1.0, rtol=0, atol=0.1)
    outlier = np.abs(residual) > 1.6 * np.sqrt(variance)
    assert (curvature[outlier] == 0.0).all()
    expected = 1.5 * np.sqrt(variance[outlier]) / np.abs(residual[outlier])
    np.testing.assert_allclose(weight[outlier] * variance[outlier], expected, rtol=0, atol=0.1)


@pytest.mark.parametrize("correlated", [False, True])
def test_sigmas_hold_for_residuals_that_go_on_for_seconds(correlated: bool) -> None:
    """Scores of unit information: a mean over n of them; repeated over each block of 2 s, they tell a fiftieth of that."""
    rng = np.random.default_rng(7)
    time_s = np.arange(0.0, 400.0, 0.04)
    scores = rng.normal(size=(len(time_s), 5))
    if correlated:
        scores = np.repeat(scores[::50], 50, axis=0)
    normal = np.eye(5) * len(time_s)
    found = np.diag(_covariance(time_s, scores, normal)) * len(time_s)
    # 200 blocks: a variance known to a tenth, the largest of five to three tenths
    assert (found >= 1.0).all()
    assert found.mean() == pytest.approx(50.0 if correlated else 1.0, rel=0.3)


def test_of_fewer_than_ten_blocks_nothing_is_learnt_and_four_times_the_plain_variance_is_stated() -> None:
    scores = np.random.default_rng(8).normal(size=(450, 5))
    for blocks, factor in ((9, 4.0), (10, None)):
        time_s = np.linspace(0.0, 2.0 * blocks - 0.01, 450)
        found = _covariance(time_s, scores, np.eye(5) * 450.0)
        if factor is None:
            assert np.diag(found).min() * 450.0 >= 1.0
            assert not np.allclose(found, np.eye(5) * 4.0 / 450.0)
        else:
            np.testing.assert_allclose(found, np.eye(5) * factor / 450.0)


def test_too_few_samples_in_common_are_counted() -> None:
    lidar = track(60.0, 200.0, "the lidar")
    ins = GyroTrack("the autopilot", lidar.time_ns[::400], lidar.rate_rad_s[::400])  # 30 over a minute, less the ends
    peak = correlation.Peak(0, 1.0, 0.0, 100.0, np.eye(3), (np.zeros(1), np.zeros(1)))
    with pytest.raises(
        SyncError, match=r"^gyros of the lidar and the autopilot: 29 common samples, expected at least 30$"
    ):
        fit(lidar, ins, peak, 5.0, None)
    ins = GyroTrack("the autopilot", lidar.time_ns[::200], lidar.rate_rad_s[::200])
    assert fit(lidar, ins, peak, 5.0, None).samples == 59


def test_of_a_pair_without_noise_everything_is_found() -> None:
    """30 ppm, 3.3 ms beside where the correlation put it, 3 deg beside the mount, biases of degrees a second."""
    drift, offset_ns, mount = 30e-6, 5 * S, Rotation.from_euler("Z", 3.0, degrees=True).as_matrix()
    lidar = track(60.0, 200.0, "the lidar", start_ns=1_000 * S)
    seconds = (lidar.time_ns[::8] - lidar.time_ns[0]) * 1e-9
    stamps = lidar.time_ns[0] + offset_ns + np.rint(seconds * (1.0 + drift) * S).astype(np.int64)
    ins = GyroTrack("the autopilot", stamps, lidar.rate_rad_s[::8] + np.deg2rad([3.0, -5.0, 2.0]), stamp_step_ns=1000)
    peak = correlation.Peak(offset_ns - 3_300_000, 0.9, 0.2, 100.0, np.eye(3), (np.zeros(1), np.zeros(1)))
    found = fit(lidar, ins, peak, 20.0, mount)
    middle_s = (found.reference_ns - lidar.time_ns[0]) * 1e-9
    assert middle_s == pytest.approx(30.0, abs=0.1)
    # the filter of 20 Hz takes half a percent of rates below 3 Hz
    assert found.offset_ns == pytest.approx(offset_ns + middle_s * drift * S, abs=100_000)
    assert found.drift_ppm == pytest.approx(30.0, abs=3.0)
    assert 0.0 < found.sigma_drift_ppm < 5.0
    assert 1000 / np.sqrt(12.0) < found.sigma_offset_ns < 100_000
    assert found.mount_angle_deg == pytest.approx(3.0, abs=0.05)
    assert 0.0 < found.residual_rad_s < np.deg2rad(0.5)
    assert (found.peak, found.rival, found.method, found.note) == (0.9, 0.2, "gyro", "")
    # half a second is left out at either end of the lidar's track, whose last sample is the 12 000th
    told_s = seconds * (1.0 + drift) + 0.0033
    assert found.samples == np.count_nonzero((told_s > 0.5) & (told_s < 11_999 / 200.0 - 0.5))
