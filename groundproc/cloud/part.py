"""Part of a cloud as a cloud of its own: by time, area, flight line and class, with every field of the points that are kept."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from flightlog.errors import CoverageError
from groundproc.cloud import reader
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.reader import Cloud
from groundproc.cloud.rewriter import Rewriter
from groundproc.cloud.selection import Choice, Selection, Times
from groundproc.cloud.spans import spans_ns


def write_part(cloud: Cloud, path: Path, clock: Clock | None, progress: Callable[[int], object]) -> Mapping[str, int]:
    """Write those points of a cloud that its choices keep, as LAZ in their order; gives what each choice left out.

    Parameters
    ----------
    cloud : Cloud
    path : Path
        Written in place.
    clock : Clock, optional
        Where a choice looks at times.
    progress : callable
        Told of points done.

    Raises
    ------
    CoverageError
        Not one point is left.
    """
    selection, kept = Selection(cloud.choices), 0
    with Rewriter(cloud, path) as writer:
        for chunk in reader.chunks(cloud, clock, (), selection):
            writer.write(chunk.record)
            kept += len(chunk.record)
            progress(len(chunk.record))
    if not kept:
        told = ", ".join(f"{count:,} by {name}" for name, count in selection.left_out.items() if count)
        raise CoverageError(
            f"{cloud.path}: not one of {cloud.points:,} points is left: {told}; expected a choice that some meet"
        )
    return selection.left_out


def first_ns(cloud: Cloud, clock: Clock, progress: Callable[[int], object]) -> int:
    """UTC of the earliest point: from which seconds of the flight count in a cloud."""
    times = (chunk.points.time_ns for chunk in reader.chunks(replace(cloud, choices=()), clock, ()))
    found = np.iinfo(np.int64).max
    for time_ns in times:
        found = min(found, int(time_ns.min()))
        progress(len(time_ns))
    return found


def times_of(cloud: Cloud, texts: tuple[str, ...], clock: Clock, progress: Callable[[int], object]) -> Choice:
    """A choice by spans of time; seconds count from the earliest point, which is looked for only where there are some.

    Raises
    ------
    UsageError
        A text is no span.
    """
    probe = [spans_ns(texts, start, "--times") for start in (0, 1)]
    start = 0 if np.array_equal(probe[0], probe[1]) else first_ns(cloud, clock, progress)
    return Times("times", spans_ns(texts, start, "--times"))
