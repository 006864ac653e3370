"""Which fixes agree on the way between them."""

import numpy as np

from groundproc.estimation.consensus import Steps, agreeing


def test_a_walk_in_half_an_hour_is_found_without_a_warning() -> None:
    """Errors that last for seconds: what would be looked back on does not exist at the beginning, and is not taken from the end."""
    time_s = np.arange(1800.0)
    rng = np.random.default_rng(1)
    off_m = rng.normal(0.0, 0.1, (1800, 2))
    off_m[900:940] += 30.0
    steps = Steps(np.full((1800, 2), 0.5), np.full(2, 1.5), np.zeros(1800), np.zeros((1800, 1)))
    kept = agreeing(time_s, off_m, steps)
    assert not kept[900:940].any()
    assert kept[:900].all()
    assert kept[940:].all()
