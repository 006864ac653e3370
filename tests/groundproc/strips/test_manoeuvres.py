"""Turns, take-off and landing of made-up flights whose manoeuvres are known to the second."""

import numpy as np
import pytest

from groundproc.geodesy import LocalFrame
from groundproc.strips.manoeuvres import ends_ns, turns_ns
from groundproc.trajectory.table import from_poses
from groundproc.trajectory.trajectory import Trajectory

STEP_S = 0.02
SMOOTHED_S = 2.5
"""Velocity is smoothed by a second, one sigma: an edge is known within this."""


def flight(*legs: tuple[float, float, float, float], pause_after: int = -1) -> Trajectory:
    """Legs of (seconds, east, north, up) at that velocity [m/s], one after the other; a pause of two minutes after one of them."""
    times, places, at, now = [], [], np.zeros(3), 0.0
    for number, (seconds, *velocity) in enumerate(legs):
        steps = np.arange(round(seconds / STEP_S)) * STEP_S
        times.append(now + steps)
        places.append(at + steps[:, None] * np.array(velocity))
        now, at = now + seconds, at + seconds * np.array(velocity)
        if number == pause_after:
            now += 120.0
    count = sum(map(len, times))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    time_ns = np.round(np.concatenate(times) * 1e9).astype(np.int64)
    return from_poses(
        LocalFrame(58.0, 15.0, 0.0), time_ns, np.concatenate(places), quat, np.zeros((count, 3)), np.zeros((count, 3))
    )


def seconds(spans_ns: np.ndarray) -> np.ndarray:
    return spans_ns * 1e-9


def test_a_sharp_corner_is_a_turn_of_a_few_seconds() -> None:
    found = seconds(turns_ns(flight((30, 5, 0, 0), (30, 0, 5, 0)), 45.0))
    assert found.shape == (1, 2)
    assert found[0, 0] < 30.0 < found[0, 1]
    assert found[0, 1] - found[0, 0] < 2 * SMOOTHED_S


def test_way_and_back_with_a_stop_is_one_turn_and_a_straight_line_none() -> None:
    found = seconds(turns_ns(flight((30, 5, 0, 0), (5, 0, 0, 0), (30, -5, 0, 0)), 45.0))
    assert found.shape == (1, 2)
    assert 30.0 - SMOOTHED_S < found[0, 0] < found[0, 1] < 35.0 + SMOOTHED_S
    assert not len(turns_ns(flight((60, 5, 0, 0)), 45.0))
    assert not len(turns_ns(flight((60, 0, 0, 0)), 45.0))


def test_a_circle_is_a_turn_as_long_as_it_lasts() -> None:
    angle = np.deg2rad(15.0) * np.arange(24)
    circle = [(1.0, 5 * np.cos(a), 5 * np.sin(a), 0.0) for a in angle]
    found = seconds(turns_ns(flight((20, 5, 0, 0), *circle, (20, 5, 0, 0)), 45.0))
    assert found.shape == (1, 2)
    np.testing.assert_allclose(found[0], [20.0, 44.0], rtol=0, atol=SMOOTHED_S + 0.05 * 24)


@pytest.mark.parametrize("drift", [0.0, 0.3])
def test_take_off_and_landing_end_and_begin_where_it_flies_on(drift: float) -> None:
    """Standing, climbing with a little drift, a line, a second line higher up, coming down."""
    legs = (
        (5, 0, 0, 0),
        (10, drift, 0, 3),
        (20, 5, 0, 0),
        (5, 0, 0, 2),
        (20, -5, 0, 0),
        (12, drift, 0, -3),
        (5, 0, 0, 0),
    )
    found = seconds(ends_ns(flight(*legs)))
    assert found.shape == (2, 2)
    np.testing.assert_allclose(found, [[0.0, 15.0], [60.0, 77.0]], rtol=0, atol=SMOOTHED_S)


def test_each_battery_has_its_own_and_who_never_flies_on_has_none() -> None:
    one = ((8, 0, 0, 3), (20, 5, 0, 0), (8, 0, 0, -3))
    found = seconds(ends_ns(flight(*one, *one, pause_after=2)))
    np.testing.assert_allclose(found, [[0, 8], [28, 36], [156, 164], [184, 192]], rtol=0, atol=SMOOTHED_S)
    assert not len(ends_ns(flight((60, 0.2, 0, 0))))
    assert not len(ends_ns(flight((60, 5, 0, 0)))), "a log that begins and ends in the air has neither"
