"""What the correlation makes of gyros before and after it correlates, and the fit's ends: each against a law of its own."""

import sys
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from flightlog.errors import SyncError
from groundproc.flight import sync
from groundproc.flight.sync import CUTOFFS_HZ, GyroTrack, Peak, Sync, best_shift, correlation, synchronise
from groundproc.flight.sync.fit import _covariance, _smooth_spline, fit
from groundproc.flight.sync.tracks import low_pass

Array = npt.NDArray[np.float64]
S = 10**9
NOTHING = (np.zeros(1), np.zeros(1))


def gain(hz: float, cutoff_hz: float) -> float:
    """Of a Gaussian low-pass with half power at its cut-off."""
    return float(np.exp(-0.5 * np.log(2.0) * (hz / cutoff_hz) ** 2))


def sines(time_s: Array, hz: float, amplitude: float = 1.0) -> Array:
    """The same on three axes, a third of a period apart."""
    return amplitude * np.sin(2.0 * np.pi * hz * time_s[:, None] + 2.0 * np.pi / 3.0 * np.arange(3))


def ticks(time_s: Array) -> npt.NDArray[np.int64]:
    return np.asarray(np.rint(time_s * S), np.int64)


def noise(seconds: float, hz: float, seed: int = 1) -> GyroTrack:
    """Rates of 10 deg/s below 3 Hz."""
    time_s = np.arange(0.0, seconds, 1.0 / hz)
    smooth = low_pass(np.random.default_rng(seed).normal(size=(len(time_s), 3)), 3.0, hz)
    return GyroTrack("the lidar", ticks(time_s), smooth * np.deg2rad(10.0) / smooth.std())


# The grid of the fast gyro ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hz", [0.1, 1.0, 4.0])
def test_rates_on_the_grid_are_those_between_the_two_filters(hz: float) -> None:
    """A constant, however large, is gone; what is left of a sine is what both Gaussians leave, without delay."""
    time_s = np.arange(0.0, 60.0, 0.005)
    track = GyroTrack("a", 77 * S + ticks(time_s), sines(time_s, hz) + np.array([400.0, -3.0, 0.0]))
    values, heard = correlation._on_grid(track)
    grid = np.arange(len(values)) / correlation.GRID_HZ
    assert len(values) == len(heard) == 6000
    assert (heard == 1.0).all()
    middle = slice(1500, 4500)
    expected = gain(hz, correlation.COARSE_HZ) * (1.0 - gain(hz, correlation.HIGH_PASS_HZ)) * sines(grid, hz)
    np.testing.assert_allclose(values[middle], expected[middle], rtol=0, atol=2e-3)


@pytest.mark.parametrize(("rate_hz", "limit_s"), [(100.0, 1.0), (4.0, 1.5)])
def test_a_silence_is_longer_than_a_second_and_than_six_samples(rate_hz: float, limit_s: float) -> None:
    """Nothing is heard in it and nothing correlates; a shorter one is bridged."""
    for longer in (False, True):
        silent_s = limit_s + 0.01 * longer
        late = 30.0 + silent_s
        time_s = np.concatenate([np.arange(0.0, 30.001, 1.0 / rate_hz), late + np.arange(0.0, 30.0, 1.0 / rate_hz)])
        values, heard = correlation._on_grid(GyroTrack("a", ticks(time_s), sines(time_s, 0.5)))
        place = np.arange(len(heard)) / correlation.GRID_HZ
        inside = (place > 30.005) & (place < late - 0.005)
        outside = (place < 29.995) | (place > late + 0.005)
        assert (heard[outside] == 1.0).all()
        assert (heard[inside] == (0.0 if longer else 1.0)).all()
        assert (np.abs(values[inside]).max() == 0.0) == longer


def test_a_silence_leaves_no_step_at_its_ends() -> None:
    """Filled with the median: offsets of tens of degrees a second do not ring into what was heard."""
    time_s = np.concatenate([np.arange(0.0, 20.0, 0.01), np.arange(25.0, 45.0, 0.01)])
    still = GyroTrack("a", ticks(time_s), np.full((len(time_s), 3), 7.0))
    np.testing.assert_allclose(correlation._on_grid(still)[0], 0.0, rtol=0, atol=1e-9)


