"""Planes by second moments against numpy's eigenvectors and covariances."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from groundproc.numerics import planes
from groundproc.numerics.voxelhash import assign, sorted_by

Array = npt.NDArray[np.float64]
SIX = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def flattest(matrix: Array) -> tuple[float, float, Array]:
    """The kernel's answer for a symmetric matrix."""
    normal = np.empty(3)
    low, middle = planes.flattest(
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


def six(matrix: Array) -> Array:
    """A symmetric matrix as its six numbers."""
    return np.array([matrix[i, j] for i, j in SIX])


def test_scatters_add_up_as_the_scatter_of_all_points_together() -> None:
    rng = np.random.default_rng(1)
    parts = [rng.normal(size=(count, 3)) + rng.normal(size=3) for count in (5, 9, 30)]
    whole = np.concatenate(parts)
    total = np.zeros(6)
    for part in parts:
        own = six(np.cov(part.T, ddof=0) * len(part))
        planes.add_scatter(total, 1.0, own, float(len(part)), tuple((part.mean(axis=0) - whole.mean(axis=0)).tolist()))
    np.testing.assert_allclose(total, six(np.cov(whole.T, ddof=0) * len(whole)), rtol=1e-12)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    along = (whole - whole.mean(axis=0)) @ normal
    assert planes.scatter_along(total, *normal.tolist()) == pytest.approx(np.square(along).sum(), rel=1e-12)
    low, middle = planes.flattest_of(total, 1.0 / len(whole), normal)
    np.testing.assert_allclose([low, middle], np.linalg.eigvalsh(np.cov(whole.T, ddof=0))[:2], rtol=1e-6)


def test_the_axes_of_a_plane_are_at_right_angles_to_each_other_and_to_its_normal() -> None:
    for normal in [*Rotation.random(50, rng=np.random.default_rng(2)).as_matrix()[:, 2], np.eye(3)[0], -np.eye(3)[2]]:
        made = np.array(planes.axes_along(*normal.tolist())).reshape(2, 3)
        together = np.stack([normal, *made])
        np.testing.assert_allclose(together @ together.T, np.eye(3), rtol=0, atol=1e-14)


class TestVoxels:
    """Clusters on a level floor in one voxel, some seen in one interval and some in the next, of four returns each."""

    def seen(self, world: Array, group: tuple[int, ...] = (), knots: tuple[int, ...] = (0, 1)) -> planes.Placed:
        count = len(world)
        scatter = np.tile(np.array([4e-4, 0, 0, 4e-4, 0, 4e-4], np.float32), (count, 1))
        knot = np.resize(np.array(knots, np.int32), count)
        return planes.Placed(world, scatter, np.full(count, 4, np.int32), knot, np.array(group, np.int32))

    def found(self, seen: planes.Placed) -> planes.VoxelPlanes:
        out = planes.VoxelPlanes.empty(1)
        planes.find_planes(np.array([0, len(seen.world_m)]), np.arange(len(seen.world_m)), seen, 1.0, out)
        return out

    FLOOR = np.array([[0.1, 0.1, 0.5], [0.9, 0.2, 0.5], [0.2, 0.8, 0.5], [0.8, 0.9, 0.5]])

    def test_a_floor_is_a_plane_through_its_mean(self) -> None:
        out = self.found(self.seen(self.FLOOR))
        assert out.good[0]
        np.testing.assert_allclose(np.abs(out.normal[0]), [0.0, 0.0, 1.0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(out.mean_m[0], self.FLOOR.mean(axis=0), rtol=0, atol=1e-15)

    def test_what_one_interval_saw_alone_is_none(self) -> None:
        assert not self.found(self.seen(self.FLOOR, knots=(3,))).good[0]

    def test_two_clusters_are_none(self) -> None:
        assert not self.found(self.seen(self.FLOOR[:2])).good[0]

    def test_a_cube_of_points_is_none(self) -> None:
        assert not self.found(self.seen(np.random.default_rng(3).random((40, 3)))).good[0]

    def test_layers_apart_are_a_plane_only_where_they_are_of_different_groups(self) -> None:
        """Strips that do not lie on each other yet do not make a surface thick; the mean is that of all."""
        layers = np.concatenate([self.FLOOR, self.FLOOR + np.array([0.0, 0.0, 0.4])])
        assert not self.found(self.seen(layers)).good[0]
        out = self.found(self.seen(layers, group=(1,) * 4 + (2,) * 4))
        assert out.good[0]
        np.testing.assert_allclose(out.mean_m[0], layers.mean(axis=0), rtol=0, atol=1e-15)
        np.testing.assert_allclose(np.abs(out.normal[0]), [0.0, 0.0, 1.0], rtol=0, atol=1e-12)


def test_points_are_sorted_by_their_voxels_and_keep_their_order_inside() -> None:
    points = np.random.default_rng(4).uniform(-3.0, 3.0, (500, 3))
    voxel, voxels = assign(points, 0.7)
    cells, expected = np.unique(np.floor(points / 0.7), axis=0, return_inverse=True)
    assert voxels == len(cells)
    order, first = sorted_by(voxel, voxels)
    for v in range(voxels):
        members = order[first[v] : first[v + 1]]
        assert len(set(expected.ravel()[members].tolist())) == 1
        assert (np.diff(members) > 0).all()
    assert sorted(order.tolist()) == list(range(500))


@pytest.mark.parametrize("counts", [[], [7], [100, 1, 1], [1, 1, 100], [3, 4, 5, 6]])
def test_halves_hold_every_voxel_once(counts: list[int]) -> None:
    first, seen = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), np.zeros(len(counts), np.int64)

    def count(some: slice) -> None:
        seen[some] += 1

    planes.by_halves(count, first)
    assert (seen == 1).all()
