"""How many times more than stated errors of fixes are: drawn receivers, on paths that know a direction and paths that do not."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy import sparse
from scipy.linalg import cho_factor
from scipy.signal import lfilter

from groundproc.estimation.adjustment.coarse import Coarse
from groundproc.estimation.adjustment.straining import of_source, strains
from groundproc.estimation.observations.fixes import SLID
from groundproc.estimation.observations.rows import Errors, Factor, whitened

Array = npt.NDArray[np.float64]
SECONDS = 60
SIGMA_M = np.array([3.0, 3.0, 4.5])
TAU_S = np.array([60.0, 60.0, 300.0])
DRAWS = 60


def receiver(rng: np.random.Generator, times: Array) -> Array:
    """Errors that last, so many times what is stated east, north, up, shape (SECONDS, 3)."""
    keep = np.exp(-1.0 / TAU_S)
    steps = rng.standard_normal((SECONDS, 3)) * np.sqrt(1.0 - keep**2)
    steps[0] = rng.standard_normal(3)
    made = [lfilter([1.0], [1.0, -keep[i]], steps[:, i]) for i in range(3)]
    return np.asarray(np.stack(made, axis=1) * SIGMA_M * times)


def judged(error_m: Array, loose: tuple[bool, bool, bool], weakened: float = 1.0) -> Array:
    """Factors of a receiver with these errors; along the axes that are `loose` nothing but its fixes holds the path."""
    unknowns = 3 * SECONDS + 6
    matrix = sparse.hstack([sparse.eye(3 * SECONDS), sparse.csr_matrix((3 * SECONDS, 6))], format="csr")
    time_s = np.arange(float(SECONDS))
    made = whitened("position", -error_m, matrix, time_s, np.tile(SIGMA_M, (SECONDS, 1)), TAU_S, 0.01, Errors.ANCHOR)
    sigma = made.sigma * np.tile([weakened, weakened, 1.0], SECONDS)
    course = Factor(
        made.name, made.residual, made.matrix, sigma, errors=made.errors, source="fixes", course=True, weakened=weakened
    )
    held_m = np.concatenate([np.tile(np.where(loose, 100.0, 0.01), SECONDS), np.ones(6)])
    by_row = sparse.diags(1.0 / course.sigma) @ course.matrix
    normal = (by_row.T @ by_row).toarray() + np.diag(held_m**-2.0)
    factor = cho_factor(normal)
    coarse = Coarse(np.zeros((unknowns, 6)), sparse.identity(unknowns, format="csr"), factor)
    x = -coarse.solve(by_row.T @ (course.residual / course.sigma))
    found = strains([course], x, coarse, {SLID: 3.0})["fixes"]
    assert not strains([course], x, coarse, {SLID: 6.5})  # the path slides away: it may be the one that is wrong
    mean = Factor("position mean", np.zeros(3), matrix[:3], np.ones(3), source="fixes")
    np.testing.assert_array_equal(of_source({"fixes": found}, mean), found)
    assert found[0] == found[1]  # one receiver in plan
    return found


@pytest.mark.parametrize("loose", [(False, False, False), (True, False, False), (True, True, True)])
def test_an_honest_receiver_is_believed_whatever_holds_the_path(loose: tuple[bool, bool, bool]) -> None:
    rng = np.random.default_rng(1)
    found = np.array([judged(receiver(rng, np.ones(3)), loose) for _ in range(DRAWS)])
    assert found.min() == 1.0
    assert (found.mean(axis=0) < 1.15).all()


def test_a_receiver_three_times_worse_than_stated_is_found_where_one_direction_is_held() -> None:
    """Along a street too, whose path follows the fixes: across it they show what they are worth."""
    rng = np.random.default_rng(2)
    worse = np.array([3.0, 3.0, 1.0])
    for loose in ((False, False, False), (True, False, False)):
        found = np.array([judged(receiver(rng, worse), loose) for _ in range(DRAWS)])
        assert 2.0 < found[:, 0].mean() < 3.0
        assert found[:, 2].mean() < 1.15


def test_errors_that_the_path_follows_show_nothing() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        assert (judged(receiver(rng, np.full(3, 5.0)), (True, True, True)) == 1.0).all()


def test_rows_that_are_weakened_already_are_judged_by_what_is_stated() -> None:
    """Three times worse, and the weights of the course know of two of these three: the mean errs by all of it, the course by the rest."""
    rng = np.random.default_rng(5)
    for _ in range(10):
        error_m = receiver(rng, np.array([3.0, 3.0, 1.0]))
        found = judged(error_m, (False, False, False))
        np.testing.assert_allclose(judged(error_m, (False, False, False), weakened=2.0), found, rtol=0.01)
    course = Factor("position", np.zeros(6), sparse.eye(6, format="csr"), np.ones(6), source="fixes", weakened=2.0)
    np.testing.assert_array_equal(of_source({"fixes": np.array([3.0, 1.5, 1.2])}, course), [1.5, 1.0, 1.2] * 2)


def test_a_walk_of_metres_shows() -> None:
    """8 m in 36 s, where 3 m are stated that last a minute."""
    rng = np.random.default_rng(4)
    walk = 8.0 * np.clip((np.arange(SECONDS) - 9.0) / 36.0, 0.0, 1.0)[:, None] * np.array([0.8, 0.6, 0.0])
    found = np.array([judged(receiver(rng, np.full(3, 0.7)) + walk, (False, False, False)) for _ in range(DRAWS)])
    assert 1.25 < found[:, 0].mean() < 2.0
