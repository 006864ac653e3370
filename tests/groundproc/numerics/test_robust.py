"""Robust statistics against scipy's and against what they are for."""

import numpy as np
import pytest
from scipy.stats import median_abs_deviation, norm

from groundproc.numerics import robust


def test_the_factor_is_that_of_a_normal_distribution() -> None:
    assert pytest.approx(1.0 / norm.ppf(0.75), abs=5e-5) == robust.MAD_TO_SIGMA


def test_sigmas_are_scipys() -> None:
    values = np.random.default_rng(1).normal(size=(301, 3)) * [1.0, 2.0, 0.5] + [5.0, -3.0, 0.0]
    scale = 1.0 / robust.MAD_TO_SIGMA
    assert robust.sigma(values[:, 0]) == pytest.approx(median_abs_deviation(values[:, 0], scale=scale))
    np.testing.assert_allclose(robust.sigma_of_columns(values), median_abs_deviation(values, scale=scale))


def test_a_given_centre_is_taken() -> None:
    values = np.array([[1.0, 10.0], [2.0, 20.0], [4.0, 30.0]])
    assert robust.sigma(values[:, 0], 0.0) == pytest.approx(1.4826 * 2.0)
    np.testing.assert_allclose(robust.sigma_of_columns(values, 0.0), 1.4826 * np.array([2.0, 20.0]))
    # all columns together, each about its own middle: distances 1 0 2 10 0 10
    assert robust.sigma(values, np.median(values, axis=0)) == pytest.approx(1.4826 * 1.5)


def test_a_third_of_wild_values_moves_a_sigma_by_what_theory_allows() -> None:
    """With a share e of outliers, the quartile becomes that of 0.5 / (1 - e) of the rest: at a third 1.4826 x 1.15."""
    values = np.random.default_rng(2).normal(size=30_000)
    values[:10_000] = 1e9 * np.sign(values[:10_000])
    assert robust.sigma(values, 0.0) == pytest.approx(robust.MAD_TO_SIGMA * norm.ppf(0.875), rel=0.03)


def test_white_noise_is_found_under_smooth_motion() -> None:
    rng, time = np.random.default_rng(3), np.arange(4000) * 0.005
    motion = np.stack([np.sin(3 * time), np.cos(2 * time), time], axis=1)
    assert robust.white_noise(motion + 0.02 * rng.normal(size=motion.shape)) == pytest.approx(0.02, rel=0.05)


def test_hubers_weights_make_the_gradient_of_his_loss() -> None:
    """x up to the limit, the limit beyond."""
    distance = np.array([0.0, 0.5, 1.5, 3.0, 1e6])
    np.testing.assert_allclose(robust.huber(distance, 1.5) * distance, [0.0, 0.5, 1.5, 1.5, 1.5])


def test_cauchys_weights_make_the_gradient_of_his_loss() -> None:
    distance, step = np.array([0.1, 1.0, 7.0]), 1e-6
    loss = [0.5 * np.log1p(np.square(distance + side * step)) for side in (-1, 1)]
    np.testing.assert_allclose(robust.cauchy(distance) * distance, (loss[1] - loss[0]) / (2 * step), rtol=1e-8)
