"""From a log and a list of panels to figures, a verdict and a picture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flightlog.errors import CoverageError
from groundproc.files import written_aside
from groundproc.verification import plot
from groundproc.verification.aimed import read_aimed
from groundproc.verification.judge import Judged, judge
from groundproc.verification.measure import Measured, measure
from groundproc.verification.panels import read_panels


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath verify-sensor`."""

    logs: Sequence[Path]
    panels: Path
    picture: Path | None = None


@dataclass(frozen=True, slots=True)
class Verified:
    """What came of it."""

    sensor: str
    shots: int
    measured: list[Measured]
    judged: Judged
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return {
            **self.judged.figures(), "sensor": self.sensor, "shots": self.shots,
            "panels": [each.figures() for each in self.measured], "warnings": self.warnings,
        }  # fmt: skip


def verify(task: Task, progress: Callable[[int], None]) -> Verified:
    """Measure the panels, and judge the sensor by them; `progress` is told of bytes of the logs.

    Raises
    ------
    ConfigError, CoverageError, LogError, WrongSensorError, SourceError
        A file is not as it should be, or no shot of the log goes where a panel is said to be.
    """
    chosen = read_panels(task.panels)
    recording = read_aimed(task.logs, chosen.panels, progress)
    found = [
        measure(panel, aimed, recording.lidar.ranging)
        for panel, aimed in zip(chosen.panels, recording.aimed, strict=True)
    ]
    if not any(each.whole.shots or np.isfinite(each.elsewhere_m) for each in found):
        raise CoverageError(
            f"{task.panels}: no shot of {task.logs[0]} goes where a panel is said to be; expected azimuth_deg clockwise from straight "
            "ahead and up_m above the sensor, in the sensor's frame"
        )
    warnings = [
        f"{each.panel.title}: no shot meets it: its place or size is wrong, or it lies between two lasers"
        for each in found
        if not each.whole.shots and not np.isfinite(each.elsewhere_m)
    ]
    warnings += [
        f"{each.panel.title}: most shots at it come back from {each.elsewhere_m:.1f} m; expected it at {each.panel.distance_m:g} m, up to "
        f"0.5 m off: its place is wrong{', or something stands in front' if each.elsewhere_m < each.panel.distance_m else ''}"
        for each in found
        if np.isfinite(each.elsewhere_m)
    ]
    if task.picture is not None:
        with written_aside(task.picture) as aside:
            plot.draw(found, chosen.sheet, aside)
    return Verified(recording.lidar.name, recording.shots, found, judge(found, chosen.sheet), warnings)
