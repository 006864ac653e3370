"""What rows really tell: the relief of the ground as much as all else, and no more."""

import numpy as np
import numpy.typing as npt

from groundproc.estimation.observations.told import shares_of_relief
from groundproc.estimation.odometry.matching import RELIEF

Array = npt.NDArray[np.float64]


def some(rng: np.random.Generator, count: int) -> Array:
    """Information of a few rows."""
    rows = rng.normal(size=(count, 30, 6)) * rng.uniform(0.1, 30.0, (count, 1, 6))
    return np.asarray(np.swapaxes(rows, 1, 2) @ rows)


def test_in_no_direction_the_relief_tells_more_than_all_else() -> None:
    rng = np.random.default_rng(1)
    base, relief = some(rng, 50), 1e3 * some(rng, 50)
    share = shares_of_relief(base, relief)
    kept = np.swapaxes(share, 1, 2) @ relief @ share
    for all_else, ours in zip(base, kept, strict=True):
        root = np.linalg.inv(np.linalg.cholesky(all_else))
        assert np.linalg.eigvalsh(root @ ours @ root.T).max() <= RELIEF * (1.0 + 1e-6)


def test_relief_that_tells_little_is_taken_as_it_is() -> None:
    rng = np.random.default_rng(2)
    base, relief = some(rng, 20), 1e-6 * some(rng, 20)
    share = shares_of_relief(base, relief)
    kept = np.swapaxes(share, 1, 2) @ relief @ share
    np.testing.assert_allclose(kept, relief, rtol=1e-6, atol=1e-9 * np.abs(relief).max())


def test_where_nothing_else_tells_anything_relief_tells_nothing() -> None:
    base = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 1e4])[None]
    relief = 1e4 * np.eye(6)[None]
    share = shares_of_relief(base, relief)
    kept = (np.swapaxes(share, 1, 2) @ relief @ share)[0]
    assert np.abs(kept[:5, :5]).max() < 1e-2
