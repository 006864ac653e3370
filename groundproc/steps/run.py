"""What the steps of one run share: the logs, opened once, and the flight in them, read when a step first asks for it."""

import contextlib
import functools
import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.estimation.method import Progress
from groundproc.flight.belonging import in_order_of_one_flight
from groundproc.flight.flight import Flight, read_flight
from groundproc.flight.mounting import find_mount
from groundproc.flight.pairing import legs
from groundproc.flight.timeline import Leg
from groundproc.steps.request import Request
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate, read_estimate

if TYPE_CHECKING:
    from groundproc.reporting.cloudpart import Foreseen


class Run:
    """One run of some steps.

    Parameters
    ----------
    request : Request
    folder : Path
        Where the outputs of finished steps lie.
    progress : Progress
    whole : bool
        Whether all steps are brought up to date.

    Attributes
    ----------
    foreseen : Foreseen or None
        What the report will ask of the cloud, read by an earlier step.
    """

    def __init__(self, request: Request, folder: Path, progress: Progress, whole: bool = False) -> None:
        self.request = request
        self.folder = folder
        self.progress = progress
        self.whole = whole
        self.foreseen: Foreseen | None = None
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def survey(self) -> Survey:
        """What the user chose."""
        return self.request.survey

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the logs."""
        return tuple(path.name for path in self.request.logs)

    @cached_property
    def readers(self) -> Sequence[LogReader]:
        """The logs, in order of time; those of several flights are refused."""
        readers = [self._stack.enter_context(LogReader(path)) for path in self.request.logs]
        return in_order_of_one_flight(readers, self.survey.mount)

    def torn(self) -> str:
        """Which logs are cut off, in words: where a step fails, that may be why."""
        torn = [reader.path for reader in self.__dict__.get("readers", ()) if reader.damage.truncated]
        return "; ".join(
            f"{path} is cut off: `swath recover {shlex.quote(str(path))}` saves what is left" for path in torn
        )

    @cached_property
    def mount_and_source(self) -> tuple[Mount, str]:
        """The nominal mount, and where it comes from."""
        return find_mount(self.survey.mount, self.readers)

    @cached_property
    def flight(self) -> Flight:
        """Autopilot, gyros and clocks of the flight."""
        flight = read_flight(self.readers, "ins", functools.partial(self.progress, "read"))
        late_ms = self.survey.gyro_delay_ms
        return replace(flight, runs=[each.less_delay(late_ms) for each in flight.runs])

    @cached_property
    def timeline(self) -> Sequence[Leg]:
        """The flight's clocks on one scale."""
        mount, _ = self.mount_and_source
        return legs(self.flight.runs, self.flight.boots, mount.mat_ins_lidar(), self.survey.sync)

    @cached_property
    def estimate(self) -> Estimate:
        """What step trajectory left, read from its files: a run that goes on places the points with the same as one that never stopped."""
        return read_estimate(self.folder)
