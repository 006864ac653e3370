"""The trajectory of a flight log, for images: the smoother's, which is quick and has covariances."""

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path

from flightlog.logfile import LogReader
from groundproc.estimation import methods
from groundproc.estimation.method import gather
from groundproc.flight.belonging import in_order_of_one_flight
from groundproc.flight.flight import read_flight
from groundproc.flight.mounting import find_mount
from groundproc.flight.pairing import legs
from groundproc.survey import Survey
from groundproc.trajectory.trajectory import Trajectory


def trajectory_of(
    log: Path, positions: Path | None, geoid: float | str | None, told: Callable[[str, int], None]
) -> Trajectory:
    """Estimate it, with better positions and the geoid between their heights and the log's where they are given.

    Raises
    ------
    SwathError
        The log cannot be read, or does not hold what the smoother needs.
    """
    survey = Survey(method="filtered", positions=None if positions is None else str(positions), geoid=geoid)
    with contextlib.ExitStack() as stack:
        readers = in_order_of_one_flight([stack.enter_context(LogReader(log))], None)
        flight = read_flight(readers, "ins", functools.partial(told, "read"))
        mount, source = find_mount(None, readers)
        timeline = legs(flight.runs, flight.boots, mount.mat_ins_lidar(), survey.sync)
        return methods.estimate(gather(readers, flight, timeline, mount, survey, source), told).trajectory
