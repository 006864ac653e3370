"""What cross-axis sensitivities say of a gyro's axes on their board: drawn triads, read on the axes of a sensor that is mounted askew."""

import numpy as np
import numpy.typing as npt
import pytest

from flightlog.mount import Mount
from groundproc.estimation.adjustment.skew import MISALIGNMENT_RAD, misalignment_rad

Array = npt.NDArray[np.float64]
MAT = Mount().with_lidar(yaw_deg=30.0, pitch_deg=-20.0, roll_deg=5.0).mat_ins_lidar()
KNOWN = np.full(3, 5e-4)


def found(gain: Array, sigma: Array = KNOWN) -> float:
    """Sigma of the turn, of a triad that reads so on its own axes, shape (3, 3)."""
    seen = MAT.T @ gain @ MAT
    shear = np.array([seen[1, 2], seen[2, 0], seen[0, 1]])
    return misalignment_rad({"ins.scale": (np.diag(seen), KNOWN), "ins.shear": (shear, sigma)}, MAT)


def test_scales_alone_are_no_skew() -> None:
    """On the sensor's axes 3 % and -3 % are 1 % of shear."""
    assert found(np.diag([0.03, -0.03, 0.01])) == MISALIGNMENT_RAD
    assert found(np.zeros((3, 3))) == MISALIGNMENT_RAD


def test_what_is_not_known_says_nothing() -> None:
    assert misalignment_rad({}, MAT) == MISALIGNMENT_RAD
    assert found(np.full((3, 3), 0.02) - 0.02 * np.eye(3), np.full(3, 0.01)) == MISALIGNMENT_RAD


@pytest.mark.parametrize(("times", "least", "most"), [(1.0, 0.8, 1.2), (3.0, 1.0, 4.0)])
def test_turns_of_drawn_triads_are_as_stated(times: float, least: float, most: float) -> None:
    """Of the class, and of one three times worse: squares of the turns over those stated, over 2000 triads (nine by the class alone)."""
    rng = np.random.default_rng(1)
    square = []
    for _ in range(2000):
        tilt = np.sqrt(2.0) * times * MISALIGNMENT_RAD * rng.standard_normal((3, 3))
        np.fill_diagonal(tilt, 0.0)
        stated = found(0.5 * (tilt + tilt.T))
        turn = 0.5 * np.array([tilt[2, 1] - tilt[1, 2], tilt[0, 2] - tilt[2, 0], tilt[1, 0] - tilt[0, 1]])
        square.append(np.square(turn / stated).mean())
    assert least < np.mean(square) < most
