"""The clouds of an adjustment: their CRS, their points in one stream, and their files written anew."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.cloud import reader
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.reader import Cloud
from groundproc.cloud.rewriter import Rewriter
from groundproc.cloud.selection import CLASS, standing
from groundproc.files import written_aside

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(slots=True)
class Chunk:
    """Points of one of the files, in its order.

    Attributes
    ----------
    file : int
    record : laspy.ScaleAwarePointRecord
        All that the file holds of them.
    xyz_m : ndarray, shape (n, 3)
        Map coordinates.
    time_ns : ndarray of int64, shape (n,)
        UTC.
    source : ndarray of int64, shape (n,)
        Point source id.
    stands : ndarray of bool, shape (n,)
        Of which patches are made.
    """

    file: int
    record: Any
    xyz_m: Array
    time_ns: Ints
    source: Ints
    stands: npt.NDArray[np.bool_]


def look(path: Path) -> Cloud:
    """Read a header.

    Raises
    ------
    CaptureError
        It is no LAS file, holds no point, or its points have no times.
    """
    cloud = reader.look(path)
    if not cloud.timed:
        raise CaptureError(
            f"{path}: its points have no gps_time, expected point format 1 or 3 to 10: the trajectory is tied to points by time"
        )
    return cloud


def chunks(clouds: Sequence[Cloud], clock: Clock, all_classes: bool = False) -> Iterator[Chunk]:
    """All points of all files, in their order; with `all_classes` patches are made of noise and of what moves too.

    Raises
    ------
    CaptureError
        A file is damaged, or has no times.
    """
    for number, cloud in enumerate(clouds):
        for chunk in reader.chunks(cloud, clock, ("point_source_id", CLASS)):
            points = chunk.points
            source = points["point_source_id"].astype(np.int64)
            yield Chunk(number, chunk.record, points.xyz_m, points.time_ns, source, standing(points, all_classes))


@contextlib.contextmanager
def rewriters(clouds: Sequence[Cloud], folder: Path) -> Iterator[list[Rewriter]]:
    """Writers of all files, aside; they get their names, those of the inputs with .laz, when all went well."""
    with contextlib.ExitStack() as stack:
        asides = [stack.enter_context(written_aside(folder / cloud.path.with_suffix(".laz").name)) for cloud in clouds]
        with contextlib.ExitStack() as inner:
            yield [inner.enter_context(Rewriter(cloud, aside)) for cloud, aside in zip(clouds, asides, strict=True)]
