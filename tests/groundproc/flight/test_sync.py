"""The offset between two clocks from their gyros: motions made here with known offset, drift and rotation, and a recording."""

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from flightlog.errors import SyncError
from flightlog.mavlink import Frame
from groundproc.flight import autopilot, timebase
from groundproc.flight.sync import GyroTrack, Sync, synchronise

Array = npt.NDArray[np.float64]
Motion = Callable[[Array], Array]

TILT = Rotation.from_euler("X", -20.0, degrees=True).as_matrix()
"""ins from lidar: tilted 20 deg forward."""
OFFSET_NS = -928_838_123_456
LIDAR_NS = 1_012_250_000_000


def rocking(seed: int, rms_deg_s: float = 12.0, band_hz: tuple[float, float] = (0.15, 3.0)) -> Motion:
    """Body rates of a copter [rad/s] at times [s], shape (n, 3): 30 sines an axis."""
    rng = np.random.default_rng(seed)
    frequency = np.exp(rng.uniform(*np.log(band_hz), (30, 3)))
    phase = rng.uniform(0, 2 * np.pi, (30, 3))
    strength = rng.uniform(0.5, 1.0, (30, 3))
    strength *= np.deg2rad(rms_deg_s) * np.sqrt(2.0 / (strength**2).sum(axis=0))

    def rates(seconds: Array) -> Array:
        return np.asarray((strength * np.sin(2 * np.pi * frequency * seconds[:, None, None] + phase)).sum(axis=1))

    return rates


def lidar_gyro(motion: Motion, seconds: float, seed: int, *, mat: Array = TILT, drift: float = 0.0) -> GyroTrack:
    """As the HDL-32E has it: 200 Hz with irregular steps, 1.1 deg/s of noise, steps of 0.0977 deg/s, offsets of tens of deg/s.

    `drift` is how much faster than the autopilot's this clock goes.
    """
    rng = np.random.default_rng(seed + 1000)
    time_s = np.cumsum(rng.uniform(0.0013, 0.0087, round(seconds * 200)))
    rate = motion(time_s) @ mat + np.deg2rad([-23.1, -7.1, -12.3]) + np.deg2rad(1.1) * rng.normal(size=(len(time_s), 3))
    step = np.deg2rad(0.09766)
    stamps = LIDAR_NS + np.rint(time_s * (1 + drift) * 1e6).astype(np.int64) * 1000
    return GyroTrack("the lidar", stamps, np.rint(rate / step) * step)


def ins_gyro(motion: Motion, seconds: float, seed: int, hz: float, jitter_s: float) -> GyroTrack:
    """As MAVLink brings it: few and with uneven stamps; cut to milliseconds, so half of one is added, as the reader of messages does."""
    rng = np.random.default_rng(seed + 2000)
    time_s = np.arange(0.01, seconds - 0.1, 1.0 / hz)
    time_s += rng.uniform(0.0, 0.001, len(time_s))  # no loop is in step with its clock's milliseconds
    state = time_s + rng.uniform(-jitter_s, jitter_s, len(time_s))
    rate = motion(state) + np.deg2rad([0.4, -0.2, 0.3]) + np.deg2rad(0.15) * rng.normal(size=(len(time_s), 3))
    stamps = (np.rint(time_s * 1e9).astype(np.int64) + LIDAR_NS + OFFSET_NS) // 1_000_000 * 1_000_000 + 500_000
    return GyroTrack("ATTITUDE", stamps, rate)


def error_ns(found: Sync, drift: float = 0.0) -> float:
    """Of the offset, at the time it is stated for: drift makes the true offset another there."""
    since_ns = (found.reference_ns - LIDAR_NS) / (1 + drift)
    true_offset_ns = LIDAR_NS + OFFSET_NS + since_ns - found.reference_ns
    return found.offset_ns - true_offset_ns


