"""Where errors come from: S against dense matrices, and what it says of flights that are simulated draw by draw."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import make_interp_spline

from groundproc.estimation.adjustment.noise import LASTING_ROWS, PATCH_M, Noise, followed, lasting, noise_of
from groundproc.estimation.adjustment.posterior import Posterior
from groundproc.estimation.adjustment.solve import Problem, problem
from groundproc.estimation.observations.planes import rows_of
from groundproc.estimation.observations.rows import Carrying, Errors, Factor, Unknowns
from groundproc.estimation.odometry.grid import STEPS
from tests.helpers.circling import INTERVALS, circle, factors_of, room, unknowns_of_whole

Array = npt.NDArray[np.float64]
DEFLATION = 4.0


@pytest.fixture(scope="module")
def unknowns() -> Unknowns:
    return unknowns_of_whole()


@pytest.fixture(scope="module")
def posed(unknowns: Unknowns) -> tuple[Problem, Noise]:
    """A small flight whose increments of the path's shape are a gyro's, and an accelerometer's of the first half."""
    path = circle()
    clusters = room(path)
    rows = rows_of(clusters, path, 1.0, 10**6, cut=False)
    factors = factors_of(unknowns)
    turn = [6 * k + axis for k in range(1, INTERVALS + 1) for axis in range(3)]
    whole = factors[0]
    carrying = Carrying(np.arange(INTERVALS), 1e-3 / np.sqrt(STEPS))
    gyro = Factor("lidar gyro", whole.residual[turn], whole.matrix[turn], whole.sigma[turn], carrying=carrying)
    force = [6 * k + 3 + axis for k in range(INTERVALS // 2) for axis in range(3)]
    residual = np.random.default_rng(5).normal(size=len(force)) * whole.sigma[force]
    felt = Factor("ins accelerometer", residual, whole.matrix[force], whole.sigma[force], errors=Errors.LASTING)
    factors = [gyro, felt, *factors]
    linear = problem(rows, factors, unknowns, DEFLATION, path)
    x, _ = linear.solve(-linear.gradient)
    return linear, noise_of(rows, clusters, path, DEFLATION, factors, x)


def test_sources_that_are_worse_than_stated_err_by_that_much_more(
    unknowns: Unknowns,
) -> None:
    path = circle()
    clusters = room(path)
    rows = rows_of(clusters, path, 1.0, 10**6, cut=False)
    factors = factors_of(unknowns)
    factors[1].source = "fixes"
    x = np.zeros(unknowns.size)
    stated = noise_of(rows, clusters, path, DEFLATION, factors, x)
    worse = noise_of(rows, clusters, path, DEFLATION, factors, x, {"fixes": np.array([1.0, 2.0, 3.0])})
    times = worse.anchors.power(2).sum(axis=1) / stated.anchors.power(2).sum(axis=1)
    np.testing.assert_allclose(np.ravel(times)[:4], [1.0, 4.0, 9.0, 1.0])
    assert worse.strain["fixes"].max() == 3.0


def parts(noise: Noise, values: Array) -> list[Array]:
    return np.split(values, np.cumsum(noise.sizes)[:-1])


def test_what_the_sources_do_and_what_they_see_are_transposes(posed: tuple[Problem, Noise], unknowns: Unknowns) -> None:
    _, noise = posed
    assert all(size > 0 for size in noise.sizes)
    rng = np.random.default_rng(1)
    for _ in range(3):
        sources, vector = rng.normal(size=sum(noise.sizes)), rng.normal(size=unknowns.size)
        assert noise.gradient(*parts(noise, sources)) @ vector == pytest.approx(sources @ noise.seen(vector), rel=1e-6)


def test_patches_are_of_one_place_and_hold_whole_voxels(posed: tuple[Problem, Noise]) -> None:
    linear, noise = posed
    first = linear.rows.first
    for v in range(len(first) - 1):
        assert len(set(noise.patch[first[v] : first[v + 1]].tolist())) == 1
    # a room of 25 m by 25 m by 8 m has 7 by 7 cubes of 4 m on its floor, and walls of 7 by 2
    assert 49 <= noise.sizes[0] <= 49 + 4 * 7 * 3
    assert PATCH_M == 4.0


def test_a_course_that_a_spline_can_follow_is_followed_and_vibration_is_not() -> None:
    path = circle()
    follow = followed(path)
    grid = np.arange(len(path.quat)) / STEPS
    inside = slice(2 * STEPS, -2 * STEPS)
    cubic = 1.0 + 0.3 * grid - 0.02 * grid**2 + 1e-4 * grid**3
    np.testing.assert_allclose((follow @ cubic)[inside], cubic[inside], rtol=0, atol=1e-9)
    # scipy's spline through the knots is another way of following; both leave the same of a random walk between knots, to a tenth
    walk = np.cumsum(np.random.default_rng(1).normal(size=(len(grid), 200)), axis=0)
    scipys = make_interp_spline(grid[::STEPS], walk[::STEPS], k=3)(grid)
    left, reference = walk - follow @ walk, walk - scipys
    assert np.square(left[inside]).mean() == pytest.approx(np.square(reference[inside]).mean(), rel=0.1)
    # of a Brownian bridge over a slice, 1/6 of what the walk gains in it on average; a smooth curve leaves a little less or more
    assert np.square(left[inside]).mean() == pytest.approx(STEPS / 6.0, rel=0.25)
    vibration = np.sin(2 * np.pi * 2.5 * grid)
    assert np.square((vibration - follow @ vibration)[inside]).mean() > 0.3


def test_errors_that_last_count_for_more() -> None:
    """White noise of the stated size: 1 within what 300 sums tell. A first-order process: nearly its power at frequency zero."""
    rng = np.random.default_rng(3)
    white = rng.normal(size=3 * 100 * LASTING_ROWS)
    assert lasting(white) == pytest.approx(1.0, rel=3.0 / np.sqrt(2 * 300))
    keep, course = 0.6, np.zeros((5000, 3))
    for k in range(1, 5000):
        course[k] = keep * course[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=3)
    # of sums over 20 rows, a little short of it
    expected = np.sqrt(sum((1 - abs(k) / LASTING_ROWS) * keep ** abs(k) for k in range(-LASTING_ROWS, LASTING_ROWS)))
    assert lasting(course.ravel()) == pytest.approx(expected, rel=0.1)
    assert lasting(0.5 * white) == pytest.approx(0.5, rel=3.0 / np.sqrt(2 * 300))


def test_the_covariance_is_the_dense_sandwich(posed: tuple[Problem, Noise], unknowns: Unknowns) -> None:
    linear, noise = posed
    inverse = np.linalg.inv(np.stack([linear.apply(column) for column in np.eye(unknowns.size)], axis=1))
    seen = np.stack([noise.seen(column) for column in np.eye(unknowns.size)])
    posterior = Posterior(linear, unknowns, lambda: noise)
    told = posterior.told(np.eye(unknowns.size))
    dense = told @ inverse @ seen @ seen.T @ inverse.T @ told.T
    names = ["world.turn", "world.shift"]
    at = slice(unknowns.names[names[0]].start, unknowns.names[names[1]].stop)
    found = posterior.covariance(names)
    scale = np.sqrt(np.diag(dense)[at])
    np.testing.assert_allclose(
        found / np.outer(scale, scale), dense[at, at] / np.outer(scale, scale), rtol=0, atol=0.01
    )
    # what all poses share: the shift before the turn, and more of it than what says where the whole lies knows of
    order = [3, 4, 5, 0, 1, 2]
    np.testing.assert_allclose(posterior.datum()[np.ix_(order, order)], found, rtol=1e-9)
    anchored = told @ inverse @ noise.anchors.T
    assert (np.diag(found) > np.square(anchored[at]).sum(axis=1)).all()
    # and the path's: where the whole lies is not drawn and right to a few per cent, its shape to what 40 draws tell
    spread = posterior.spread(40)

    def place(x: Array) -> Array:
        return np.asarray(x[6 * 20 + 3 : 6 * 20 + 6] + x[unknowns.names["world.shift"]])

    def shape(x: Array) -> Array:
        return np.asarray(x[6 * 50 : 6 * 50 + 6] - x[6 * 10 : 6 * 10 + 6])

    for of, share in ((shape, 4.0 * np.sqrt(2.0 / 40)), (place, 0.05)):
        jacobian = np.stack([of(column) for column in np.eye(unknowns.size)], axis=1)
        expected = np.einsum("ij,jk,ik->i", jacobian, dense, jacobian)
        np.testing.assert_allclose(spread.variance(of), expected, rtol=share)


def test_covariances_of_poses_are_the_dense_sandwich(posed: tuple[Problem, Noise], unknowns: Unknowns) -> None:
    """All 21 numbers of a pose at five knots; of 60 draws a correlation is right to 1/8 where it is drawn, and most of it is not."""
    linear, noise = posed
    inverse = np.linalg.inv(np.stack([linear.apply(column) for column in np.eye(unknowns.size)], axis=1))
    seen = np.stack([noise.seen(column) for column in np.eye(unknowns.size)])
    posterior = Posterior(linear, unknowns, lambda: noise)
    told = posterior.told(np.eye(unknowns.size))
    dense = told @ inverse @ seen @ seen.T @ inverse.T @ told.T
    knots = np.array([5, 20, 35, 50, 65])
    place = circle().position_m[knots * STEPS]
    names = unknowns.names

    def poses(x: Array) -> Array:
        coefficients = x[: unknowns.path_size].reshape(-1, 6)[knots]
        turn = x[names["world.turn"]]
        position = coefficients[:, 3:] + x[names["world.shift"]] + np.cross(turn, place)
        return np.hstack([position, coefficients[:, :3] + turn])

    jacobian = np.stack([poses(column) for column in np.eye(unknowns.size)], axis=2)
    expected = jacobian @ dense @ np.swapaxes(jacobian, 1, 2)
    sigma = np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
    known, drawn = posterior.spread(60).moments(poses)
    found = (known + drawn) / (sigma[:, :, None] * sigma[:, None, :])
    np.testing.assert_allclose(
        found, expected / (sigma[:, :, None] * sigma[:, None, :]), rtol=0, atol=3.0 / np.sqrt(60)
    )
    # what needs no drawing is most of where the whole lies
    shares = np.diagonal(known, axis1=1, axis2=2)[:, :3] / np.square(sigma[:, :3])
    assert shares.min() > 0.8
