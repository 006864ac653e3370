"""Receive times against a device's clock, and what ties a clock to UTC."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import nmea
from flightlog.errors import ClockError
from flightlog.logfile import LogReader
from flightlog.mavlink import Frame
from flightlog.nmea import Rmc
from groundproc.flight import autopilot, load, timebase
from groundproc.flight.positionpackets import position_samples
from groundproc.flight.timebase import HostLine, host_line, lidar_utc

FramesOf = Callable[..., list[Frame]]
S, MS = 10**9, 10**6
HOST_NS = 1_779_272_223_800_000_000
UTC_NS = 1_779_272_223_000_000_000


def received(
    seconds: float, rate_hz: float, drift_ppm: float, latency_s: float, seed: int
) -> tuple[npt.NDArray[np.int64], ...]:
    """Device times and receive times of messages with exponential delays of that mean."""
    rng = np.random.default_rng(seed)
    device = (np.arange(0, seconds, 1 / rate_hz) * 1e9).astype(np.int64) + 83 * S
    late = (rng.exponential(latency_s, len(device)) * 1e9).astype(np.int64)
    return device, HOST_NS + np.rint((device - device[0]) * (1 + drift_ppm * 1e-6)).astype(np.int64) + late


@pytest.mark.parametrize("drift_ppm", [-80.0, 0.0, 60.0])
@pytest.mark.parametrize("latency_s", [0.006, 0.5])
def test_the_line_is_that_of_the_fastest_messages(drift_ppm: float, latency_s: float) -> None:
    """The least of n exponential delays is the mean over n; the hull is held by two of them at the two ends."""
    for seed in range(5):
        device, host = received(300, 25, drift_ppm, latency_s, seed)
        line = host_line(device, host)
        on_line = np.array([line.host_ns(int(t)) for t in device[::100]])
        true = HOST_NS + np.rint((device[::100] - device[0]) * (1 + drift_ppm * 1e-6)).astype(np.int64)
        # 7500 messages: a hundred times the least delay
        assert np.abs(on_line - true).max() < 100 * latency_s / len(device) * 1e9 + 2
        # nothing comes before it
        assert min(int(h) - line.host_ns(int(d)) for d, h in zip(device, host, strict=True)) > -5
        # exponential: the median delay is log 2 of the mean
        assert line.sigma_ns == pytest.approx(latency_s * np.log(2) * 1e9, rel=0.1)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), drift_ppm=st.floats(-100, 100), seconds=st.floats(1.0, 200.0))
def test_there_and_back_is_the_same_time(seed: int, drift_ppm: float, seconds: float) -> None:
    device, host = received(seconds, 5, drift_ppm, 0.02, seed)
    line = host_line(device, host)
    for time_ns in (int(device[0]), int(device[-1]), int(device[0]) + 3600 * S):
        assert abs(line.device_ns(line.host_ns(time_ns)) - time_ns) <= 2


def test_a_short_recording_tells_no_drift_and_a_set_clock_is_none() -> None:
    device, host = received(50, 25, 80.0, 0.01, 1)
    assert host_line(device, host).drift_ppm == 0.0
    device, host = received(120, 25, 0.0, 0.01, 1)
    host[len(host) // 2 :] += 10 * S  # NTP has set the host's clock
    line = host_line(device, host)
    assert line.drift_ppm == 0.0
    assert line.host_ns(int(device[0])) == pytest.approx(HOST_NS, abs=1 * MS)


@pytest.mark.parametrize(
    ("times", "seconds", "latency_s"), [(4.3, 40, 0.02), (0.23, 40, 0.02), (1.05, 30, 0.02), (4.3, 300, 0.5)]
)
def test_a_clock_of_another_rate_is_told(times: float, seconds: float, latency_s: float) -> None:
    """A simulator that runs faster than time, as one recorded log does: 4.3 s of the autopilot's clock in a second."""
    device, host = received(seconds, 25, 0.0, latency_s, 2)
    device = device[0] + np.rint((device - device[0]) * times).astype(np.int64)
    # 4 times the latency that a hundredth of the messages exceed, over the span
    assert host_line(device, host).rate == pytest.approx(times, rel=0.02 + 20 * latency_s / seconds)


@pytest.mark.parametrize(("seconds", "latency_s"), [(3, 2.0), (20, 2.0), (300, 2.0), (300, 0.006)])
def test_late_messages_and_crystals_are_no_other_rate(seconds: float, latency_s: float) -> None:
    for seed in range(10):
        for drift_ppm in (-200.0, 200.0):
            device, host = received(seconds, 25, drift_ppm, latency_s, seed)
            assert host_line(device, host).rate == 1.0


def test_sentences_of_another_era_and_single_wild_ones_tell_the_hour_all_the_same() -> None:
    past_ns = UTC_NS % (3600 * S)
    era_ns = 1024 * 7 * 86_400 * S
    fixes = [(past_ns + i * S + 300 * MS, fix(UTC_NS + i * S - (era_ns if i < 20 else 0))) for i in range(60)]
    fixes[30] = (fixes[30][0], fix(UTC_NS + 1234 * S))
    tie = lidar_utc(fixes)
    assert tie is not None
    assert tie.offset_ns == UTC_NS - past_ns


def test_messages_out_of_order_make_no_difference() -> None:
    device, host = received(100, 25, 30.0, 0.05, 3)
    order = np.random.default_rng(1).permutation(len(device))
    a, b = host_line(device, host), host_line(device[order], host[order])
    assert abs(a.host_ns(200 * S) - b.host_ns(200 * S)) < 10


def test_one_message_is_no_line() -> None:
    for count in (0, 1):
        with pytest.raises(ClockError, match="at least 2"):
            host_line(np.zeros(count, np.int64), np.zeros(count, np.int64))
    assert host_line(np.full(2, 5, np.int64), np.array([7, 9])).host_ns(5) == 7