@pytest.mark.parametrize(("hz", "jitter_s", "limit_ms"), [(25.0, 0.010, 1.5), (8.0, 0.005, 2.0), (4.0, 0.005, 4.0)])
def test_the_offset_is_found_and_its_sigma_covers_the_error(hz: float, jitter_s: float, limit_ms: float) -> None:
    """Eight flights of 60 s. The sum of eight squared errors over sigma is chi-squared: under 26 in 99.9 %."""
    errors, sigmas = [], []
    for seed in range(8):
        motion = rocking(seed)
        found = synchronise(lidar_gyro(motion, 60, seed), ins_gyro(motion, 60, seed, hz, jitter_s), mat_ins_lidar=TILT)
        errors.append(error_ns(found))
        sigmas.append(found.sigma_offset_ns)
        assert found.method == "gyro"
        assert found.peak > 0.7
    assert np.sqrt(np.mean(np.square(errors))) < limit_ms * 1e6
    assert np.sum(np.square(np.array(errors) / sigmas)) < 26.0
    # and it is no excuse: not ten times the error
    assert np.median(sigmas) < 10 * np.sqrt(np.mean(np.square(errors)))


def test_a_drift_between_the_clocks_is_found_with_time() -> None:
    """70 ppm over 4 min is 17 ms; with rates that tell 1 ms in a minute a drift is known to some 10 ppm."""
    for seed in range(3):
        motion = rocking(seed)
        lidar = lidar_gyro(motion, 240, seed, drift=70e-6)
        found = synchronise(lidar, ins_gyro(motion, 240, seed, 25.0, 0.005), mat_ins_lidar=TILT)
        # t_ins = t_lidar + offset + drift: the lidar's clock is fast, so the drift is minus 70 ppm
        assert abs(found.drift_ppm + 70.0) < 4 * found.sigma_drift_ppm
        assert found.sigma_drift_ppm < 20.0
        assert abs(error_ns(found, 70e-6)) < 4 * found.sigma_offset_ns
        ends = lidar.time_ns[[0, -1]]
        true_ns = LIDAR_NS + OFFSET_NS + np.rint((ends - LIDAR_NS) / (1 + 70e-6)).astype(np.int64)
        assert np.abs(found.ins_time_ns(ends) - true_ns).max() < 5_000_000


@pytest.mark.parametrize("seed", range(3))
def test_a_mount_that_nobody_stated_is_solved(seed: int) -> None:
    turned = Rotation.random(rng=seed).as_matrix()
    motion = rocking(seed)
    found = synchronise(lidar_gyro(motion, 60, seed, mat=turned), ins_gyro(motion, 60, seed, 25.0, 0.005))
    assert found.mat_ins_lidar is not None
    assert np.rad2deg(Rotation.from_matrix(turned.T @ found.mat_ins_lidar).magnitude()) < 2.0
    assert abs(error_ns(found)) < 4 * found.sigma_offset_ns
    assert found.mount_angle_deg is None
    assert found.note == ""


def test_a_gyro_of_the_opposite_sign_is_solved_and_said() -> None:
    """The sign of gyro 3 is disputed between drivers: with a mirrored axis the best rotation is a reflection."""
    motion = rocking(5)
    mirrored = TILT @ np.diag([1.0, 1.0, -1.0])
    found = synchronise(
        lidar_gyro(motion, 60, 5, mat=mirrored), ins_gyro(motion, 60, 5, 25.0, 0.005), mat_ins_lidar=TILT
    )
    assert found.mat_ins_lidar is not None
    assert np.linalg.det(found.mat_ins_lidar) < 0
    np.testing.assert_allclose(found.mat_ins_lidar, mirrored, rtol=0, atol=0.04)
    assert abs(error_ns(found)) < 4 * found.sigma_offset_ns
    assert "opposite sign" in found.note


def test_turns_about_one_axis_alone_use_the_mount_for_the_rest() -> None:
    def yawing(seconds: Array) -> Array:
        return np.stack([0 * seconds, 0 * seconds, rocking(3)(seconds)[:, 2]], axis=1)

    found = synchronise(lidar_gyro(yawing, 60, 3), ins_gyro(yawing, 60, 3, 25.0, 0.005), mat_ins_lidar=TILT)
    assert found.mount_angle_deg is not None
    assert found.mount_angle_deg < 5.0
    assert abs(error_ns(found)) < 4 * found.sigma_offset_ns


