"""What every method of making a trajectory is given, and what it gives back."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc import geodesy
from groundproc.estimation import ins
from groundproc.estimation.ins import PositionFixes
from groundproc.flight.flight import Flight
from groundproc.flight.timeline import Leg
from groundproc.geodesy import LocalFrame
from groundproc.sensors.lasers import ESTIMATE, read_lasers
from groundproc.sensors.model import Lidar
from groundproc.sensors.shots import LaserTable
from groundproc.survey import Survey
from groundproc.trajectory.trajectory import Trajectory

Progress = Callable[[str, int], None]
"""Is told that so many more bytes of the logs are through a stage: "read", "adjust" or "place"."""


@dataclass(frozen=True, slots=True)
class Given:
    """A flight, its clocks on one scale, and what the user chose.

    Attributes
    ----------
    readers : sequence of LogReader
        In order of time.
    flight : Flight
    timeline : sequence of Leg
        All legs; points are placed in these.
    placed : sequence of Leg
        Those whose boot ever knew where it was, or the first where none did.
    fixes : sequence of PositionFixes
        Of each placed leg, with heights as asked for.
    frame : LocalFrame
        Its origin is the first fix.
    mount : Mount
        Nominal.
    survey : Survey
    lidar : Lidar
    lasers : LaserTable
        Of the survey's file; the manual's where it names none.
    """

    readers: Sequence[LogReader]
    flight: Flight
    timeline: Sequence[Leg]
    placed: Sequence[Leg]
    fixes: Sequence[PositionFixes]
    frame: LocalFrame
    mount: Mount
    survey: Survey
    lidar: Lidar
    lasers: LaserTable


@dataclass(frozen=True, slots=True)
class Estimate:
    """A trajectory, and all that was estimated with it.

    Attributes
    ----------
    trajectory : Trajectory
    mount : Mount
        The one to place points with: the nominal one where the method estimates none.
    sigma_source : str
        What the trajectory's sigmas are, for the reader of quality.json.
    lasers : LaserTable or None
        Corrections of the single lasers; None: those of the survey.
    report : dict
        What else there is to say; stands in quality.json under the method's name.
    warning : str
        One sentence where the self-check found something wrong; empty where all is well.
    products : tuple of callable
        Each is called with the folder of the products and writes files of the method's own into it.
    method : str
        Name of the method that made it.
    note : str
        Why it is this method and not a better one; empty where it is the one that was asked for.
    """

    trajectory: Trajectory
    mount: Mount
    sigma_source: str
    lasers: LaserTable | None = None
    report: dict[str, Any] = field(default_factory=dict)
    warning: str = ""
    products: tuple[Callable[[Path], None], ...] = ()
    method: str = ""
    note: str = ""


def gather(
    readers: Sequence[LogReader], flight: Flight, timeline: Sequence[Leg], mount: Mount, survey: Survey
) -> Given:
    """Positions of all legs in one local frame.

    Raises
    ------
    LogError
        No positions, or heights that are not of the kind asked for.
    """
    # where none has a fix, the first boot says what is missing
    placed = [leg for leg in timeline if ins.has_position(leg.boot)] or list(timeline[:1])
    undulation_m = None
    if survey.geoid is not None:
        place = ins.position_fixes(placed[0].boot, "msl")
        undulation_m = geodesy.undulation(survey.geoid, float(place.latitude_deg[0]), float(place.longitude_deg[0]))
    fixes = [ins.position_fixes(leg.boot, survey.height, undulation_m) for leg in placed]
    first = fixes[0]
    frame = LocalFrame(float(first.latitude_deg[0]), float(first.longitude_deg[0]), float(first.height_m[0]))
    lidar = flight.lidar
    return Given(
        readers, flight, timeline, placed, fixes, frame, mount, survey, lidar, chosen_table(survey, lidar.lasers)
    )


def chosen_table(survey: Survey, nominal: LaserTable) -> LaserTable:
    """The lasers as the survey has them: of its file, or the manual's, to begin with where they are to be estimated."""
    if survey.lasers is None or survey.lasers == ESTIMATE:
        return nominal
    return read_lasers(Path(survey.lasers)).table(nominal, survey.lasers)
