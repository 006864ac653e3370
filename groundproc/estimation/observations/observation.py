"""What an observation is: its unknowns with priors, its rows, what it makes of a solution, and what it says of it afterwards."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Protocol

import numpy as np
import numpy.typing as npt

from groundproc.estimation.method import Given
from groundproc.estimation.observations.rows import Factor, Unknowns, turned
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.motion import ImuTrack
from groundproc.estimation.odometry.spline import Path
from groundproc.flight.timeline import Leg

Array = npt.NDArray[np.float64]

BORESIGHT: Final = "ins.turn"
"""The global that corrects the nominal boresight: who states attitudes of the airframe shares it with the autopilot's gyro."""


@dataclass(frozen=True, slots=True)
class Flown:
    """What the observations of one run of the lidar's clock are made from.

    Attributes
    ----------
    given : Given
    legs : sequence of Leg
        Those of the run.
    units : mapping of str to ImuTrack
        "lidar", "ins" or both; the first carries the motion between knots.
    """

    given: Given
    legs: Sequence[Leg]
    units: Mapping[str, ImuTrack]

    @property
    def mat_ins_lidar(self) -> Array:
        """Nominal boresight, shape (3, 3)."""
        return self.given.mount.mat_ins_lidar()

    def in_sensor(self, place_m: Array) -> Array:
        """Where a place of the ins frame sits in the sensor frame by the nominal mount [m], shape (3,)."""
        return np.asarray(self.mat_ins_lidar.T @ (place_m - self.given.mount.lidar_position_m()))


@dataclass(frozen=True, slots=True)
class Stretch:
    """A window of the flight that is about to be adjusted.

    Attributes
    ----------
    path : Path
        To begin with.
    carried_by : str
        Name of the `ImuTrack` that the odometry went by.
    bias_rad_s : ndarray, shape (3,)
        Of that gyro, as the odometry has it.
    whole : bool
        The window is the whole flight: nothing is joined afterwards.
    unheld_m : ndarray, shape (slices,), optional
        How well each slice of the lidar holds the path in its least observed direction; none where it has led astray.
    held : ndarray of bool, shape (slices,), optional
        Slices in which the lidar observes every direction of the path, as far as it knows.
    """

    path: Path
    carried_by: str
    bias_rad_s: Array
    whole: bool
    unheld_m: Array | None = None
    held: npt.NDArray[np.bool_] | None = None


@dataclass(frozen=True, slots=True)
class State:
    """What the observations of a step share.

    Attributes
    ----------
    path : Path
        What the step is linear about.
    clusters : Clusters
        What the lidar saw.
    mat_sensor_ins : ndarray, shape (3, 3)
        Boresight before the global `BORESIGHT`.
    learn : bool
        Noise is to be learnt from the residuals now: once, after the first step.
    spin_rad : ndarray, shape (intervals + 1, 3), optional
        What the path has at its knots that its carrying gyro has not: the line of the spin.
    """

    path: Path
    clusters: Clusters
    mat_sensor_ins: Array
    learn: bool = False
    spin_rad: Array | None = None

    def boresight(self, unknowns: Unknowns) -> tuple[Array, str | None]:
        """Sensor from ins as estimated so far, shape (3, 3), and the global that corrects it where it is an unknown."""
        if BORESIGHT not in unknowns.names:
            return self.mat_sensor_ins, None
        return turned(unknowns.value[BORESIGHT]) @ self.mat_sensor_ins, BORESIGHT


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a run, for those who report.

    Attributes
    ----------
    path : Path
    logs : sequence of mapping
        Figures of the last step of each window.
    told : sequence of mapping
        What the observations said at the end of each window, by their names; of the joining alone where there was one.
    misled : bool
        The trajectory is not that of the adjustment, but what it began from.
    """

    path: Path
    logs: Sequence[Mapping[str, float]]
    told: Sequence[Mapping[str, Any]]
    misled: bool

    def largest(self, figure: str) -> float:
        """Largest of a figure over the windows; 0 where none has it."""
        return max((log.get(figure, 0.0) for log in self.logs), default=0.0)


class Observation(Protocol):
    """One source of knowledge about the path; only `name` and `factors` have to be there.

    Attributes
    ----------
    name : str
        Of this one; prefix of its own globals.
    leads : bool
        Class constant: where the lidar sees nothing, this is better than what the adjustment began from.
    """

    name: str
    leads: ClassVar[bool] = False

    # a window, and the joining of windows ----------------------------------------------------------------------------------

    def begin(self, stretch: Stretch) -> "Observation":
        """The same with nothing estimated yet, for a window."""
        del stretch
        return copy.copy(self)

    def joined(self, values: Mapping[str, Array], kept: Sequence[Any]) -> "Observation | None":
        """The same for the joining of windows; None where the windows' own shapes have all of it.

        Parameters
        ----------
        values : mapping of str to ndarray
            Globals as the windows found them.
        kept : sequence
            What `keep` gave for each window.
        """
        del values, kept
        return copy.copy(self)

    # a step ------------------------------------------------------------------------------------------------------------------

    def unknowns(self, unknowns: Unknowns) -> None:
        """Add its own globals, with what they are so far and what was known of them before."""
        del unknowns

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        """Its rows, linear about the state; their weights are robust where single values may be wrong."""
        ...

    def take(self, part: Mapping[str, Array], path: Path) -> None:
        """Put a solution in: corrections of the globals by name, and the path as corrected."""
        del part, path

    def figures(self, factors: Sequence[Factor]) -> dict[str, float]:
        """What the log of a step says of its rows."""
        return {f"{factor.name}_rms": factor.rms() for factor in factors}

    # the whole ---------------------------------------------------------------------------------------------------------------

    def lay(self, state: State) -> Path:
        """The path that a window is to begin with, where this one knows better."""
        return state.path

    def hold(self, state: State, covariance: Callable[[], Array]) -> Path | None:
        """The path, right in itself, laid as a whole where it belongs, to be adjusted once more; None where it stays.

        `covariance` makes that of its turn about the origin and its shift, shape (6, 6).
        """
        del state, covariance
        return None

    # what is said ------------------------------------------------------------------------------------------------------------

    def keep(self, state: State, frame: Path) -> Any:
        """What the joining will need of a window that has been adjusted; `frame` is its coarse path, which the joining corrects."""
        del state, frame
        return None

    def tell(self, state: State) -> Any:
        """What is to be remembered of the end of a window, for `report` and `warnings`; None where nothing is."""
        del state
        return None

    def report(self, outcome: Outcome) -> dict[str, Any]:
        """What stands in quality.json; lists of several observations under one name are put together."""
        del outcome
        return {}

    def warnings(self, outcome: Outcome) -> list[str]:
        """What the self-check found, a sentence each."""
        del outcome
        return []
