"""The two-level preconditioner: against dense matrices of a small flight."""

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.adjustment.coarse import EVERY, Coarse, Nodes, coarse_of, lidar_between
from groundproc.estimation.adjustment.solve import Problem, problem
from groundproc.estimation.observations.planes import Rows, rows_of
from groundproc.estimation.observations.rows import Unknowns
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from tests.helpers.circling import INTERVALS, SIZE, circle, factors_of, room, unknowns_of_whole

Array = npt.NDArray[np.float64]
DEFLATION = 4.0


@pytest.fixture(scope="module")
def path() -> Path:
    return circle()


@pytest.fixture(scope="module")
def rows(path: Path) -> Rows:
    return rows_of(room(path), path, 1.0, 10**6, cut=False)


@pytest.fixture(scope="module")
def unknowns() -> Unknowns:
    return unknowns_of_whole()


@pytest.fixture(scope="module")
def posed(path: Path, rows: Rows, unknowns: Unknowns) -> tuple[Problem, Array]:
    """A problem, and its normal matrix written down."""
    made = problem(rows, factors_of(unknowns), unknowns, DEFLATION, path)
    return made, np.stack([made.apply(column) for column in np.eye(unknowns.size)], axis=1)


def test_the_matrix_between_nodes_is_the_lidars_for_paths_between_nodes(path: Path, rows: Rows) -> None:
    nodes = Nodes.of(path)
    assert len(nodes.centre_m) >= INTERVALS // EVERY
    prolongation = nodes.prolongation().toarray()
    lidar = np.stack([rows.apply(column) for column in np.eye(SIZE)], axis=1)
    expected = prolongation.T @ lidar @ prolongation
    # the turned, moved rows are summed in another order
    np.testing.assert_allclose(lidar_between(rows, nodes), expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_rigid_motion_of_the_path_is_one_of_all_nodes(path: Path) -> None:
    """Turned by a small angle about the origin, the corrected path is the turned one, as far as a spline can be."""
    nodes, turn = Nodes.of(path), np.array([1e-4, -2e-4, 3e-4])
    motion = np.concatenate([np.tile(turn, (len(nodes.centre_m), 1)), np.cross(turn, nodes.centre_m)], axis=1)
    corrected = path.corrected((nodes.prolongation() @ motion.ravel()).reshape(-1, 6))
    turned = path.turned(frames.mat_from_quat(frames.quat_exp(turn[None]))[0], np.zeros(3))
    inside = slice(STEPS, -STEPS)
    # of 8 m times 4e-4 rad
    assert np.abs(corrected.position_m - turned.position_m)[inside].max() < 1e-5
    off = frames.quat_log(frames.quat_multiply(frames.quat_inverse(turned.quat), corrected.quat))
    assert np.abs(off)[inside].max() < 1e-6


def test_the_coarse_solution_is_the_best_of_all_between_nodes(path: Path, posed: tuple[Problem, Array]) -> None:
    made, normal = posed
    coarse: Coarse = coarse_of(made.rows, DEFLATION, made.normal, path)
    right = np.random.default_rng(2).normal(size=(len(normal), 3))
    prolongation = coarse.prolongation.toarray()
    best = prolongation @ np.linalg.solve(prolongation.T @ normal @ prolongation, prolongation.T @ right)
    np.testing.assert_allclose(coarse.solve(right), best, rtol=0, atol=1e-5 * np.abs(best).max())


def test_the_preconditioner_is_nearly_the_inverse(posed: tuple[Problem, Array]) -> None:
    """Eigenvalues from a tenth to three: conjugate gradients take a dozen steps, not hundreds."""
    made, normal = posed
    root = np.linalg.cholesky(normal)
    near = np.stack([root.T @ (made.factor.solve(column) + made.coarse.solve(column)) for column in root.T], axis=1)
    values = np.linalg.eigvalsh(0.5 * (near + near.T))
    assert values.min() > 0.05
    assert values.max() < 4.0


def test_the_solution_is_right_to_the_share_of_its_sigma_that_is_asked_for(posed: tuple[Problem, Array]) -> None:
    """In the norm of the normal matrix, which bounds every function of the unknowns in its own sigma."""
    made, normal = posed
    rng, root = np.random.default_rng(3), np.linalg.cholesky(normal)
    for enough in (1.0, 0.01, 1e-4):
        for right in np.stack([root @ rng.normal(size=len(normal)), 1e3 * root[:, 0], np.eye(len(normal))[-1]]):
            found, steps = made.solve(right, enough)
            off = found - np.linalg.solve(normal, right)
            assert off @ normal @ off < enough
            assert steps < 40


def test_several_right_sides_are_solved_as_each_by_itself(posed: tuple[Problem, Array]) -> None:
    """Some end after other numbers of steps, one is nothing, and together they are no whole number of blocks."""
    problem, _ = posed
    rng = np.random.default_rng(4)
    rights = rng.normal(size=(len(problem.gradient), 7)) * np.geomspace(1e-3, 1e3, 7)
    rights[:, 2] = 0.0
    images = problem.apply_all(rights)
    found = problem.solve_all(rights, 0.0, 1e-3)
    steps = set()
    for image, each, right in zip(images.T, found.T, rights.T, strict=True):
        assert image == pytest.approx(problem.apply(right), rel=1e-9, abs=1e-9 * np.abs(image).max())
        alone, count = problem.solve(right, 0.0, 1e-3)
        steps.add(count)
        # rounding, times what the problem is ill-conditioned by: the path's own coefficients are held with 100 m
        assert each == pytest.approx(alone, rel=1e-8, abs=1e-8 * np.abs(alone).max())
    assert len(steps) > 1