# The samples of the slow one -------------------------------------------------------------------------------------------


def test_samples_lie_at_the_nearest_points_of_the_grid_and_nothing_between_them() -> None:
    time_s = np.arange(0.0, 60.0, 0.25) + 0.0
    time_s[1:] += np.random.default_rng(1).uniform(-0.004, 0.004, len(time_s) - 1)
    values, heard = correlation._samples_on_grid(
        GyroTrack("b", ticks(time_s), sines(time_s, 0.9) + np.array([9.0, 0.0, -1.0]))
    )
    assert np.flatnonzero(heard).tolist() == np.rint(time_s * 100.0).astype(int).tolist()
    assert (values[heard == 0.0] == 0.0).all()
    # 0.9 Hz passes the filter of 0.2 Hz whole; samples 0.25 s apart hold its slow part to some percent
    np.testing.assert_allclose(values[heard > 0.0][20:-20], sines(time_s, 0.9)[20:-20], rtol=0, atol=0.06)


def test_samples_of_one_place_are_averaged() -> None:
    time_s = np.sort(np.concatenate([np.arange(0.0, 30.0, 0.2), np.arange(0.0, 30.0, 0.2) + 0.002]))
    rates = sines(time_s, 1.1)
    values, heard = correlation._samples_on_grid(GyroTrack("b", ticks(time_s), rates))
    assert (heard <= 1.0).all()
    assert heard.sum() == len(time_s) / 2
    mean = 0.5 * (rates[0::2] + rates[1::2])
    np.testing.assert_allclose(values[heard > 0.0][20:-20], mean[20:-20], rtol=0, atol=0.05)


def test_what_turns_slowly_is_taken_out_of_the_samples() -> None:
    time_s = np.arange(0.0, 120.0, 0.1)
    values, heard = correlation._samples_on_grid(GyroTrack("b", ticks(time_s), sines(time_s, 0.02)))
    # of 0.02 Hz the high-pass leaves 1 - gain
    middle = np.flatnonzero(heard)[200:-200]
    assert np.abs(values[middle]).max() == pytest.approx(1.0 - gain(0.02, 0.2), abs=1e-3)


# Enough to correlate ---------------------------------------------------------------------------------------------------


def test_eight_samples_and_ten_seconds_are_enough_and_less_is_not() -> None:
    def seconds(count: int, last_s: float) -> Array:
        return correlation._seconds(GyroTrack("a", S + ticks(np.linspace(0.0, last_s, count)), np.zeros((count, 3))))

    np.testing.assert_allclose(seconds(8, 10.0), np.linspace(0.0, 10.0, 8))
    with pytest.raises(SyncError, match=r"^gyro of a: 7 samples in 10\.0 s, expected at least 10 s$"):
        seconds(7, 10.0)
    with pytest.raises(SyncError, match=r"^gyro of a: 0 samples in 0\.0 s, expected at least 10 s$"):
        seconds(0, 10.0)


def test_motion_is_that_of_the_liveliest_ten_seconds() -> None:
    """1 deg/s over all axes in one stretch of 10 s is enough, however long the rest stood still."""
    track, heard = noise(20.0, 100.0), np.ones(10_000)
    for rms_deg_s, enough in ((1.01, True), (0.99, False)):
        grid = np.zeros((10_000, 3))
        grid[3000:4000, 1] = np.deg2rad(rms_deg_s)
        if enough:
            correlation._check_motion(track, grid, heard)
        else:
            with pytest.raises(SyncError, match=r"0\.99 deg/s rms"):
                correlation._check_motion(track, grid, heard)


def test_a_stretch_that_was_hardly_heard_says_nothing_on_motion() -> None:
    """Its few samples may be large: the last fraction of a second before a battery is pulled."""
    grid, heard = np.full((1040, 3), 1e-4), np.ones(1040)
    grid[1000:] = 1.0
    with pytest.raises(SyncError, match="there is no motion to correlate"):
        correlation._check_motion(noise(20.0, 100.0), grid, heard)
    # half of the best heard is counted
    grid, heard = np.full((1500, 3), 1e-4), np.ones(1500)
    grid[1000:] = 1.0
    correlation._check_motion(noise(20.0, 100.0), grid, heard)


