from datetime import UTC, datetime
from random import Random

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from flightlog import clock

S = 10**9
HOUR = 3600 * S


def unix_ns(*fields: int) -> int:
    return int(datetime(*fields, tzinfo=UTC).timestamp()) * S  # type: ignore[misc,arg-type]


# GPS minus UTC from an instant on, as TAI minus UTC of IERS Bulletin C less 19 s
BULLETIN_C = [
    ((1980, 1, 6), 19), ((1981, 7, 1), 20), ((1982, 7, 1), 21), ((1983, 7, 1), 22), ((1985, 7, 1), 23), ((1988, 1, 1), 24),
    ((1990, 1, 1), 25), ((1991, 1, 1), 26), ((1992, 7, 1), 27), ((1993, 7, 1), 28), ((1994, 7, 1), 29), ((1996, 1, 1), 30),
    ((1997, 7, 1), 31), ((1999, 1, 1), 32), ((2006, 1, 1), 33), ((2009, 1, 1), 34), ((2012, 7, 1), 35), ((2015, 7, 1), 36),
    ((2017, 1, 1), 37),
]  # fmt: skip


@pytest.mark.parametrize(("day", "tai_minus_utc_s"), BULLETIN_C)
def test_leap_seconds_are_those_of_bulletin_c(day: tuple[int, int, int], tai_minus_utc_s: int) -> None:
    start = unix_ns(*day)
    assert clock.leap_seconds(start) == tai_minus_utc_s - 19
    if day != (1980, 1, 6):
        assert clock.leap_seconds(start - 1) == tai_minus_utc_s - 20


def test_every_leap_second_is_listed_once() -> None:
    assert len(clock.LEAP_UNIX_S) == len(BULLETIN_C) - 1
    assert list(clock.LEAP_UNIX_S) == sorted(set(clock.LEAP_UNIX_S))


# The roll-overs of week 1024 and 2048 came 13 s and 18 s before the UTC days 1999-08-22 and 2019-04-07. The last second of
# 2016 began 17 s after midnight of GPS, less the leap second itself.
@pytest.mark.parametrize(
    ("week", "tow_ms", "utc"),
    [
        (0, 0, (1980, 1, 6, 0, 0, 0)),
        (1024, 0, (1999, 8, 21, 23, 59, 47)),
        (2048, 0, (2019, 4, 6, 23, 59, 42)),
        (1718, 252_408_000, (2012, 12, 11, 22, 6, 32)),
        (1930, 18_000, (2017, 1, 1, 0, 0, 0)),
        (1930, 16_000, (2016, 12, 31, 23, 59, 59)),
    ],
)
def test_gps_weeks_begin_when_they_did(week: int, tow_ms: int, utc: tuple[int, ...]) -> None:
    assert clock.gps_week_to_utc_ns(week, tow_ms) == unix_ns(*utc)
    assert clock.utc_to_gps_ns(unix_ns(*utc)) == (week * 604_800 * 1000 + tow_ms) * 10**6


def test_gps_time_counts_the_leap_second_that_unix_time_leaves_out() -> None:
    last = clock.utc_to_gps_ns(unix_ns(2016, 12, 31, 23, 59, 59))
    first = clock.utc_to_gps_ns(unix_ns(2017, 1, 1))
    assert first - last == 2 * S
    # 23:59:60 has no Unix time of its own: it is written as the second after
    assert clock.gps_to_utc_ns(last + S) == unix_ns(2017, 1, 1)


@given(st.integers(unix_ns(1980, 1, 6), unix_ns(2100, 1, 1)))
def test_utc_to_gps_and_back_is_exact(utc_ns: int) -> None:
    assert clock.gps_to_utc_ns(clock.utc_to_gps_ns(utc_ns)) == utc_ns


@given(st.sampled_from(clock.LEAP_UNIX_S), st.integers(-20 * S, 20 * S))
def test_utc_to_gps_and_back_is_exact_around_leap_seconds(leap_s: int, offset_ns: int) -> None:
    utc_ns = leap_s * S + offset_ns
    assert clock.gps_to_utc_ns(clock.utc_to_gps_ns(utc_ns)) == utc_ns


def test_times_are_shown_in_utc_to_the_millisecond() -> None:
    assert clock.utc_text(unix_ns(2012, 12, 11, 22, 6, 32) + 123_456_789) == "2012-12-11T22:06:32.123Z"
    assert clock.utc_text(0) == "1970-01-01T00:00:00.000Z"


# Counters that wrap ---------------------------------------------------------------------------------------------------

true_counts = hnp.arrays(np.int64, st.integers(1, 50), elements=st.integers(-(2**31) + 1, 2**31 - 1)).map(
    lambda steps: np.cumsum(steps) + 2**33
)


@given(true_counts)
def test_a_counter_that_wraps_is_carried_on(true: npt.NDArray[np.int64]) -> None:
    wrapped = (true % 2**32).astype(np.uint32)
    carried = clock.unwrap_u32(wrapped)
    assert carried.dtype == np.int64
    assert carried[0] == wrapped[0]
    assert (np.diff(carried) == np.diff(true)).all()


