"""Points of a processed flight beside their true echoes: the simulator says where each shot was answered."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog.logfile import LogReader
from groundproc.accuracy.truth import Truth, read_truth, shot_numbers
from groundproc.cloud import attributes, placing
from groundproc.cloud.points import Points
from groundproc.flight.flight import read_flight
from groundproc.flight.lidar import lidar_of
from groundproc.flight.pairing import legs
from groundproc.flight.shots import Tally, shots
from groundproc.flight.timeline import Leg, tied
from groundproc.sensors.shots import Gate
from groundproc.steps.place import mount_errors
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate, read_estimate

Array = npt.NDArray[np.float64]
GATE = Gate(255.0, 105.0, 1.0, 100.0)


@dataclass(frozen=True)
class Compared:
    """Points of a flight that have a true echo.

    `points` are in the frame of the truth; `error_m` is point less true echo; `echo` are the truth's records.
    """

    points: Points
    error_m: Array
    echo: npt.NDArray[np.void]
    truth: Truth


def compared(
    simulated: Path, estimate: Estimate | Path, names: frozenset[str] | None = None, survey: Survey | None = None
) -> Compared:
    """Place the points of a simulated flight with an estimate, find what is said of them, and put them beside the truth."""
    made = read_estimate(estimate) if isinstance(estimate, Path) else estimate
    truth = read_truth(simulated)
    with LogReader(simulated / "flight.mcap") as reader:
        flight = read_flight([reader], "ins")
        timeline = legs(flight.runs, flight.boots, made.mount.mat_ins_lidar(), "auto")
        timeline = tied(timeline, made.ties) if made.ties else timeline
        lidar = lidar_of([reader])
        lasers = made.corrections.table(lidar.lasers)

        def stream() -> Iterator[Points]:
            return placing.placed(shots([reader], timeline, GATE, lasers, Tally()), made.trajectory, made.mount)

        scene = attributes.Scene(made.trajectory, made.mount, mount_errors(made, survey or Survey()), lidar.ranging)
        wanted = attributes.wanted(None) if names is None else names
        pieces = [_copied(points) for points in attributes.described(stream, scene, wanted) if len(points)]
    points = joined(pieces)
    return _beside(points, made, truth, timeline)


def _copied(points: Points) -> Points:
    """What is lent from a pool is used again."""
    return Points(
        points.time_ns.copy(), points.xyz_m.copy(), {name: values.copy() for name, values in points.columns.items()}
    )


def joined(pieces: list[Points]) -> Points:
    columns: dict[str, npt.NDArray[Any]] = {
        name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0].columns
    }
    return Points(
        np.concatenate([piece.time_ns for piece in pieces]), np.concatenate([piece.xyz_m for piece in pieces]), columns
    )


def _beside(points: Points, made: Estimate, truth: Truth, timeline: list[Leg] | Any) -> Compared:
    time_ns = points.time_ns
    for line in reversed(timeline[0].lidar_line):
        time_ns = line.inverse()(time_ns)
    numbers = shot_numbers(
        truth.from_device_ns(time_ns), points["laser"], points["return_number"] - 1, truth.lidar.start_ns
    )
    echoes, known = truth.hits().until(np.iinfo(np.int64).max)
    at = np.minimum(np.searchsorted(known, numbers), len(known) - 1)
    same = (known[at] == numbers) & (np.abs(echoes["range_m"][at] - points["range"]) < 0.5)
    geodetic = made.trajectory.frame.to_geodetic(points.xyz_m)
    place = truth.frame.from_geodetic(*geodetic)
    points = Points(points.time_ns, place, points.columns).masked(same)
    echo = echoes[at[same]]
    true_m = np.stack([echo["x"], echo["y"], echo["z"]], axis=1)
    return Compared(points, points.xyz_m - true_m, echo, truth)


def shares(found: Compared, chosen: npt.NDArray[np.bool_]) -> dict[int, tuple[float, float]]:
    """Share of the errors within 1 and 2 sigma: horizontal axes, height."""
    error, points = np.abs(found.error_m[chosen]), found.points.masked(chosen)
    within = {}
    for times in (1, 2):
        horizontal = error[:, :2] <= times * points["sigma_h"][:, None]
        within[times] = (float(horizontal.mean()), float((error[:, 2] <= times * points["sigma_v"]).mean()))
    return within


def sizes(found: Compared, chosen: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Errors in their sigmas, RMS: horizontal axes, height."""
    points = found.points.masked(chosen)
    sigma_m = np.stack([points["sigma_h"], points["sigma_h"], points["sigma_v"]], axis=1)
    square = np.square(found.error_m[chosen] / sigma_m).mean(axis=0)
    return float(np.sqrt(square[:2].mean())), float(np.sqrt(square[2]))