# Shifts ----------------------------------------------------------------------------------------------------------------


def test_short_tracks_may_be_shifted_by_a_tenth_of_what_they_have_in_common() -> None:
    whole = noise(10.4, 200.0)
    ins = GyroTrack("b", whole.time_ns[::10], whole.rate_rad_s[::10])
    peak = best_shift(whole, ins, None, None, 15.0)
    assert peak.offset_ns == 0
    # 208 samples in common at best, of which 188 are still 0.9: 20 steps of 50 ms either way
    assert (peak.curve[0].min(), peak.curve[0].max()) == pytest.approx((-1.04 * S, 1.04 * S), abs=0.06 * S)


def test_where_both_stood_still_nothing_fits_beyond_measure() -> None:
    """Silence beside silence correlates to anything: its norm is held up."""
    whole = noise(120.0, 100.0)
    still = whole.rate_rad_s.copy()
    still[6000:] *= 1e-7
    fast = replace(whole, rate_rad_s=still)
    ins = GyroTrack("b", whole.time_ns[::5], still[::5])
    peak = best_shift(fast, ins, None, None, 200.0)
    assert peak.offset_ns == 0
    assert peak.curve[1].max() == peak.height <= 1.001


def test_odds_of_a_gyro_slower_than_the_motion_count_its_samples() -> None:
    """Of 1.6 Hz each sample is one value: no more of them are independent."""
    whole = noise(200.0, 50.0)
    ins = GyroTrack("b", whole.time_ns[::32], whole.rate_rad_s[::32])
    peak = best_shift(whole, ins, None, None, 15.0)
    expected = 0.5 * len(ins.time_ns) * np.log((1.0 - peak.rival**2) / (1.0 - min(peak.height, 1.0) ** 2 + 1e-9))
    assert peak.offset_ns == 0
    assert peak.log_odds == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("height", "log_odds", "match"),
    [
        (0.499, 99.0, r"^two gyros: the best peak is 0\.50, expected at least 0\.5$"),
        (0.9, 9.9, r"^two gyros: the peak of 0\.90 has a rival of 0\.70 \(log odds 9\.9, expected at least 10\); the"),
        (0.5, 10.0, None),
    ],
)
def test_a_peak_is_doubted_below_its_limits_only(height: float, log_odds: float, match: str | None) -> None:
    peak = Peak(0, height, 0.7, log_odds, np.eye(3), NOTHING)
    if match is None:
        correlation._refuse_doubt(peak, "two gyros")
        return
    with pytest.raises(SyncError, match=match):
        correlation._refuse_doubt(peak, "two gyros")


def test_what_a_correlation_leaves_unexplained_is_never_nothing() -> None:
    assert correlation._log_unexplained(0.6) == pytest.approx(np.log(0.64), abs=1e-8)
    assert correlation._log_unexplained(1.0) == correlation._log_unexplained(1.2) == pytest.approx(np.log(1e-9))


def test_an_axis_is_told_by_the_motion_from_a_tenth_of_the_strongest_on() -> None:
    mount = np.eye(3)
    assert correlation._rotation(np.diag([1.0, 1.0, 0.09]), mount) is mount
    assert correlation._rotation(np.diag([1.0, 1.0, -0.11]), mount)[2, 2] == pytest.approx(-1.0)


# Drift that receive times tell ------------------------------------------------------------------------------------------


def test_a_slowed_track_has_the_times_of_a_clock_that_does_not_drift() -> None:
    """t = s + drift (s - about), for times of 60 bits, to the nanosecond."""
    slowed = np.array([-3600, 0, 1800, 3600], np.int64) * S + 1_700_000_000 * S
    about, drift = 1_700_000_000 * S, 70e-6
    track = GyroTrack("a", slowed + np.rint((slowed - about) * drift).astype(np.int64), np.zeros((4, 3)), 7)
    found = sync._slowed(track, drift, about)
    assert np.abs(found.time_ns - slowed).max() <= 1
    assert (found.name, found.stamp_step_ns) == ("a", 7)
    assert sync._slowed(track, 0.0, about) is track


