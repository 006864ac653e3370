"""Shots gathered turn by turn: a cloud from straight behind to straight behind, whatever pieces the shots come in."""

import itertools
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.ros.messages import POINT
from groundproc.sensors.shots import Shots, turns

LONGEST_NS: Final = 250_000_000
"""A turn takes 0.2 s at 300 rpm; what lasts longer is cut, so that a scanner that stands still fills no memory."""


def clouds(pieces: Iterable[Shots]) -> Iterator[tuple[int, npt.NDArray[np.void]]]:
    """Time of the first shot [ns] and points of `POINT`, axes forward, left, up, of each turn of the scanner.

    Parameters
    ----------
    pieces : iterable of Shots
        In the order of reception.
    """
    waiting: list[Shots] = []
    last_rad: float | None = None
    for shots in pieces:
        if not len(shots):
            continue
        azimuth = shots.azimuth_rad
        edges = [0, *turns(azimuth, last_rad).tolist(), len(shots)]
        last_rad = float(azimuth[-1])
        for number, (start, end) in enumerate(itertools.pairwise(edges)):
            part = shots[start:end]
            if waiting and (number or _apart(waiting, part)):
                yield _points(waiting)
                waiting = []
            if len(part):
                waiting.append(part)
    if waiting:
        yield _points(waiting)


def _apart(waiting: list[Shots], part: Shots) -> bool:
    """Whether shots would make a cloud too long, or time went back."""
    return len(part) > 0 and not 0 <= int(part.time_ns[-1]) - int(waiting[0].time_ns[0]) <= LONGEST_NS


def _points(parts: list[Shots]) -> tuple[int, npt.NDArray[np.void]]:
    # a shot of the other return, or of a laser that fires earlier, may stand behind a later one by microseconds
    first_ns = min(int(part.time_ns.min()) for part in parts)
    points = np.empty(sum(map(len, parts)), POINT)
    at = 0
    for part in parts:
        rows = points[at : at + len(part)]
        right, ahead, up = part.xyz_m.T
        rows["x"], rows["y"], rows["z"] = ahead, -right, up
        rows["intensity"] = part.intensity
        # rings count from the lowest laser
        rows["ring"] = np.argsort(np.argsort(part.lasers.elevation_rad, kind="stable"), kind="stable")[part.laser]
        rows["time"] = (part.time_ns - first_ns) * 1e-9
        at += len(part)
    return first_ns, points
