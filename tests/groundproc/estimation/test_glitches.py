"""Positions that jump, in flights whose true path is known."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.estimation.glitches import judge

Array = npt.NDArray[np.float64]


def flight(seconds: float = 60.0, rate_hz: float = 5.0, noise_m: float = 0.3) -> tuple[Array, Array, Array]:
    """A circle of 30 m radius at 6 m/s with a receiver's noise, and the velocity."""
    time_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    turn = time_s * 0.2
    place = np.stack([30.0 * np.cos(turn), 30.0 * np.sin(turn), 40.0 + np.sin(time_s)], axis=1)
    velocity = np.stack([-6.0 * np.sin(turn), 6.0 * np.cos(turn), np.cos(time_s)], axis=1)
    return time_s, place + noise_m * np.random.default_rng(4).standard_normal(place.shape), velocity


def off(time_s: Array, start_s: float, end_s: float) -> npt.NDArray[np.bool_]:
    return np.asarray((time_s >= start_s) & (time_s < end_s))


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize(("start_s", "end_s"), [(20, 20.2), (20, 23), (10, 30), (0, 3), (0, 0.2), (57, 60)])
def test_a_glitch_is_left_out_wherever_it_is(start_s: float, end_s: float, stated: bool) -> None:
    time_s, enu, velocity = flight()
    away = off(time_s, start_s, end_s)
    enu[away] += np.array([300.0, -260.0, 20.0])
    found = judge(time_s, enu, velocity if stated else None)
    assert (found.kept == ~away).all()
    assert found.farthest_m == pytest.approx(397.5, rel=0.05)
    assert not found.shifts


@pytest.mark.parametrize("at_s", [15.0, 30.0, 45.0])
def test_a_shift_that_lasts_is_kept_and_told(at_s: float) -> None:
    time_s, enu, velocity = flight()
    enu[time_s >= at_s] += np.array([400.0, 0.0, 0.0])
    found = judge(time_s, enu, velocity)
    assert found.kept.all()
    ((when_s, size_m),) = found.shifts
    assert when_s == pytest.approx(at_s)
    assert size_m == pytest.approx(400.0, rel=0.02)


def test_two_glitches_and_a_wild_one_leave_the_rest() -> None:
    time_s, enu, velocity = flight()
    first, second, wild = off(time_s, 5, 8), off(time_s, 40, 44), off(time_s, 50, 53)
    enu[first] += np.array([400.0, 0.0, 0.0])
    enu[second] += np.array([0.0, 150.0, 0.0])
    enu[wild] += np.random.default_rng(2).uniform(-500.0, 500.0, (int(wild.sum()), 3))
    found = judge(time_s, enu, velocity)
    assert found.kept[~(first | second | wild)].all()
    assert not found.kept[first | second].any()
    assert np.linalg.norm(enu[wild & found.kept] - flight()[1][wild & found.kept], axis=1).max(initial=0.0) < 100.0


@pytest.mark.parametrize("noise_m", [0.02, 0.3, 3.0])
@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 10.0])
def test_an_ordinary_flight_loses_nothing(rate_hz: float, noise_m: float) -> None:
    time_s, enu, velocity = flight(rate_hz=rate_hz, noise_m=noise_m)
    for stated in (velocity, None, np.zeros_like(velocity)):
        assert judge(time_s, enu, stated).kept.all()


def test_silences_of_a_radio_are_no_jumps() -> None:
    time_s, enu, velocity = flight(noise_m=0.1)
    heard = ~(off(time_s, 10, 14) | off(time_s, 30, 42))
    assert judge(time_s[heard], enu[heard], velocity[heard]).kept.all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_positions_are_taken_as_they_are(count: int) -> None:
    time_s, enu, velocity = flight()
    nothing: Any = judge(time_s[:count], enu[:count], velocity[:count])
    assert nothing.kept.all()