@given(hnp.arrays(np.uint32, st.integers(0, 50)))
def test_carrying_on_never_changes_what_the_counter_showed(stamps: npt.NDArray[np.uint32]) -> None:
    carried = clock.unwrap_u32(stamps)
    assert (carried % 2**32 == stamps).all()
    assert (np.abs(np.diff(carried)) <= 2**31).all()


def test_raw_imu_of_old_boards_is_carried_past_71_minutes() -> None:
    true_us = np.arange(0, 3 * 4_294_967_296, 10_000_000, dtype=np.int64)
    assert (clock.unwrap_u32(true_us % 2**32) == true_us).all()


# Top of hour ----------------------------------------------------------------------------------------------------------


def stamps_of(lidar_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.uint32]:
    return (lidar_ns // 1000 % 3_600_000_000).astype(np.uint32)


def test_the_hour_wraps_without_a_step() -> None:
    lidar = 3599 * S + np.arange(4000, dtype=np.int64) * 553_000
    ours = clock.unwrap_top_of_hour_ns(stamps_of(lidar), 1_700_000_000 * S + lidar)
    assert (ours == lidar).all()


@pytest.mark.parametrize("silence_s", [0.5, 1799, 1801, 3599, 3600, 3601, 7200, 5 * 3600 + 1234, 26 * 3600])
def test_a_silence_of_any_length_is_told_by_the_host_clock(silence_s: float) -> None:
    lidar = 1000 * S + np.array([0, 553_000, int(silence_s * S), int(silence_s * S) + 553_000], np.int64)
    ours = clock.unwrap_top_of_hour_ns(stamps_of(lidar), 1_700_000_000 * S + lidar)
    assert (ours == lidar // 1000 * 1000).all()


def test_a_stamp_that_runs_on_past_the_hour_before_it_resets_stays_continuous() -> None:
    lidar = 3599 * S + np.arange(6000, dtype=np.int64) * 553_000
    stamps = np.where(lidar < 3601 * S, lidar // 1000, lidar // 1000 - 3_600_000_000).astype(np.uint32)
    assert stamps.max() > 3_600_000_000
    assert (clock.unwrap_top_of_hour_ns(stamps, 1_700_000_000 * S + lidar) == lidar).all()


def test_packets_out_of_order_keep_their_own_time_even_across_the_hour() -> None:
    lidar = 3599 * S + 900_000_000 + np.arange(400, dtype=np.int64) * 553_000
    host = 1_700_000_000 * S + lidar
    order = np.arange(400)
    crossing = int(np.searchsorted(lidar, HOUR))
    order[crossing - 3 : crossing + 3] = order[crossing - 3 : crossing + 3][::-1]
    ours = clock.unwrap_top_of_hour_ns(stamps_of(lidar[order]), host)
    assert (ours == lidar[order]).all()


@given(
    st.integers(0, 3599) | st.sampled_from([0, 3599]),
    st.lists(st.integers(-(10**6), 4 * 3600 * 10**6), min_size=1, max_size=40),
    st.integers(-400, 400),
    st.randoms(use_true_random=False),
)
def test_lidar_time_is_recovered_whatever_the_gaps_drift_and_lateness(
    first_s: int, steps_us: list[int], drift_ppm: int, random: Random
) -> None:
    lidar = first_s * S + np.cumsum([0, *steps_us]).astype(np.int64) * 1000
    assume(lidar.min() >= 0)
    late = np.array([random.randint(0, 2 * S) for _ in lidar], np.int64)
    host = 1_700_000_000 * S + lidar + lidar // 10**6 * drift_ppm + late
    ours = clock.unwrap_top_of_hour_ns(stamps_of(lidar), host)
    assert (ours - ours[0] == lidar - lidar[0]).all()


@given(st.integers(1, 60), st.integers(0, 3_600))
def test_batch_after_batch_gives_the_same_as_all_at_once(cut: int, first_s: int) -> None:
    lidar = first_s * S + np.cumsum(np.arange(80, dtype=np.int64) ** 3) * 1_000_000
    stamps, host = stamps_of(lidar), 1_700_000_000 * S + lidar
    whole = clock.unwrap_top_of_hour_ns(stamps, host)
    head = clock.unwrap_top_of_hour_ns(stamps[:cut], host[:cut])
    tail = clock.unwrap_top_of_hour_ns(stamps[cut:], host[cut - 1 :], last_ns=int(head[-1]))
    assert (np.concatenate([head, tail]) == whole).all()


def test_no_stamps_give_no_times() -> None:
    nothing = np.empty(0, np.uint32)
    assert clock.unwrap_top_of_hour_ns(nothing, np.empty(0, np.int64)).shape == (0,)
    assert clock.unwrap_u32(nothing).shape == (0,)


@given(st.integers(0, HOUR - 1), st.integers(0, 500_000), st.integers(-HOUR // 2 + S, HOUR // 2 - S))
def test_the_hour_of_a_stamp_is_the_one_nearest_to_the_host_clock(stamp_ns: int, hours: int, error_ns: int) -> None:
    true_utc_ns = hours * HOUR + stamp_ns
    assert stamp_ns + clock.nearest_hour_ns(stamp_ns, true_utc_ns + error_ns) == true_utc_ns
