"""What the lidar sees, as an observation: planes of voxels and what fills them, and corrections of the single lasers.

Planes and fillings are solved for within. There are hundreds of thousands of rows, coupling distant parts of the
flight, so they are no `Factor`: the engine asks for them as `planes.Rows`, which are applied and never written down.
Everything else, the unknowns, the solution and the self-check, is as for the other observations.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.observations import lasers, spin
from groundproc.estimation.observations.observation import Observation, Outcome, State
from groundproc.estimation.observations.planes import Rows, rows_of
from groundproc.estimation.observations.retiming import Retiming
from groundproc.estimation.observations.rows import Factor, Unknowns
from groundproc.estimation.observations.spin import Spin
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]

DEFLATION: Final = 4.0
"""The lidar's information is divided by this: errors of neighbouring clusters are not independent. Checked by the share of errors within
two sigmas (tests)."""
MOST: Final = 1000
"""Rows of a slice on planes, at most."""
MOST_FILLED: Final = 300
"""Clusters of a slice on leaves and blades, at most: each has three rows."""
WORSE: Final = 2.0
"""Residuals so many times what their noise explains are worth a warning."""


@dataclass(slots=True)
class Lidar(Observation):
    """The clusters of a window on their planes.

    Attributes
    ----------
    clusters : Clusters
        Those of single lasers are corrected in place.
    corrections : ndarray, shape (64,)
        Of the lasers, so far; they stay 0 where the clusters have none.
    spin : Spin or None
        The rotor and its line, where the lidar's own gyro carries the motion.
    retiming : Retiming or None
        How late the gyro is that carries the motion.
    doubted : ndarray of bool, shape (intervals,), optional
        Where one direction of the way is not told for long, as the odometry has it.
    """

    clusters: Clusters
    corrections: Array = field(default_factory=lambda: np.zeros(lasers.UNKNOWNS))
    spin: Spin | None = None
    retiming: Retiming | None = None
    doubted: npt.NDArray[np.bool_] | None = None
    name: str = "lidar planes"

    def unknowns(self, unknowns: Unknowns) -> None:
        """Offsets of the lasers where they are asked for, the delay of the gyro, the line of the spin; they have to follow the path."""
        if self.clusters.laser is not None:
            count = len(lasers.NAMES)
            priors, values = np.split(lasers.PRIOR, count), np.split(self.corrections, count)
            for name, prior, value in zip(lasers.NAMES, priors, values, strict=True):
                unknowns.add(name, prior, value)
        if self.retiming is not None:
            self.retiming.unknowns(unknowns)
        if self.spin is not None:
            self.spin.unknowns(unknowns)

    def rows(self, path: Path, voxel_m: float, cut: bool) -> Rows:
        """Distances from planes, linear about a path; voxels have edges of `voxel_m`, outliers are `cut` or only weigh less."""
        turning = None if self.retiming is None else self.retiming.turning(path)
        return rows_of(
            self.clusters, path, voxel_m, MOST, cut, MOST_FILLED, self.spin is not None, turning, self.doubted
        )

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        """What is known of the line of the spin; all else is in `rows`."""
        del state
        return [] if self.spin is None else self.spin.factors(unknowns)

    def take(self, part: Mapping[str, Array], path: Path) -> None:
        """Shift what each laser saw, and know the delay and the line."""
        del path
        if self.retiming is not None:
            self.retiming.take(part)
        if self.spin is not None:
            self.spin.take(part)
        if self.clusters.laser is not None:
            offsets = np.concatenate([part[name] for name in lasers.NAMES])
            self.clusters.xyz_m = lasers.shifted(self.clusters.xyz_m, self.clusters.laser, offsets)
            self.corrections = self.corrections + offsets

    def turned(self, path: Path, part: Mapping[str, Array]) -> Path:
        """A path turned by what a solution found of the gyro's delay and of the line."""
        if self.retiming is not None:
            path = self.retiming.retimed(path, part)
        if self.spin is None:
            return path
        turn = frames.quat_exp(self.spin.turns(part[spin.NAME]))
        return replace(path, quat=frames.quat_multiply(path.quat, turn))

    def warnings(self, outcome: Outcome) -> list[str]:
        """A map that is not one."""
        return plane_warnings(outcome)


def plane_warnings(outcome: Outcome) -> list[str]:
    """One sentence where the lidar's residuals are not noise."""
    chi_square = outcome.largest("chi_square")
    if chi_square <= WORSE:
        return []
    return [
        f"the lidar's residuals are {chi_square:.1f} times what their noise explains, expected 1 or less; the cloud may be doubled"
    ]
