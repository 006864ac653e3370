"""Inertial samples on the grid, and which positions of an autopilot count."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from flightlog.constants import NS_PER_S
from groundproc.estimation.observations.fixes import RECOVERY_NS, measured
from groundproc.estimation.odometry.grid import STEP_NS
from groundproc.estimation.odometry.motion import LONGEST_SAMPLE_GAP_NS, lever_force, on_grid

Array = npt.NDArray[np.float64]
STEP_S = STEP_NS * 1e-9


def swing(seconds: Array) -> Array:
    """Two turns a second about x, three about y, and a steady turn about z."""
    w = 2 * np.pi
    return np.stack([np.sin(2 * w * seconds), np.cos(3 * w * seconds), np.full(len(seconds), 0.7)], axis=1)


def swung(seconds: Array) -> Array:
    """Its integral from 0."""
    w = 2 * np.pi
    return np.stack([(1 - np.cos(2 * w * seconds)) / (2 * w), np.sin(3 * w * seconds) / (3 * w), 0.7 * seconds], axis=1)


@pytest.mark.parametrize(
    ("rate_hz", "share"),
    # straight lines take (w dt)^2 / 12 off a swing; cubics some (w dt)^4 / 100
    [
        (200.0, (6 * np.pi / 200) ** 2 / 12),
        (400.0, (6 * np.pi / 400) ** 2 / 12),
        (50.0, (6 * np.pi / 50) ** 4 / 100),
        (25.0, 0.02),
    ],
)
def test_means_over_steps_sum_to_the_integral(rate_hz: float, share: float) -> None:
    seconds = np.arange(-0.5, 4.5, 1 / rate_hz)
    values, known = on_grid(np.rint(seconds * 1e9).astype(np.int64), swing(seconds), 0, 800)
    assert known.all()
    edges = np.linspace(0.0, 800 * STEP_S, 801)
    off = np.cumsum(values, axis=0) * STEP_S - (swung(edges[1:]) - swung(edges[:1]))
    # of an integral that swings by 1 / w
    assert np.abs(off[:, 0]).max() < 2.0 * share / (2 * np.pi * 2) * 2 + 1e-6
    assert np.abs(off[:, 1]).max() < 2.0 * share / (2 * np.pi * 3) * 2 + 1e-6
    np.testing.assert_allclose(values[:, 2], 0.7, rtol=0, atol=1e-9)


def test_straight_lines_between_fast_samples_are_integrated_exactly() -> None:
    """Against numpy's trapezoids on a grid that has all the samples and all the edges."""
    rng = np.random.default_rng(1)
    time_ns = np.cumsum(rng.integers(1_000_000, 6_000_000, 500)) - 20_000_000
    samples = rng.normal(size=(500, 3))
    values, known = on_grid(time_ns, samples, 0, 200)
    assert known.all()
    edges = np.arange(201) * STEP_NS
    every = np.unique(np.concatenate([time_ns, edges]))
    for c in range(3):
        track = np.interp(every, time_ns, samples[:, c])
        area = np.concatenate([[0.0], np.cumsum(0.5 * (track[1:] + track[:-1]) * np.diff(every))])
        np.testing.assert_allclose(values[:, c], np.diff(np.interp(edges, every, area)) / STEP_NS, rtol=0, atol=1e-9)


def test_nothing_is_known_beyond_the_samples_or_in_a_silence() -> None:
    seconds = np.concatenate([np.arange(0.1, 1.0, 0.005), np.arange(1.3, 2.0, 0.005)])
    values, known = on_grid(np.rint(seconds * 1e9).astype(np.int64), np.ones((len(seconds), 3)), 0, 420)
    begins = np.arange(420) * STEP_S
    expected = ((begins >= 0.1) & (begins + STEP_S <= 0.995)) | ((begins >= 1.3) & (begins + STEP_S <= 1.995))
    # to a step at the ends of each stretch
    assert np.count_nonzero(known != expected) <= 4
    assert not known[begins < 0.09].any()
    assert not known[(begins > 1.0) & (begins < 1.29)].any()
    np.testing.assert_allclose(values[known], 1.0)
    assert LONGEST_SAMPLE_GAP_NS < 0.3e9


# Which positions count ---------------------------------------------------------------------------------------------------


def boot_with(fix_type: npt.NDArray[np.int64]) -> Any:
    """A boot of which only GPS_RAW_INT is looked at: five messages a second."""
    stamps = (np.arange(len(fix_type)) * NS_PER_S) // 5
    table = np.zeros(len(fix_type), [("fix_type", "u1")])
    table["fix_type"] = fix_type
    return SimpleNamespace(
        has=lambda name, least=1: name == "GPS_RAW_INT" and len(stamps) >= least,
        stamps_ns={"GPS_RAW_INT": stamps},
        tables={"GPS_RAW_INT": table},
    )


def test_positions_count_while_there_is_a_fix_and_after_it_has_settled_again() -> None:
    """60 s, without satellites from 10 to 20 s: the autopilot still states a position, of which nobody knows how wrong it is."""
    fix = np.full(300, 3)
    fix[50:100] = 1
    time_ns = np.arange(0, 60 * NS_PER_S, NS_PER_S // 4)
    good = measured(boot_with(fix), time_ns)
    seconds = time_ns / NS_PER_S
    assert good[seconds < 9.5].all()
    assert not good[(seconds >= 10.0) & (seconds <= 20.0 + RECOVERY_NS / NS_PER_S)].any()
    assert good[seconds > 20.5 + RECOVERY_NS / NS_PER_S].all()


def test_without_a_word_on_satellites_all_positions_count() -> None:
    time_ns = np.arange(0, 10 * NS_PER_S, NS_PER_S // 4)
    assert measured(boot_with(np.zeros(1, np.int64)), time_ns).all()
    # a receiver that never tells of a fix: its positions are what there is
    assert measured(boot_with(np.zeros(50, np.int64)), time_ns).all()
    assert measured(boot_with(np.full(50, 3)), time_ns).all()


def test_the_end_of_a_lever_is_felt_as_its_own_path_tells() -> None:
    """Against second differences of the lever's end, of a body that nods and turns about a fixed place."""
    step_s, lever = STEP_NS * 1e-9, np.array([0.1, -0.2, 0.3])
    seconds = np.arange(-2, 803) * step_s
    rotvec = np.stack(
        [0.05 * np.sin(9.0 * seconds), 0.1 * np.sin(4.0 * seconds), 0.3 * seconds + 0.2 * seconds**2], axis=1
    )
    attitude = Rotation.from_euler("ZYX", rotvec[:, ::-1])
    end = attitude.apply(lever)
    felt = attitude[2:-2].inv().apply(np.diff(end, 2, axis=0)[1:-1] / step_s**2)
    # the rate of a step is the turn over it; those before and after an instant average to the rate at it
    rate = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / step_s
    found = lever_force(rate, lever)
    found = 0.5 * (found[1:-2] + found[2:-1])
    # a second difference, and the mean of two steps, each leave out (w step)^2 / 6 of a swing at most
    np.testing.assert_allclose(found[1:-1], felt[1:-1], rtol=0, atol=2 * (9.0 * step_s) ** 2 / 6 * np.abs(felt).max())
