"""A slice through a cloud: the points near a line, as they were, with their way along it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError, UsageError
from groundproc.cloud import reader
from groundproc.cloud.rewriter import Rewriter
from groundproc.files import written_aside

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Made:
    """What a section holds."""

    points: int
    of: int
    length_m: float
    lowest_m: float
    highest_m: float


def section(
    path: Path, output: Path, line_m: Sequence[float], width_m: float, progress: Callable[[int], object]
) -> Made:
    """Write the points within half a width of a line, beyond its ends none.

    Every point comes out as it was, in its order, with `along`: metres from the line's beginning.

    Parameters
    ----------
    path, output : Path
    line_m : sequence of 4 floats
        Easting and northing of the ends.
    width_m : float
    progress : callable
        Told of points done.

    Raises
    ------
    UsageError
        The line has no length, or the slice no width.
    CoverageError
        No point is there.
    """
    start, end = np.array(line_m[:2], np.float64), np.array(line_m[2:], np.float64)
    length = float(np.linalg.norm(end - start))
    if not (length > 0.0 and width_m > 0.0):
        raise UsageError(f"a line of {length:g} m and a width of {width_m:g} m: expected more than 0 of both")
    cloud = reader.look(path)
    ahead = (end - start) / length
    kept, low, high = 0, np.inf, -np.inf
    bounds = [np.full(2, np.inf), np.full(2, -np.inf)]
    with written_aside(output) as aside:
        with Rewriter(cloud, aside, output.suffix.lower() != ".las", ("along",)) as new:
            for chunk in reader.chunks(cloud, columns=()):
                away = chunk.points.xyz_m[:, :2] - start
                along, across = away @ ahead, away @ np.array([-ahead[1], ahead[0]])
                inside = (along >= 0.0) & (along <= length) & (np.abs(across) <= width_m / 2.0)
                xyz = chunk.points.xyz_m
                bounds = [np.minimum(bounds[0], xyz[:, :2].min(axis=0)), np.maximum(bounds[1], xyz[:, :2].max(axis=0))]
                if inside.any():
                    kept += int(inside.sum())
                    low, high = min(low, float(xyz[inside, 2].min())), max(high, float(xyz[inside, 2].max()))
                    new.write(chunk.record[inside], columns={"along": along[inside]})
                progress(len(inside))
        if not kept:
            raise CoverageError(
                f"{path}: no point lies within {width_m / 2:g} m of the line; its points span {bounds[0][0]:.2f} to {bounds[1][0]:.2f} E "
                f"and {bounds[0][1]:.2f} to {bounds[1][1]:.2f} N"
            )
    return Made(kept, cloud.points, length, low, high)
