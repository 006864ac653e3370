"""Rotations inside kernels, against scipy's."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from flightlog import frames
from groundproc.numerics import rotations

Array = npt.NDArray[np.float64]


def quats(count: int, seed: int = 1) -> Array:
    """Attitudes of all kinds, scalar first; either sign stands for the same."""
    drawn = np.random.default_rng(seed).normal(size=(count, 4))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1)[:, None])


def scipys(quat: Array) -> Rotation:
    return Rotation.from_quat(quat, scalar_first=True)


def test_products_are_scipys_and_may_overwrite_a_factor() -> None:
    for p, q in zip(quats(50, 1), quats(50, 2), strict=True):
        expected = (scipys(p) * scipys(q)).as_matrix()
        out = np.empty(4)
        rotations.quat_multiply(p, q, out)
        np.testing.assert_allclose(scipys(out).as_matrix(), expected, rtol=0, atol=1e-14)
        np.testing.assert_allclose(out, frames.quat_multiply(p[None], q[None])[0], rtol=0, atol=1e-15)
        rotations.quat_multiply(p, q, p)
        np.testing.assert_array_equal(p, out)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.199, 0.201, 1.0, 3.0, 3.14159, 6.0])
def test_a_turn_in_the_body_is_scipys_on_both_sides_of_the_series(size: float) -> None:
    """The series up to half an angle of 0.1 leaves out 0.1^8 / 8!, 2.5e-13, at most."""
    rng = np.random.default_rng(3)
    for quat in quats(20):
        vector = rng.normal(size=3)
        vector *= size / np.linalg.norm(vector)
        out = np.empty(4)
        rotations.quat_turned(quat, vector[0], vector[1], vector[2], out)
        expected = scipys(quat) * Rotation.from_rotvec(vector)
        assert (scipys(out).inv() * expected).magnitude() < 1e-12
        assert np.linalg.norm(out) == pytest.approx(1.0, abs=1e-15)
        exponent = frames.quat_multiply(quat[None], frames.quat_exp(vector[None]))[0]
        np.testing.assert_allclose(out, exponent, rtol=0, atol=1e-12)
        rotations.quat_turned(quat, vector[0], vector[1], vector[2], quat)
        np.testing.assert_array_equal(quat, out)


@pytest.mark.parametrize("size", [1e-13, 1e-9, 1e-3, 1.0, 3.0])
def test_a_difference_is_what_was_turned(size: float) -> None:
    rng = np.random.default_rng(4)
    for quat, sign in zip(quats(20), [1.0, -1.0] * 10, strict=True):
        vector = rng.normal(size=3)
        vector *= size / np.linalg.norm(vector)
        turned, out = np.empty(4), np.empty(3)
        rotations.quat_turned(quat, vector[0], vector[1], vector[2], turned)
        rotations.quat_difference(quat, sign * turned, out)  # the other sign is the same attitude
        np.testing.assert_allclose(out, vector, rtol=0, atol=2e-15)


def test_a_difference_goes_the_short_way() -> None:
    out, first = np.empty(3), quats(1)[0]
    turned = np.empty(4)
    rotations.quat_turned(first, 0.0, 0.0, 4.0, turned)
    rotations.quat_difference(first, turned, out)
    np.testing.assert_allclose(out, [0.0, 0.0, 4.0 - 2.0 * np.pi], rtol=0, atol=1e-14)


def test_matrices_are_scipys() -> None:
    out = np.empty((3, 3))
    for quat in quats(50):
        rotations.mat_of_quat(quat, out)
        np.testing.assert_allclose(out, scipys(quat).as_matrix(), rtol=0, atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 1e-3, 1.0, 3.0, 6.0])
def test_a_share_of_a_turn_is_scipys(size: float) -> None:
    """And so is what lies between two attitudes in the outer frame."""
    rng = np.random.default_rng(6)
    for quat, share in zip(quats(20), rng.uniform(-1.0, 1.0, 20), strict=True):
        vector = rng.normal(size=3)
        vector *= size / np.linalg.norm(vector)
        out, between = np.empty(4), np.empty(3)
        rotations.quat_turned_by(quat, vector, share, out)
        expected = scipys(quat) * Rotation.from_rotvec(share * vector)
        assert (scipys(out).inv() * expected).magnitude() < 1e-14
        rotations.quat_difference_outside(out, quat, between)
        outside = (expected * scipys(quat).inv()).as_rotvec()
        np.testing.assert_allclose(
            Rotation.from_rotvec(between).as_matrix(), Rotation.from_rotvec(outside).as_matrix(), rtol=0, atol=1e-14
        )
        assert np.linalg.norm(between) <= np.pi + 1e-12


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.99e-3, 1.01e-3, 0.5, 3.0])
def test_vectors_are_turned_as_scipy_turns_them(size: float) -> None:
    """The series for angles below 1e-3 leaves out 1e-12 / 120 of the vector's length."""
    rng = np.random.default_rng(7)
    for quat in quats(20):
        vector, point, out = rng.normal(size=3), rng.normal(size=3), np.empty(3)
        vector *= size / np.linalg.norm(vector)
        rotations.rotated(quat, point, out)
        np.testing.assert_allclose(out, scipys(quat).apply(point), rtol=0, atol=1e-14)
        rotations.moved_by_turn(vector, point, out)
        np.testing.assert_allclose(out, Rotation.from_rotvec(vector).apply(point) - point, rtol=0, atol=2e-14)
