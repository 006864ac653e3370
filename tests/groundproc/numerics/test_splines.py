"""Uniform cubic B-splines against scipy's."""

import numpy as np
from scipy.interpolate import BSpline

from groundproc.numerics import splines


def test_the_weights_are_scipys() -> None:
    for u in np.linspace(0.0, 1.0, 21):
        np.testing.assert_allclose(
            splines.basis(float(u)), BSpline(np.arange(-3.0, 5.0), np.eye(4), 3)(u), rtol=0, atol=1e-15
        )
    np.testing.assert_allclose(splines.basis(0.0), [*splines.AT_KNOT, 0.0], rtol=0, atol=1e-16)


def test_values_are_scipys_at_all_times() -> None:
    coefficients = np.random.default_rng(1).normal(size=(12, 6))
    spline = BSpline(np.arange(-3.0, 13.0), coefficients, 3)
    out = np.empty(6)
    for at in np.random.default_rng(2).uniform(0.0, 9.0, 50):
        splines.value_at(coefficients, int(at), float(at - int(at)), out)
        np.testing.assert_allclose(out, spline(at), rtol=0, atol=1e-14)


def test_a_cubic_goes_through_its_values() -> None:
    """Inside; at the two ends values go on straight, which a cubic does not."""
    t = np.arange(12.0)
    values = np.stack([1.0 - t + 0.3 * t**2 - 0.02 * t**3, np.full(12, 5.0), 2.0 * t], axis=1)
    coefficients = splines.through(values)
    assert coefficients.shape == (14, 3)
    at_knots = sum(weight * coefficients[j : j + 12] for j, weight in enumerate(splines.AT_KNOT))
    np.testing.assert_allclose(at_knots[2:-2], values[2:-2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(at_knots[:, 1:], values[:, 1:], rtol=0, atol=1e-12)
