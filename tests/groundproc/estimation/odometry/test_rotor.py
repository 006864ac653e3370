"""The line of the spin in time: readings of a gyro made up of motion, noise and a sine of the rotor's azimuth."""

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.motion import LIDAR, Motion
from groundproc.estimation.odometry.rotor import Line, rotor
from groundproc.estimation.odometry.slices import Slice

Array = npt.NDArray[np.float64]
START_NS = 1_779_000_000_000_000_000
SLICES = 150
LINE_RAD_S = np.deg2rad(1.0) * np.array([1.0 + 0.4j, -0.6 + 0.8j, 0.3j])
NOISE_RAD_S = np.deg2rad(1.1)


def azimuth_at(since_ns: npt.NDArray[np.int64], rpm: float) -> Array:
    return np.asarray(0.7 + 2.0 * np.pi * rpm / 60.0 * since_ns * 1e-9)


def motion(rpm: float, line_rad_s: npt.NDArray[np.complex128] = LINE_RAD_S) -> Motion:
    """Turns of 30 deg/s that come and go within seconds, white noise, and the line."""
    middle = np.arange(SLICES * STEPS) * STEP_NS + STEP_NS // 2
    seconds = middle * 1e-9
    slow = np.deg2rad(30.0) * np.stack([np.sin(3.0 * seconds), np.cos(2.0 * seconds), np.sin(0.5 * seconds)], axis=1)
    noise = NOISE_RAD_S * np.random.default_rng(5).normal(size=(len(middle), 3))
    line = (line_rad_s * np.exp(1j * azimuth_at(middle, rpm))[:, None]).real
    known = np.ones(len(middle), np.bool_)
    return Motion(START_NS, slow + noise + line, np.zeros_like(slow), known, 0.001, 0.001, LIDAR)


def piece(number: int, rpm: float) -> Slice:
    """Returns of all azimuths but the rear 150 deg, which a mask has taken out."""
    since_ns = number * SLICE_NS + np.sort(np.random.default_rng(number).integers(0, SLICE_NS, 6000))
    azimuth = azimuth_at(since_ns, rpm)
    seen = np.cos(azimuth) > np.cos(np.deg2rad(105.0))
    xyz = 10.0 * np.stack([np.sin(azimuth), np.cos(azimuth), np.full_like(azimuth, -0.3)], axis=1)
    return Slice(number, (START_NS + since_ns)[seen], xyz[seen].astype(np.float32))


@pytest.mark.parametrize("rpm", [540.0, 600.0, 1200.0])
def test_azimuth_and_rate_are_those_of_the_returns(rpm: float) -> None:
    found = rotor(piece(7, rpm), START_NS)
    assert found is not None
    azimuth, rate = found
    true = azimuth_at(np.array([7 * SLICE_NS + STEP_NS // 2]), rpm)[0]
    assert abs(np.angle(np.exp(1j * (azimuth - true)))) < np.deg2rad(2.0)
    assert rate == pytest.approx(2.0 * np.pi * rpm / 60.0, rel=2e-3)


@pytest.mark.parametrize("rpm", [540.0, 600.0, 1200.0])
def test_the_line_is_found_below_the_noise_and_beside_slow_turns(rpm: float) -> None:
    """White noise leaves sigma sqrt(2 / n) of n readings; the slow turns, less their mean over a revolution, a tenth of a degree/s."""
    line, made, readings = Line(), np.zeros((STEPS, 3)), motion(rpm)
    for number in range(SLICES):
        made = line.read(readings, piece(number, rpm))
    sigma = NOISE_RAD_S * np.sqrt(2.0 / (SLICES * STEPS))
    assert np.abs(line.value_rad_s - LINE_RAD_S).max() < 4.0 * sigma + np.deg2rad(0.1)
    middle = (SLICES - 1) * SLICE_NS + np.arange(STEPS) * STEP_NS + STEP_NS // 2
    true = (LINE_RAD_S * np.exp(1j * azimuth_at(middle, rpm))[:, None]).real
    assert np.abs(made - true).max() < 4.0 * sigma + np.deg2rad(0.15)


def test_nothing_is_taken_off_before_it_is_known_and_little_where_there_is_no_line() -> None:
    line, readings = Line(), motion(600.0, 0.0 * LINE_RAD_S)
    first = line.read(readings, piece(0, 600.0))
    assert not first.any()
    for number in range(1, SLICES):
        last = line.read(readings, piece(number, 600.0))
    assert np.abs(last).max() < np.deg2rad(0.1)


def test_at_the_pace_of_gusts_no_line_is_sought() -> None:
    line, readings = Line(), motion(300.0)
    for number in range(60):
        assert not line.read(readings, piece(number, 300.0)).any()


def test_with_time_reversed_the_line_changes_its_sign() -> None:
    line, readings = Line(), motion(600.0)
    for number in range(60):
        line.read(readings, piece(number, 600.0))
    np.testing.assert_allclose(line.reversed().value_rad_s, -line.value_rad_s)


def test_what_does_not_turn_has_no_line() -> None:
    steady = piece(3, 600.0)
    scattered = Slice(3, steady.time_ns, np.random.default_rng(1).permutation(steady.xyz_m))
    assert rotor(scattered, START_NS) is None
    assert rotor(Slice(3, steady.time_ns[:20], steady.xyz_m[:20]), START_NS) is None