@pytest.mark.parametrize("bias_deg_s", [0.0, 150.0])
def test_offsets_of_a_gyro_do_no_harm_however_large(bias_deg_s: float) -> None:
    motion = rocking(1)
    lidar = lidar_gyro(motion, 60, 1)
    biased = GyroTrack(lidar.name, lidar.time_ns, lidar.rate_rad_s + np.deg2rad(bias_deg_s))
    ins = ins_gyro(motion, 60, 1, 25.0, 0.005)
    found, plain = (synchronise(track, ins, mat_ins_lidar=TILT) for track in (biased, lidar))
    assert abs(found.offset_ns - plain.offset_ns) < 1000


def test_what_is_known_of_the_offset_narrows_the_search_and_is_not_the_answer() -> None:
    motion = rocking(2)
    lidar, ins = lidar_gyro(motion, 60, 2), ins_gyro(motion, 60, 2, 25.0, 0.005)
    for wrong_s in (-2.0, 0.0, 2.0):
        found = synchronise(lidar, ins, mat_ins_lidar=TILT, expected_ns=OFFSET_NS + round(wrong_s * 1e9), search_s=5.0)
        assert abs(error_ns(found)) < 4 * found.sigma_offset_ns
    with pytest.raises(SyncError):
        synchronise(lidar, ins, mat_ins_lidar=TILT, expected_ns=OFFSET_NS + 20 * 10**9, search_s=5.0)


def test_recordings_of_different_length_meet_where_they_overlap() -> None:
    motion = rocking(6)
    lidar, ins = lidar_gyro(motion, 120, 6), ins_gyro(motion, 120, 6, 25.0, 0.005)
    part = slice(500, 1400)  # 36 s from the twentieth on
    found = synchronise(lidar, GyroTrack(ins.name, ins.time_ns[part], ins.rate_rad_s[part]), mat_ins_lidar=TILT)
    assert abs(error_ns(found)) < 4 * found.sigma_offset_ns


def test_a_silence_in_the_messages_does_no_harm() -> None:
    motion = rocking(7)
    lidar, ins = lidar_gyro(motion, 90, 7), ins_gyro(motion, 90, 7, 25.0, 0.005)
    heard = np.ones(len(ins.time_ns), bool)
    heard[800:1300] = False
    found = synchronise(lidar, GyroTrack(ins.name, ins.time_ns[heard], ins.rate_rad_s[heard]), mat_ins_lidar=TILT)
    assert abs(error_ns(found)) < 4 * found.sigma_offset_ns


def test_times_stay_whole_nanoseconds_however_large() -> None:
    """UTC of today is 60 bits of nanoseconds; a float has 53."""
    start_ns = 1_779_272_223_000_000_001
    found = Sync("gyro", offset_ns=-3, sigma_offset_ns=1.0, reference_ns=start_ns, drift_ppm=1.0)
    times_ns = start_ns + np.array([0, 1, 10**6, 10**9], np.int64)
    assert (found.ins_time_ns(times_ns) - start_ns).tolist() == [-3, -2, 10**6 - 3 + 1, 10**9 - 3 + 1000]


# Refusals -------------------------------------------------------------------------------------------------------------


def test_without_motion_there_is_nothing_to_find() -> None:
    for still in (rocking(1, rms_deg_s=0.0), rocking(1, rms_deg_s=0.2)):
        with pytest.raises(SyncError, match=r"motion|peak|chance"):
            synchronise(lidar_gyro(still, 60, 1), ins_gyro(still, 60, 1, 25.0, 0.005), mat_ins_lidar=TILT)


def test_two_flights_that_have_nothing_to_do_with_each_other_are_refused() -> None:
    for seed in range(4):
        with pytest.raises(SyncError):
            synchronise(
                lidar_gyro(rocking(seed), 40, seed),
                ins_gyro(rocking(seed + 50), 40, seed, 25.0, 0.005),
                mat_ins_lidar=TILT,
            )


def test_motion_that_repeats_itself_is_refused() -> None:
    """A pendulum of 2 s: every other shift by 2 s fits as well."""

    def swinging(seconds: Array) -> Array:
        return np.deg2rad(20.0) * np.stack(
            [np.sin(np.pi * seconds), np.cos(np.pi * seconds), np.sin(2 * np.pi * seconds)], axis=1
        )

    for seed in range(3):
        ins = ins_gyro(swinging, 60, seed, 25.0, 0.005)
        # the middle 30 s of the autopilot's minute: no end of the motion tells which swing is which
        part = GyroTrack(ins.name, ins.time_ns[400:1150], ins.rate_rad_s[400:1150])
        with pytest.raises(SyncError, match="repeats"):
            synchronise(lidar_gyro(swinging, 60, seed), part, mat_ins_lidar=TILT)


