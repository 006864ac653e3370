"""What a method of making a trajectory is, and what it is given; it gives an Estimate back (`trajectory.estimate`)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc import geodesy
from groundproc.estimation import ownsolution
from groundproc.estimation.ownsolution import PositionFixes
from groundproc.flight.flight import Flight
from groundproc.flight.timeline import Leg
from groundproc.geodesy import LocalFrame
from groundproc.sensors.lasers import ESTIMATE, LaserCorrections, read_lasers
from groundproc.sensors.model import Lidar
from groundproc.sensors.shots import LaserTable
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate

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
    corrections : LaserCorrections
        Of the lasers: of the survey's file; none where it names none.
    mount_source : str
        Where the mount comes from: "log", "survey" or a file.
    """

    readers: Sequence[LogReader]
    flight: Flight
    timeline: Sequence[Leg]
    placed: Sequence[Leg]
    fixes: Sequence[PositionFixes]
    frame: LocalFrame
    mount: Mount
    survey: Survey
    corrections: LaserCorrections = field(default_factory=LaserCorrections)
    mount_source: str = "as given"

    @property
    def lidar(self) -> Lidar:
        """The lidar that was flown."""
        return self.flight.lidar

    @property
    def lasers(self) -> LaserTable:
        """The lasers to begin with: the manual's table with the corrections."""
        return self.corrections.table(self.lidar.lasers)


@dataclass(frozen=True, slots=True)
class Method:
    """A way of making a trajectory; each stands in its own module, under the name METHOD.

    Attributes
    ----------
    estimate : callable
        Makes the estimate; LogError or CoverageError where the log does not hold what the method needs.
    options : tuple of str
        Options of the survey that not every method looks at, and this one does.
    finds_lasers : bool
        Whether it finds corrections of the single lasers where it is asked to.
    uses_points : bool
        Whether it looks at the lidar's returns, and so at which of them are kept.
    """

    estimate: Callable[[Given, Progress], Estimate]
    options: tuple[str, ...] = ()
    finds_lasers: bool = False
    uses_points: bool = False


def gather(
    readers: Sequence[LogReader],
    flight: Flight,
    timeline: Sequence[Leg],
    mount: Mount,
    survey: Survey,
    mount_source: str = "as given",
) -> Given:
    """Positions of all legs in one local frame.

    Raises
    ------
    LogError
        No positions, or heights that are not of the kind asked for.
    """
    # where none has a fix, the first boot says what is missing
    placed = [leg for leg in timeline if ownsolution.has_position(leg.boot)] or list(timeline[:1])
    undulation_m = None
    if survey.geoid is not None:
        place = ownsolution.position_fixes(placed[0].boot, "msl")
        undulation_m = geodesy.undulation(survey.geoid, float(place.latitude_deg[0]), float(place.longitude_deg[0]))
    fixes = [ownsolution.position_fixes(leg.boot, survey.height, undulation_m) for leg in placed]
    first = fixes[0]
    frame = LocalFrame(float(first.latitude_deg[0]), float(first.longitude_deg[0]), float(first.height_m[0]))
    corrections = chosen_corrections(survey)
    return Given(readers, flight, timeline, placed, fixes, frame, mount, survey, corrections, mount_source)


def chosen_corrections(survey: Survey) -> LaserCorrections:
    """Those of the lasers that the survey names; none to begin with where they are to be estimated."""
    return LaserCorrections() if survey.lasers in (None, ESTIMATE) else read_lasers(Path(survey.lasers))
