"""Filters, spectra and peaks against scipy.signal."""

import numpy as np
import pytest
from scipy import signal

from groundproc.numerics import filters


@pytest.mark.parametrize(("cutoff_hz", "rate_hz"), [(5.0, 200.0), (0.5, 200.0), (15.0, 50.0), (45.0, 100.0)])
@pytest.mark.parametrize(("count", "padding"), [(4000, 600), (30, 29), (1, 0), (12, 0)])
def test_low_pass_as_scipy(cutoff_hz: float, rate_hz: float, count: int, padding: int) -> None:
    """Forward and back, ends included."""
    values = np.random.default_rng(3).normal(size=(count, 3)).cumsum(axis=0) + 10.0
    theirs = signal.butter(4, cutoff_hz, fs=rate_hz, output="sos")
    ours = filters.butterworth(cutoff_hz, rate_hz)
    response = [signal.sosfreqz(each, np.linspace(0.0, np.pi, 50))[1] for each in (ours, theirs)]
    assert response[0] == pytest.approx(response[1], abs=1e-12)
    expected = signal.sosfiltfilt(theirs, values, axis=0, padlen=padding)
    found = filters.forward_and_back(ours, values, padding)
    assert found.shape == expected.shape
    # rounding grows with the time that a filter remembers, by the fourth power (0.5 Hz at 200 Hz: 1e-9 of a section's state)
    assert np.abs(found - expected).max() < 1e-12 * max(1.0, (0.1 * rate_hz / cutoff_hz) ** 3) * np.abs(values).max()


def test_low_pass_leaves_the_values_and_takes_one_series() -> None:
    """Values of any shape behind the first axis, which stay as they are."""
    values = np.arange(50.0)
    before = values.copy()
    found = filters.forward_and_back(filters.butterworth(5.0, 100.0), values, 20)
    assert (values == before).all()
    theirs = signal.butter(4, 5.0, fs=100.0, output="sos")
    assert found == pytest.approx(signal.sosfiltfilt(theirs, values, padlen=20), abs=1e-12)


@pytest.mark.parametrize("count", [64, 65, 96, 1000])
def test_spectrum_as_welch(count: int) -> None:
    """Of three series."""
    values = np.random.default_rng(5).normal(size=(count, 3)) + 5.0
    at_hz, density = signal.welch(values, 50.0, nperseg=64, axis=0)
    found_hz, found = filters.spectrum(values, 50.0, 64)
    assert found_hz == pytest.approx(at_hz, abs=1e-12)
    assert found == pytest.approx(density, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("seed", range(40))
def test_peaks_as_scipy(seed: int) -> None:
    """Noise of all widths, with flat tops; of equal peaks that are near each other scipy keeps any, by how it sorts."""
    rng = np.random.default_rng(seed)
    values = np.convolve(rng.normal(size=300), np.ones(1 + seed % 7), "same")
    if seed % 2:
        values = np.repeat(values, rng.integers(1, 5, len(values)))
    height, prominence, apart = rng.uniform(-1.0, 1.0), rng.uniform(0.01, 2.0), int(rng.integers(1, 20))
    expected, _ = signal.find_peaks(values, height=height, prominence=prominence, distance=apart)
    assert filters.peaks(values, height, prominence, apart).tolist() == expected.tolist()


@pytest.mark.parametrize("values", [[], [1.0], [1.0, 2.0], [2.0, 2.0, 2.0], [0.0, 1.0, 1.0, 0.0]])
def test_peaks_of_few(values: list[float]) -> None:
    """As many as there are."""
    expected = [1] if values == [0.0, 1.0, 1.0, 0.0] else []
    assert filters.peaks(np.array(values), 0.0, 0.0, 1).tolist() == expected
