"""Planes near each other that face nearly one way are judged by their mean normal, and by how unsure that is."""

import numpy as np
import numpy.typing as npt

from groundproc.numerics.facing import mean_normals

Array = npt.NDArray[np.float64]


def leaning(rng: np.random.Generator, normal: list[float], count: int, sigma_rad: float) -> Array:
    """Unit normals of either side that lean at random about both axes."""
    found = np.array(normal) + rng.normal(scale=sigma_rad, size=(count, 3))
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True) * rng.choice([-1.0, 1.0], (count, 1)))


def test_the_mean_of_a_wall_is_better_by_the_root_of_its_planes_and_says_so() -> None:
    rng = np.random.default_rng(1)
    sigma, off, said = 0.03, [], []
    for _ in range(300):
        normal = leaning(rng, [0.0, 1.0, 0.0], 40, sigma)
        mean, covariance = mean_normals(rng.uniform(0.1, 3.9, (40, 3)), normal, np.zeros(40), 4.0)
        assert (np.einsum("ni,ni->n", mean, normal) > 0.9).all()  # on the side of each
        off.append(mean[0] * np.sign(mean[0, 1]))
        said.append(covariance[0])
    real = np.array(off)[:, [0, 2]].std(axis=0)
    np.testing.assert_allclose(real, sigma / np.sqrt(40), rtol=0.15)
    np.testing.assert_allclose(np.sqrt(np.mean(said, axis=0)[[0, 2], [0, 2]]), real, rtol=0.15)


def test_what_faces_elsewhere_or_stands_elsewhere_has_a_mean_of_its_own() -> None:
    rng = np.random.default_rng(2)
    wall, end = leaning(rng, [0.0, 1.0, 0.0], 30, 0.02), leaning(rng, [1.0, 0.0, 0.0], 5, 0.02)
    far = leaning(rng, [0.1, 1.0, 0.0], 30, 0.02)
    place = np.concatenate([rng.uniform(0.1, 3.9, (35, 3)), rng.uniform(4.1, 7.9, (30, 3))])
    mean, _ = mean_normals(place, np.concatenate([wall, end, far]), np.zeros(65), 4.0)
    lean_deg = np.rad2deg(np.arctan2(np.abs(mean[:, 0]), np.abs(mean[:, 1])))
    assert lean_deg[:30].max() < 1.5
    assert lean_deg[30:35].min() > 88.0
    np.testing.assert_allclose(lean_deg[35:], np.rad2deg(np.arctan(0.1)), rtol=0, atol=1.5)


def test_a_plane_by_itself_keeps_its_normal_and_what_is_stated_of_it() -> None:
    normal = np.array([[0.6, 0.8, 0.0]])
    mean, covariance = mean_normals(np.ones((1, 3)), normal, np.array([4e-4]), 4.0)
    np.testing.assert_allclose(mean, normal)
    np.testing.assert_allclose(np.linalg.eigvalsh(covariance[0]), [0.0, 4e-4, 4e-4], rtol=0, atol=1e-12)


def test_no_plane_has_no_mean() -> None:
    mean, covariance = mean_normals(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), 4.0)
    assert mean.shape == (0, 3)
    assert covariance.shape == (0, 3, 3)
