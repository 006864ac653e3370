"""Steps of the batch that swing about where they lead."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.estimation.adjustment.batch import Batch

Array = npt.NDArray[np.float64]
UP_TO = 8
"""Steps of a window from the third on."""


def left(gain: Array) -> Array:
    """What is left of two bends of a path, one metre each, if a step asks for so many times of what each is off."""
    nothing: Any = None
    batch = Batch(nothing, nothing, [], np.eye(3))
    shape = np.stack([np.linspace(-1.0, 1.0, 50), np.cos(np.linspace(0.0, np.pi, 50))])
    off = np.ones(2)
    for _ in range(UP_TO):
        asked = -gain * off
        batch._damp(np.column_stack([asked @ shape, np.zeros((50, 2))]))
        off = off + batch.share * asked
    assert 0.0 < batch.share <= 1.0
    return off


@pytest.mark.parametrize("over", [1.6, 2.3, 2.9])
def test_a_bend_that_each_step_overshoots_settles(over: float) -> None:
    """Undamped, 2.3 times what is needed leaves 1.3 times as much on the other side: 8 m after eight steps."""
    assert np.abs(left(np.array([over, over]))).max() < 0.02


def test_what_does_not_swing_is_taken_as_it_is() -> None:
    assert np.abs(left(np.array([1.0, 0.9]))).max() < 1e-6
    assert np.abs(left(np.array([1.3, 1.3]))).max() == pytest.approx(0.3**UP_TO)
