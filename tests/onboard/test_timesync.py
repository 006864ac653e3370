"""Log time through steps and slews of the wall clock; the clocks here are what a test makes them."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from onboard.timesync import Clocks, ClockWatch, KernelTime, LogTime, read_clocks

MS = 1_000_000
EPOCH = 1_700_000_000 * 1000 * MS


class Host:
    """A machine whose wall clock is set once, and runs `drift` too fast."""

    def __init__(self, step_at: int, step: int, drift: float = 0.0) -> None:
        self.step_at, self.step, self.drift = step_at, step, drift

    def wall(self, monotonic: int) -> int:
        return EPOCH + monotonic + round(monotonic * self.drift) + (self.step if monotonic >= self.step_at else 0)

    def clocks(self, monotonic: int) -> Clocks:
        return Clocks(self.wall(monotonic), monotonic)


def log_times(host: Host, arrivals: list[int], poll: int = 50 * MS) -> list[int]:
    """Poll as the daemon does; gives log time minus what it should be."""
    log = LogTime.start(host.clocks(0))
    kernel_time = KernelTime(log, host.clocks(0))
    errors: list[int] = []
    for now in range(poll, arrivals[-1] + 2 * poll, poll):
        batch = [t for t in arrivals if now - poll <= t < now]
        if batch:
            stamps = np.array([host.wall(t) for t in batch], np.int64)
            got = kernel_time.convert(stamps, host.clocks(now))
            errors += (got - np.array(batch) - log.anchor_ns).tolist()
    assert len(errors) == len(arrivals)
    return errors


def train(seed: int) -> list[int]:
    """Packets every 553 us with up to 0.4 ms of jitter."""
    jitter = np.random.default_rng(seed).integers(0, 400_000, 300)
    return sorted((np.arange(300) * 553_000 + jitter).tolist())


steps = st.one_of(st.integers(6 * MS, 10**9 * MS), st.integers(-(10**9) * MS, -6 * MS))


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 165 * MS), steps)
def test_a_step_of_the_wall_clock_moves_no_log_time(seed: int, step_at: int, step: int) -> None:
    assert set(log_times(Host(step_at, step), train(seed))) == {0}


@settings(max_examples=50, deadline=None)
@given(st.floats(-500e-6, 500e-6))
def test_slewing_moves_log_time_by_no_more_than_it_slews_in_one_poll(drift: float) -> None:
    # 500 ppm, the most that adjtime does, in 50 ms
    arrivals = [i * 553_000 for i in range(2000)]
    assert max(map(abs, log_times(Host(10**18, 0, drift), arrivals))) <= 500e-6 * 50 * MS + 2


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 2000 * MS), steps)
def test_a_step_in_silence_is_bounded_by_the_polls_around_it(step_at: int, step: int) -> None:
    arrivals = [*range(0, 100 * MS, 553_000), *range(2000 * MS, 2100 * MS, 553_000)]
    # nobody can tell where in the silence the step was; what counts is that no packet moves out of its two polls
    assert max(map(abs, log_times(Host(step_at, step), arrivals))) <= 2000 * MS


@pytest.mark.parametrize("step", [0, 3600 * 1000 * MS, -3600 * 1000 * MS])
def test_a_poll_in_several_calls_is_one_poll(step: int) -> None:
    host = Host(70 * MS, step)
    log = LogTime.start(host.clocks(0))
    kernel_time = KernelTime(log, host.clocks(0))
    arrivals = np.arange(1 * MS, 200 * MS, 553_000)  # all of it waited in the socket while we were stopped
    kernel_time.convert(np.array([], np.int64), host.clocks(0))
    for i, part in enumerate(parts := np.array_split(arrivals, 7)):
        stamps = np.array([host.wall(t) for t in part.tolist()], np.int64)
        got = kernel_time.convert(stamps, host.clocks(210 * MS + i), emptied=i == len(parts) - 1)
        assert (got - log.anchor_ns).tolist() == part.tolist()


def test_two_polls_and_a_stall_between_them_bound_every_stamp() -> None:
    log = LogTime(0)
    kernel_time = KernelTime(log, Clocks(0, 0))
    kernel_time.convert(np.array([], np.int64), Clocks(10 * MS, 10 * MS))
    got = kernel_time.convert(np.array([-(10**15), 15 * MS, 10**15], np.int64), Clocks(20 * MS, 20 * MS))
    assert got.tolist() == [0, 15 * MS, 20 * MS]


def test_the_clocks_are_read_at_one_instant() -> None:
    offsets = [read_clocks().offset_ns for _ in range(200)]
    assert abs(offsets[-1] - (time.time_ns() - time.monotonic_ns())) < 5 * MS
    assert np.percentile(np.abs(np.diff(offsets)), 50) < 100_000


def test_steps_are_recorded_and_counted_and_log_time_goes_on_evenly() -> None:
    host = Host(2500 * MS, -3600 * 1000 * MS)
    now = iter(range(0, 5000 * MS, 1000 * MS))
    watch = ClockWatch(LogTime.start(host.clocks(0)), lambda: host.clocks(next(now)), lambda: 7)
    records = [watch.record() for _ in range(5)]
    assert [record.step_ns for record in records] == [0, 0, 0, -3600 * 1000 * MS, 0]
    assert watch.steps == 1
    assert [record.log_ns - EPOCH for record in records] == [i * 1000 * MS for i in range(5)]
    assert [record.monotonic_ns for record in records] == [i * 1000 * MS for i in range(5)]
    assert records[3].realtime_ns - records[3].log_ns == -3600 * 1000 * MS
    assert records[0].boottime_ns == 7


@pytest.mark.parametrize("step", [0, 4 * MS, -4 * MS])
def test_a_small_change_is_slewing_and_no_step(step: int) -> None:
    host = Host(1500 * MS, step)
    now = iter(range(0, 3000 * MS, 1000 * MS))
    watch = ClockWatch(LogTime.start(host.clocks(0)), lambda: host.clocks(next(now)))
    for _ in range(3):
        watch.record()
    assert watch.steps == 0
