"""The tie of a window to the one before: its first poses are those that the other ended with."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.observations.observation import Observation, State
from groundproc.estimation.observations.rows import Factor, RowBuilder, Unknowns, eye
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]


@dataclass(slots=True)
class Tie(Observation):
    """Poses of the sensor at the first knots of a path, as the window before left them.

    Attributes
    ----------
    quat : ndarray, shape (n, 4)
    position_m : ndarray, shape (n, 3)
    walk_m2 : ndarray, shape (n, 3)
        Variance that the window before gives them against the first of them, east, north, up: along a street its end may be bent by
        metres.
    """

    quat: Array
    position_m: Array
    walk_m2: Array
    name: str = "tie"

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        """Six rows for each pose."""
        return [tie_factor(self, state.path, unknowns)]


TIE_SIGMA_RAD: Final = np.deg2rad(0.03)
TIE_SIGMA_M: Final = 0.01
"""How far two windows may differ at a knot of their overlap."""


def tie_factor(given: Tie, path: Path, unknowns: Unknowns) -> Factor:
    """The path against the poses of a tie."""
    count = len(given.quat)
    quat, position = path.quat[: count * STEPS : STEPS], path.position_m[: count * STEPS : STEPS]
    residual = np.concatenate(
        [frames.quat_log(frames.quat_multiply(frames.quat_inverse(given.quat), quat)), position - given.position_m],
        axis=1,
    )
    builder, knot = RowBuilder(6 * count, unknowns), np.arange(count)
    builder.at_knots(6 * knot, knot, 0, eye(count))
    builder.at_knots(6 * knot + 3, knot, 3, eye(count))
    sigma = np.tile(np.repeat([TIE_SIGMA_RAD, TIE_SIGMA_M], 3), (count, 1))
    # what the other's end is bent by is one error of all poses: they tell no more of it than a single one
    sigma[:, 3:] = np.sqrt(sigma[:, 3:] ** 2 + count * given.walk_m2)
    return Factor("tie", residual.ravel(), builder.matrix(), sigma.ravel())
