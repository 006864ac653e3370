"""Clouds of several flights in one: `point_source_id` numbers their flight lines, and a table says which is whose."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt

from flightlog.clock import utc_text
from flightlog.errors import CaptureError
from groundproc.cloud import reader
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.merger import Merger
from groundproc.cloud.reader import Cloud

_LAST: Final = 65535
_USER, _NUMBER = "swath", 1


@dataclass(slots=True)
class Line:
    """One flight line of the merged cloud.

    Attributes
    ----------
    number : int
        `point_source_id` in the merged cloud.
    file : str
    was : int
        `point_source_id` in that file.
    points : int
    first_ns, last_ns : int or None
        UTC of its earliest and latest point, where times tell.
    """

    number: int
    file: str
    was: int
    points: int = 0
    first_ns: int | None = None
    last_ns: int | None = None

    def count(self, time_ns: npt.NDArray[np.int64] | None, points: int) -> None:
        """Take points into account."""
        self.points += points
        if time_ns is not None:
            low, high = int(time_ns.min()), int(time_ns.max())
            self.first_ns = low if self.first_ns is None else min(self.first_ns, low)
            self.last_ns = high if self.last_ns is None else max(self.last_ns, high)

    def tell(self) -> dict[str, Any]:
        """For JSON."""
        told: dict[str, Any] = {"id": self.number, "file": self.file, "was": self.was, "points": self.points}
        if self.first_ns is not None and self.last_ns is not None:
            told |= {"first": utc_text(self.first_ns), "last": utc_text(self.last_ns)}
        return told


class Numbering:
    """Gives the flight lines of clouds numbers that no other has, from 1, in the order in which they are met."""

    def __init__(self) -> None:
        self.lines: dict[tuple[str, int], Line] = {}

    def of(
        self, path: Path, was: npt.NDArray[np.uint16], time_ns: npt.NDArray[np.int64] | None
    ) -> npt.NDArray[np.uint16]:
        """New numbers of some points of a file, shape (n,).

        Raises
        ------
        CaptureError
            There are more lines than numbers.
        """
        found, where, counts = np.unique(was, return_inverse=True, return_counts=True)
        numbers = np.empty(len(found), np.uint16)
        for place, (each, count) in enumerate(zip(found.tolist(), counts.tolist(), strict=True)):
            line = self.lines.get((str(path), each))
            if line is None:
                if len(self.lines) == _LAST:
                    raise CaptureError(
                        f"{path}: more than {_LAST} flight lines altogether, which is what LAS has numbers for"
                    )
                line = self.lines[str(path), each] = Line(len(self.lines) + 1, str(path), each)
            line.count(None if time_ns is None else time_ns[where == place], count)
            numbers[place] = line.number
        return np.asarray(numbers[where])

    def record(self) -> laspy.VLR:
        """The table as a record of a LAS file: JSON."""
        text = json.dumps({"flight_lines": [line.tell() for line in self.lines.values()]})
        return laspy.VLR(_USER, _NUMBER, "flight lines by file", text.encode())


def merge(clouds: Sequence[Cloud], path: Path, progress: Callable[[int], object]) -> list[Line]:
    """Write the points of clouds of one CRS into one LAZ file, in their order, each with a new number of its line.

    Parameters
    ----------
    clouds : sequence of Cloud
    path : Path
        Written in place: the caller writes aside. The table is in its last record, `swath` 1, as JSON.
    progress : callable
        Told of points done.

    Raises
    ------
    CaptureError
        A cloud is damaged, has more lines than there are numbers, or an attribute of another meaning than another's.
    """
    numbering = Numbering()
    with Merger(clouds, path, ("point_source_id",)) as merged:
        for cloud in clouds:
            clock = Clock() if cloud.timed and not cloud.week_time else None
            for chunk in reader.chunks(cloud, clock, ("point_source_id",)):
                time_ns = None if clock is None else chunk.points.time_ns
                number = numbering.of(cloud.path, chunk.points["point_source_id"], time_ns)
                merged.write(chunk.record, {"point_source_id": number})
                progress(len(number))
        merged.close_with([numbering.record()])
    return list(numbering.lines.values())