def test_too_little_of_either_is_refused() -> None:
    motion = rocking(1)
    lidar, ins = lidar_gyro(motion, 60, 1), ins_gyro(motion, 60, 1, 25.0, 0.005)
    for short in (slice(0, 0), slice(0, 1), slice(0, 100)):
        for a, b in ((lidar, GyroTrack(ins.name, ins.time_ns[short], ins.rate_rad_s[short])),
                     (GyroTrack(lidar.name, lidar.time_ns[short], lidar.rate_rad_s[short]), ins)):  # fmt: skip
            with pytest.raises(SyncError):
                synchronise(a, b, mat_ins_lidar=TILT)


# A recording ----------------------------------------------------------------------------------------------------------


def test_on_the_313_recording_the_truth_is_met_within_its_lag(
    recordings: Path, tlog_frames: Callable[[str], list[Frame]]
) -> None:
    """True body rates stand in for the lidar's gyro; the card of the recording says 4 ms of lag.

    The receive times that the lag is measured from are of two paths over one host, each with a millisecond or two of its own.
    """
    with gzip.open(recordings / "mavlink/arducopter313_sim_truth.csv.gz", "rt") as file:
        table = np.genfromtxt(file, delimiter=",")
    table = table[np.append(True, np.diff(table[:, 0]) > 0)]
    roll, pitch = np.deg2rad(table[:, 2:4].T)
    # the file has the rates of the Euler angles: to the body, forward-right-down, then right-forward-up
    roll_rate, pitch_rate, yaw_rate = np.deg2rad(table[:, 5:8].T)
    forward = roll_rate - yaw_rate * np.sin(pitch)
    right = pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch)
    down = -pitch_rate * np.sin(roll) + yaw_rate * np.cos(roll) * np.cos(pitch)
    host_ns = np.rint((table[:, 0] - table[0, 0]) * 1e9).astype(np.int64) + round(table[0, 0] * 1e6) * 1000
    truth = GyroTrack("the truth", host_ns, np.stack([right, forward, -down], axis=1))
    (boot,) = autopilot.boots(tlog_frames("arducopter313_sim"))
    line = timebase.host_line(*boot.host_pairs())
    for track in boot.gyros():
        found = synchronise(truth, track, mat_ins_lidar=np.eye(3))
        lag_s = (
            found.offset_ns
            + line.host_ns(found.reference_ns + found.offset_ns)
            - (found.reference_ns + found.offset_ns)
        ) * 1e-9
        assert abs(lag_s - 0.004) < 0.004, track.name
        assert found.mount_angle_deg is not None
        assert found.mount_angle_deg < 1.0
        assert found.peak > 0.95


def test_a_drift_that_receive_times_tell_is_taken_out_before_it_smears_the_correlation() -> None:
    """1000 ppm over 10 min, 0.6 s between the ends, as 170 ppm over an hour. The stated sigma is at most 0.1 ms."""
    motion, drift = rocking(3), 1000e-6
    lidar, ins = lidar_gyro(motion, 600, 3, drift=drift), ins_gyro(motion, 600, 3, 25.0, 0.005)
    with pytest.raises(SyncError, match="the best peak is"):
        synchronise(lidar, ins, mat_ins_lidar=TILT)
    # receive times are right to 10 ppm; the autopilot's clock is the slower one
    found = synchronise(lidar, ins, mat_ins_lidar=TILT, expected_drift_ppm=(1 / (1 + drift) - 1) * 1e6 + 10.0)
    assert found.peak > 0.9
    assert found.sigma_offset_ns < 100_000
    assert abs(error_ns(found, drift)) < 4.0 * found.sigma_offset_ns
    assert abs(found.drift_ppm - (1 / (1 + drift) - 1) * 1e6) < 4.0 * found.sigma_drift_ppm