# UTC ------------------------------------------------------------------------------------------------------------------


def fix(utc_ns: int, valid: bool = True) -> Rmc:
    found = nmea.parse_rmc(nmea.format_rmc(utc_ns, 58.394, 15.574, valid=valid))
    assert found is not None
    return found


def test_sentences_that_trail_a_steered_clock_tell_the_hour() -> None:
    past_ns = UTC_NS % (3600 * S)
    fixes = [(past_ns + i * S + 300 * MS, fix(UTC_NS + i * S)) for i in range(5)]
    tie = lidar_utc(fixes)
    assert tie is not None
    assert (tie.offset_ns, tie.source) == (UTC_NS - past_ns, "gprmc")
    # the same with stamps that were carried on to another day
    again = lidar_utc([(t + 50 * 3600 * S, f) for t, f in fixes])
    assert again is not None
    assert again.offset_ns == tie.offset_ns - 50 * 3600 * S


def test_the_hour_is_right_on_both_sides_of_it() -> None:
    """The stamp has gone on to 0.2 s past the hour, the sentence still says 59:59."""
    hour_ns = UTC_NS // (3600 * S) * 3600 * S
    tie = lidar_utc([(200 * MS, fix(hour_ns - S)), (1_200 * MS, fix(hour_ns))])
    assert tie is not None
    assert tie.offset_ns == hour_ns


def test_a_counter_that_runs_free_is_no_clock() -> None:
    assert lidar_utc([(1012 * S + i * S, fix(UTC_NS + i * S)) for i in range(5)]) is None
    past_ns = UTC_NS % (3600 * S)
    assert lidar_utc([]) is None
    assert lidar_utc([(past_ns + 300 * MS, fix(UTC_NS, valid=False))]) is None
    # off by 10 s, early by 1 s, or drifting away
    assert lidar_utc([(past_ns + 10 * S, fix(UTC_NS))]) is None
    assert lidar_utc([(past_ns - S, fix(UTC_NS))]) is None
    assert lidar_utc([(past_ns + 300 * MS, fix(UTC_NS)), (past_ns + 5 * S, fix(UTC_NS + 2 * S))]) is None


def test_the_recorded_sensor_knows_its_utc(monterey_log: Path) -> None:
    """GPRMC 220632 to 220633 of 2012-12-11, and the capture's own dates."""
    with LogReader(monterey_log) as reader:
        samples = position_samples([reader])
        batch = next(load.lidar_batches([reader]))
    fixes = [(s.device_time_ns, found) for s in samples.sentences if (found := nmea.parse_rmc(s.text))]
    tie = lidar_utc(fixes)
    assert tie is not None
    start = np.datetime64(int(batch.device_time_ns[0]) + tie.offset_ns, "ns")
    assert np.datetime64("2012-12-11T22:06:32") < start < np.datetime64("2012-12-11T22:06:34")


def boot_with(frames_of: FramesOf, pairs: list[tuple[int, int]]) -> Any:
    """A boot that sent these (Unix [us], boot [ms]) as SYSTEM_TIME."""
    heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    messages = [heartbeat, *(dialect.MAVLink_system_time_message(*pair) for pair in pairs)]
    return autopilot.boots(frames_of([(HOST_NS, m) for m in messages]))[0]


def test_system_time_is_exact_or_that_of_the_last_fix(frames_of: FramesOf) -> None:
    """Of stamps that are up to 200 ms old the freshest counts; a boot stamp is cut to milliseconds."""
    unix_us = UTC_NS // 1000
    exact = boot_with(frames_of, [(unix_us + i * 500_000, 83_412 + i * 500) for i in range(20)])
    tie = timebase.boot_utc(exact)
    assert tie is not None
    assert tie.source == "system_time"
    assert abs(tie.offset_ns - (UTC_NS - 83_412 * MS)) <= MS
    assert tie.sigma_ns >= MS / 2
    epochs = [(unix_us + (i * 500_000 - 120_000) // 200_000 * 200_000, 83_412 + i * 500) for i in range(20)]
    late = timebase.boot_utc(boot_with(frames_of, epochs))
    assert late is not None
    assert abs(late.offset_ns - (UTC_NS - 83_412 * MS)) <= 210 * MS
    assert late.sigma_ns > 10 * MS


def test_before_a_fix_there_is_no_utc(frames_of: FramesOf) -> None:
    unix_us = UTC_NS // 1000
    assert timebase.boot_utc(boot_with(frames_of, [(0, 1000), (0, 1500)])) is None
    assert timebase.boot_utc(boot_with(frames_of, [(5_000_000, 1000)])) is None
    cold = [(0, 1000), (0, 2000), *((unix_us + i * 1_000_000, 3000 + i * 1000) for i in range(5))]
    tie = timebase.boot_utc(boot_with(frames_of, cold))
    assert tie is not None
    assert abs(tie.offset_ns - (UTC_NS - 3000 * MS)) <= MS
    # the first second of a receiver may be wrong: the others outvote it
    wrong = [(unix_us + 15_000_000, 2000), *((unix_us + i * 1_000_000, 3000 + i * 1000) for i in range(5))]
    tie = timebase.boot_utc(boot_with(frames_of, wrong))
    assert tie is not None
    assert abs(tie.offset_ns - (UTC_NS - 3000 * MS)) <= MS


def test_the_hosts_own_clock_is_the_last_resort_and_says_so() -> None:
    tie = timebase.host_utc(HostLine(0, HOST_NS, 0.0, 5e6), 10 * S)
    assert (tie.offset_ns, tie.source) == (HOST_NS, "host")
    assert tie.sigma_ns >= S