def test_what_a_slowed_track_told_holds_for_the_track_as_it_was() -> None:
    """At any time: lidar to slowed by what was found, slowed to the track by the drift taken off."""
    found = Sync("gyro", 5 * S, 1.0, 1000 * S, drift_ppm=20.0)
    drift, about = -150e-6, 1200 * S
    whole = sync._quickened(found, drift, about)
    lidar = np.array([900, 1000, 2000], np.int64) * S
    slowed = found.ins_time_ns(lidar)
    np.testing.assert_allclose(whole.ins_time_ns(lidar), slowed + drift * (slowed - about), atol=2.0, rtol=0)
    assert whole.drift_ppm == pytest.approx(-130.0, abs=0.01)


@pytest.mark.parametrize("drift_ppm", [0.0, 400.0])
def test_a_drift_that_was_told_smears_no_correlation(drift_ppm: float) -> None:
    """In 20 min 400 ppm are half a second: without the word of the receive times the peak falls apart."""
    lidar = noise(1200.0, 50.0)
    since = lidar.time_ns[::5] - lidar.time_ns[len(lidar.time_ns) // 2]
    ins = GyroTrack(
        "b", 9 * S + lidar.time_ns[::5] + np.rint(since * drift_ppm * 1e-6).astype(np.int64), lidar.rate_rad_s[::5]
    )
    found = synchronise(lidar, ins, expected_drift_ppm=drift_ppm)
    assert found.peak > 0.95
    assert found.drift_ppm == pytest.approx(drift_ppm, abs=1.0)
    np.testing.assert_allclose(found.ins_time_ns(lidar.time_ns[::5]), ins.time_ns, atol=1e6, rtol=0)


# The fit ----------------------------------------------------------------------------------------------------------------


def test_of_all_filters_below_two_fifths_of_the_rate_the_best_is_kept() -> None:
    lidar = noise(60.0, 14.0)
    ins = GyroTrack("b", lidar.time_ns[::2], lidar.rate_rad_s[::2])
    peak = best_shift(lidar, ins, None, None, 15.0)
    left = [fit(lidar, ins, peak, cutoff, None).residual_rad_s for cutoff in CUTOFFS_HZ if cutoff < 5.6]
    assert len(left) == 2
    assert synchronise(lidar, ins).residual_rad_s == min(left)


@pytest.mark.parametrize("hz", [0.5, 2.0])
def test_the_smoothed_gyro_is_the_filters_to_both_ends_and_between_samples(hz: float) -> None:
    time_s = np.arange(0.0, 20.003, 0.01)
    smooth = _smooth_spline(GyroTrack("a", 5 * S + ticks(time_s), sines(time_s, hz)), 5.0)
    at = np.random.default_rng(3).uniform(2.0, 18.0, 200)
    np.testing.assert_allclose(smooth(at), gain(hz, 5.0) * sines(at, hz), rtol=0, atol=1.5e-3)
    first, last = smooth.ends_s
    assert first == 0.0
    assert time_s[-1] <= last < time_s[-1] + 2.0 / 400.0


def test_a_long_gyro_is_smoothed_in_parts_as_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Values and slopes on both sides of where the parts meet, and there."""
    lidar = noise(30.0, 200.0)
    at = np.random.default_rng(4).uniform(0.0, 30.0, 5000)
    whole = _smooth_spline(lidar, 20.0)
    monkeypatch.setattr(sys.modules[_smooth_spline.__module__], "PART", 1000)
    parts = _smooth_spline(lidar, 20.0)
    for derivative in (0, 1):
        scale = np.abs(whole(at, derivative)).max()
        np.testing.assert_allclose(parts(at, derivative), whole(at, derivative), rtol=0, atol=1e-11 * scale)


def pair(seconds: float = 60.0) -> tuple[GyroTrack, GyroTrack, Peak]:
    lidar = noise(seconds, 200.0)
    ins = GyroTrack("b", lidar.time_ns[::8], lidar.rate_rad_s[::8])
    return lidar, ins, Peak(0, 0.9, 0.2, 100.0, np.eye(3), NOTHING)


def test_a_gyro_with_one_axis_turned_over_is_fitted_and_said() -> None:
    lidar, ins, peak = pair()
    mirror = np.diag([1.0, 1.0, -1.0])
    found = fit(
        lidar, replace(ins, rate_rad_s=ins.rate_rad_s @ mirror), replace(peak, mat_ins_lidar=mirror), 20.0, None
    )
    assert found.note == "the gyros fit only with one axis of the opposite sign"
    assert found.mount_angle_deg is None
    np.testing.assert_allclose(found.mat_ins_lidar, mirror, rtol=0, atol=1e-3)
    assert found.curve is peak.curve


def test_steps_of_the_stamps_are_in_the_sigma() -> None:
    """Uniform over a step: its square over twelve is added."""
    lidar, ins, peak = pair()
    fine, coarse = (fit(lidar, replace(ins, stamp_step_ns=step), peak, 20.0, None) for step in (1, 10_000_000))
    added = coarse.sigma_offset_ns**2 - fine.sigma_offset_ns**2
    assert np.sqrt(added) == pytest.approx(10_000_000 / np.sqrt(12.0), rel=1e-6)


def test_an_axis_that_did_not_turn_stays_where_the_mount_put_it() -> None:
    """About the one axis that moved nothing is known but the prior: 0.05 rad about the two others' truth."""
    lidar, ins, peak = pair()
    only = np.array([0.0, 0.0, 1.0])
    tilted = Rotation.from_euler("z", 2.0, degrees=True).as_matrix()
    found = fit(
        replace(lidar, rate_rad_s=lidar.rate_rad_s * only),
        replace(ins, rate_rad_s=ins.rate_rad_s * only),
        replace(peak, mat_ins_lidar=tilted),
        20.0,
        tilted,
    )
    np.testing.assert_allclose(found.mat_ins_lidar, tilted, rtol=0, atol=1e-4)
    assert found.mount_angle_deg == pytest.approx(0.0, abs=0.01)


def test_outliers_pull_no_harder_than_their_neighbours() -> None:
    """Every fiftieth sample off by 100 deg/s: the offset stays within its sigma of a millisecond."""
    lidar, ins, peak = pair()
    wild = ins.rate_rad_s.copy()
    wild[::50] += np.deg2rad(100.0)
    found = fit(lidar, replace(ins, rate_rad_s=wild), replace(peak, offset_ns=4_000_000), 20.0, None)
    assert abs(found.offset_ns) < 1_000_000
    assert abs(found.offset_ns) < 4.0 * found.sigma_offset_ns


def test_correlations_of_the_unknowns_stay_what_they_were() -> None:
    """Only sigmas are widened: by the worst of what the blocks show and the plain inverse states."""
    rng = np.random.default_rng(9)
    time_s = np.concatenate(
        [np.arange(0.0, 100.0, 0.1), np.arange(300.0, 400.0, 0.1)]
    )  # blocks without a sample between
    mixing = rng.normal(size=(5, 5)) + 3.0 * np.eye(5)
    scores = np.repeat(rng.normal(size=(len(time_s) // 20, 5)), 20, axis=0) @ mixing
    normal = mixing.T @ mixing * len(time_s)
    found, plain = _covariance(time_s, scores, normal), np.linalg.inv(normal)
    sigma, before = np.sqrt(np.diag(found)), np.sqrt(np.diag(plain))
    np.testing.assert_allclose(found / np.outer(sigma, sigma), plain / np.outer(before, before), rtol=0, atol=1e-12)
    # blocks of 2 s hold 20 equal samples: variances are twenty times the plain ones, learnt from a hundred blocks
    assert ((sigma / before) ** 2).mean() == pytest.approx(20.0, rel=0.3)
