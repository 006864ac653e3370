"""What a use is told of the flight, and what it gives back."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate


@dataclass(frozen=True, slots=True)
class Site:
    """A finished flight.

    Attributes
    ----------
    folder : Path
        To write into.
    cloud : Path
        Its points.
    trajectory : Path
        trajectory.csv.
    estimate : Estimate
    survey : Survey
    progress : callable
        Told of points done.
    """

    folder: Path
    cloud: Path
    trajectory: Path
    estimate: Estimate
    survey: Survey
    progress: Callable[[int], object]


@dataclass(frozen=True, slots=True)
class Told:
    """What a use found.

    Attributes
    ----------
    sentence : str
        For people.
    figures : mapping
        For JSON; what stands under `warnings` is said to the user.
    """

    sentence: str
    figures: Mapping[str, Any]
