"""What hides in the noise of single points, and how well one epoch lies on the other."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from groundproc.analysis.changewindows import Apart, together
from groundproc.analysis.registration import Registration, register

Array = npt.NDArray[np.float64]
SIDE_M = 10.0


def apart(rng: np.random.Generator, per_m2: float, bumps: Array, height: float) -> tuple[Array, Apart]:
    """Distances of one sigma from level ground, with more of it on squares of 10 cm."""
    xy = rng.uniform(0, SIDE_M, (int(per_m2 * SIDE_M**2), 2))
    sigmas = rng.standard_normal(len(xy))
    for place in bumps:
        sigmas[(np.abs(xy - place) < 0.05).all(axis=1)] += height
    foot = np.column_stack([xy, np.zeros(len(xy))])
    return xy, Apart(foot, np.tile([0.0, 0.0, 1.0], (len(xy), 1)), sigmas)


def test_points_that_lie_off_together_are_told_and_bumps_of_both_epochs_are_not() -> None:
    rng = np.random.default_rng(4)
    places = np.stack(np.meshgrid(np.arange(1.0, 9.5), np.arange(1.0, 9.5)), axis=-1).reshape(-1, 2)
    old = places[1::2]
    _, surface = apart(rng, 1000.0, old, 3.5)
    xy, points = apart(rng, 1000.0, places, 3.5)
    side = together(points, surface, 0.1, 0.1 * 0.01 / 400.0)
    counts = np.array([(side[(np.abs(xy - place) < 0.05).all(axis=1)] == 1).sum() for place in places])
    assert (counts[::2] >= 3).mean() >= 0.9
    assert (counts[1::2] >= 3).mean() <= 0.3
    # of 40 000 windows chance is to make a tenth of one
    away = np.abs(xy[:, None] - places[None]).max(axis=2).min(axis=1) > 0.15
    assert (side[away] != 0).sum() <= 10


def place(rng: np.random.Generator, waves_m: float, bushes: Array) -> Array:
    """Ground, and bushes that lean by 10 cm as a whole."""
    xy = rng.uniform(0, SIDE_M, (int(400 * SIDE_M**2), 2))
    z = waves_m * (np.sin(xy[:, 0] / 1.7) + np.cos(xy[:, 1] / 1.1))
    parts = [np.column_stack([xy, z])]
    for x, y in bushes:
        way = rng.standard_normal((400, 3))
        way *= 0.5 / np.linalg.norm(way, axis=1)[:, None]
        parts.append(way + np.array([x, y, 0.5]) + rng.normal(0, 0.1, 3))
    xyz = np.concatenate(parts)
    return np.asarray(xyz + rng.normal(0, 1, xyz.shape) * (0.005, 0.005, 0.02))


def error_in_sigmas(found: Registration, turn: Rotation, shift: Array) -> Array:
    """Of shift and turn at the place where they are told, shape (6,)."""
    about = found.about_m
    shift_left = found.move(turn.apply(about)[None] + shift)[0] - about
    turned = (Rotation.from_matrix(found.matrix[:3, :3]) * turn).as_rotvec()
    return np.asarray(np.concatenate([shift_left, turned]) / np.sqrt(np.diag(found.covariance)))


@pytest.mark.parametrize("bushes", [pytest.param(0, marks=pytest.mark.soak), 4])  # four registrations each
def test_errors_of_a_registration_are_of_the_size_of_its_sigmas(bushes: int) -> None:
    turn, shift = Rotation.from_rotvec(np.radians([0.05, -0.1, 0.2])), np.array([0.03, -0.02, 0.015])
    errors = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        where = rng.uniform(1, SIDE_M - 1, (bushes, 2))
        a, b = place(rng, 0.08, where), place(rng, 0.08, where)
        errors.append(error_in_sigmas(register(a, turn.apply(b) + shift), turn, shift))
    # of 24 normal values with the sigma stated, a root mean square of 1.5 has a chance of one in ten thousand; patches
    # that share points cost half as much again
    assert np.sqrt(np.mean(np.square(errors))) < 2.2


def test_bushes_on_a_plain_do_not_tell_where_it_lies() -> None:
    rng = np.random.default_rng(8)
    where = rng.uniform(1, SIDE_M - 1, (4, 2))
    a, b = place(rng, 0.0, where), place(rng, 0.0, where)
    shift = np.array([0.03, -0.02, 0.015])
    found = register(a, b + shift)
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(error_in_sigmas(found, Rotation.identity(), shift)) < 4.0).all()
    assert (sigma[:2] > 0.02).all()
    assert sigma[2] < 0.002
