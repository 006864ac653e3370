"""Rotations inside kernels, against scipy's, and the flattest direction against numpy's eigenvectors."""

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
        np.testing.assert_allclose(scipys(out).as_matrix(), expected, atol=1e-14)
        np.testing.assert_allclose(out, frames.quat_multiply(p[None], q[None])[0], atol=1e-15)
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
        np.testing.assert_allclose(out, exponent, atol=1e-12)
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
        np.testing.assert_allclose(out, vector, atol=2e-15)


def test_a_difference_goes_the_short_way() -> None:
    out, first = np.empty(3), quats(1)[0]
    turned = np.empty(4)
    rotations.quat_turned(first, 0.0, 0.0, 4.0, turned)
    rotations.quat_difference(first, turned, out)
    np.testing.assert_allclose(out, [0.0, 0.0, 4.0 - 2.0 * np.pi], atol=1e-14)


def test_matrices_are_scipys() -> None:
    out = np.empty((3, 3))
    for quat in quats(50):
        rotations.mat_of_quat(quat, out)
        np.testing.assert_allclose(out, scipys(quat).as_matrix(), atol=1e-14)


def flattest(matrix: Array) -> tuple[float, float, Array]:
    """The kernel's answer for a symmetric matrix."""
    normal = np.empty(3)
    low, middle = rotations.flattest(
        matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 1], matrix[1, 2], matrix[2, 2], normal
    )
    return low, middle, normal


def test_the_flattest_direction_is_numpys_eigenvector() -> None:
    """Planes of all tilts and degrees of flatness; Cardano's formula loses half the digits of a small eigenvalue, of the largest's size."""
    rng = np.random.default_rng(5)
    for flatness in (1e-6, 1e-3, 0.1):
        for _ in range(200):
            axes = Rotation.random(rng=rng).as_matrix()
            sizes = np.array([flatness, 0.3 + rng.random(), 1.5 + rng.random()]) * 10.0 ** rng.uniform(-4, 2)
            matrix = axes @ np.diag(sizes) @ axes.T
            values, vectors = np.linalg.eigh(matrix)
            low, middle, normal = flattest(matrix)
            assert low == pytest.approx(values[0], abs=1e-7 * values[2])
            assert middle == pytest.approx(values[1], abs=1e-7 * values[2])
            assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
            assert abs(normal @ vectors[:, 0]) > 1.0 - 1e-12


def test_degenerate_moments_give_a_unit_normal_still() -> None:
    for matrix in (np.diag([1.0, 1.0, 1.0 + 1e-9]), np.diag([1.0, 0.0, 0.0]), np.diag([1.0, 1.0, 0.0])):
        low, middle, normal = flattest(matrix)
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        values = np.linalg.eigvalsh(matrix)
        assert low == pytest.approx(values[0], abs=1e-7)
        assert middle == pytest.approx(values[1], abs=1e-7)
        assert normal @ matrix @ normal == pytest.approx(values[0], abs=1e-7)
