"""Positions that jump, in flights whose true path is known."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.estimation.felt import Felt
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


def wandering(
    seconds: float, seed: int, sigma_m: float = 2.0, rate_hz: float = 5.0
) -> tuple[Array, Array, Array, Array]:
    """The circle with errors that last a minute, and velocities 0.2 m/s off for a second."""
    time_s, true, velocity = flight(seconds, rate_hz, 0.0)
    rng = np.random.default_rng(seed)
    keep, brief = np.exp(-1.0 / rate_hz / 60.0), np.exp(-1.0 / rate_hz)
    error, speed = sigma_m * rng.standard_normal(3), np.zeros(3)
    errors, speeds = [], []
    for _ in time_s:
        error = keep * error + sigma_m * np.sqrt(1.0 - keep**2) * rng.standard_normal(3)
        speed = brief * speed + 0.2 * np.sqrt(1.0 - brief**2) * rng.standard_normal(3)
        errors.append(error)
        speeds.append(speed)
    return time_s, true + np.array(errors), velocity + np.array(speeds), np.full_like(true, sigma_m)


@pytest.mark.parametrize(("seconds", "rise_s"), [(24.0, 3.0), (60.0, 3.0), (60.0, 5.0)])
def test_what_walks_away_slowly_and_comes_back_is_left_out(seconds: float, rise_s: float) -> None:
    time_s, enu, velocity, sigma = wandering(seconds, 3)
    start_s, end_s = 4.0, 4.0 + 2.0 * rise_s + 1.0
    share = np.clip(np.minimum((time_s - start_s) / rise_s, (end_s - time_s) / rise_s), 0.0, 1.0)
    enu = enu + share[:, None] * np.array([20.0, 0.0, -8.0])
    found = judge(time_s, enu, velocity, sigma)
    assert not found.kept[share > 0.5].any()
    assert found.kept[(time_s < start_s) | (time_s > end_s + 1.0)].mean() > 0.97
    assert found.farthest_m == pytest.approx(np.hypot(20.0, 8.0), abs=6.0)


@pytest.mark.parametrize("seed", range(6))
def test_errors_that_last_a_minute_lose_nothing(seed: int) -> None:
    time_s, enu, velocity, sigma = wandering(180.0, seed)
    for stated in (sigma, 0.5 * sigma, 3.0 * sigma):
        assert judge(time_s, enu, velocity, stated).kept.mean() > 0.995


def test_a_walk_without_a_velocity_of_its_own_is_no_walk() -> None:
    time_s, enu, _, sigma = wandering(60.0, 5)
    assert judge(time_s, enu, np.zeros_like(enu), sigma).kept.all()


def test_a_velocity_that_goes_along_is_told_by_what_the_accelerometers_felt() -> None:
    time_s, enu, velocity, sigma = wandering(60.0, 3)
    start_s, end_s = 20.0, 28.0
    share = np.clip(np.minimum((time_s - start_s) / 3.0, (end_s - time_s) / 3.0), 0.0, 1.0)
    walk = share[:, None] * np.array([20.0, 0.0, -8.0])
    # forces with a heading 5 deg off, and a tilt that is half a degree off for the whole minute
    turn = np.deg2rad(5.0)
    true = flight(60.0, 5.0, 0.0)[2]
    sensed = true @ np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    sensed = sensed - sensed[0] + 0.086 * time_s[:, None] * np.array([1.0, -1.0, 0.0])
    forces = Felt(sensed, np.zeros(len(time_s)))
    along = velocity + np.gradient(walk, time_s, axis=0)
    assert judge(time_s, enu + walk, along, sigma).kept[share == 1.0].all()  # nothing else contradicts it
    found = judge(time_s, enu + walk, along, sigma, forces)
    assert not found.kept[share > 0.2].any()
    assert found.kept[(time_s < start_s - 1.0) | (time_s > end_s + 1.0)].all()
    assert judge(time_s, enu, velocity, sigma, forces).kept.all()
    silent = Felt(sensed, 1e6 * (time_s > 22.0) + 1e6 * (time_s > 26.0))
    assert judge(time_s, enu, velocity, sigma, silent).kept.all()
