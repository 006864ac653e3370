"""Seconds of the week, eras of weeks, and times that are of no flight."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundproc.flight.positions.scales import (
    EPOCH_NS,
    ERA_NS,
    WEEK_NS,
    WEEK_S,
    calendar_of_week,
    in_era,
    stray,
    week_start_s,
)

S = 10**9
WEEK = 2303


def of_week(times_s: list[float]) -> np.ndarray:
    return np.array(times_s, np.float64)


@given(
    start_s=st.integers(0, WEEK_S - 1),
    steps=st.lists(st.integers(0, 600), min_size=1, max_size=30),
    runs_on=st.booleans(),
    order=st.randoms(use_true_random=False),
)
def test_seconds_of_the_week_come_out_the_same_however_they_are_written(
    start_s: int, steps: list[int], runs_on: bool, order: object
) -> None:
    """Starting again at the week's end or running on, in any order; by the week or by a time within half a week."""
    true_s = start_s + np.cumsum(steps)
    shuffled = np.array(order.sample(true_s.tolist(), len(true_s)))  # type: ignore[attr-defined]
    written = of_week((shuffled if runs_on else shuffled % WEEK_S).tolist())
    true_ns = EPOCH_NS + WEEK * WEEK_NS + shuffled * S
    near = EPOCH_NS + WEEK * WEEK_NS + (start_s + 40_000) * S
    assert (calendar_of_week(written, near_ns=near) == true_ns).all()
    # the week is that of the first of them
    first_week = int(true_s[0]) // WEEK_S if runs_on else 0
    expected = true_ns - (0 if runs_on else int(true_s[0]) // WEEK_S * WEEK_NS)
    assert (calendar_of_week(written, week=WEEK) == expected).all()
    assert week_start_s(written) == int(true_s[0]) - (0 if runs_on else int(true_s[0]) // WEEK_S * WEEK_S)
    assert first_week in (0, 1)


def test_a_point_without_time_moves_no_other() -> None:
    written = of_week([0.0, *np.linspace(302_400.0, 302_460.0, 200)])
    found = calendar_of_week(written, week=WEEK)
    assert found[1] == EPOCH_NS + WEEK * WEEK_NS + 302_400 * S
    assert np.flatnonzero(stray(found)).tolist() == [0]


def test_eras_are_recognised_each_time_for_itself() -> None:
    near = 1_779_272_223 * S
    times = near + np.array([0, 5, 3600], np.int64) * S
    mixed = times - np.array([0, 1, 2]) * ERA_NS
    found, wrong = in_era(mixed, near)
    assert found.tolist() == times.tolist()
    assert wrong == 2
    # without another witness the latest is right: a receiver falls behind
    assert in_era(mixed)[0].tolist() == times.tolist()
    # another day is another day
    other = times - 300 * 86_400 * S
    assert in_era(other, near) == (pytest.approx(other), 0)


def test_few_times_far_from_the_rest_are_strays_and_two_sessions_are_not() -> None:
    day = np.arange(1000) * S + 1_779_272_223 * S
    assert not stray(day).any()
    assert not stray(np.concatenate([day, day + 86_400 * S])).any()
    far = np.concatenate([day, [0, 5], day[:3] + 10 * 86_400 * S])
    assert np.flatnonzero(stray(far)).tolist() == [1000, 1001, 1002, 1003, 1004]
    assert not stray(np.empty(0, np.int64)).any()
    assert not stray(day[:2] * np.array([1, 0])).any()
