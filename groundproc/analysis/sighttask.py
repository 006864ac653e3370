"""What is asked of lines of sight, and the places along a path to look from."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyproj
import shapely

from flightlog.errors import UsageError
from groundproc.cloud import reader
from groundproc.cloud.metres import Metres
from groundproc.numerics.lonely import LEAST_SIDE_M, Lonely
from groundproc.vectors.features import read_features

VOXELS: Final = "voxels"
"""The mode that looks through vegetation; the others look over a surface."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for.

    Attributes
    ----------
    source : Path
        A raster of heights, or a cloud.
    output : Path
    at_m : tuple of 2 floats or None
        Easting and northing.
    path : Path or None
        Lines to look from, in place of one place.
    step_m : float
        Between the places along a line.
    height_m, target_m : float
        Observer and targets over the surface.
    mode : str
    reverse : bool
        What sees the place, in place of what is seen from it: observers stand on the cells.
    curved : bool
        Earth and refraction.
    cell_m : float or None
        For clouds.
    trajectory : Path or None
        Of a cloud, for voxels: then rays are those of the flight.
    """

    source: Path
    output: Path
    at_m: tuple[float, float] | None
    path: Path | None
    step_m: float
    height_m: float
    target_m: float
    mode: str
    reverse: bool
    curved: bool
    cell_m: float | None
    trajectory: Path | None = None


def accompanied(cloud: reader.Cloud, metres: Metres, cell_m: float, progress: Callable[[int], object]) -> Lonely:
    """Which points of a cloud are alone, as `swath ground` has it: a bird is no surface that one sees, or stands on.

    Clouds that are looked at in larger cells are sparser, and so are their points.
    """
    found = Lonely(max(LEAST_SIDE_M, 2.0 * cell_m))
    for chunk in reader.chunks(cloud, columns=()):
        found.add(metres.of(chunk.points.xyz_m))
        progress(len(chunk.points))
    found.widen()
    return found


def alone(source: Path, strays: int) -> list[str]:
    """What is said of points that were left out."""
    return (
        [f"{source}: {strays:,} points that are alone hide nothing, and nobody stands on them: birds, noise"]
        if strays
        else []
    )


def along(task: Task, crs: pyproj.CRS | None) -> list[tuple[float, float]]:
    """Places along the lines of a file, and their ends."""
    assert task.path is not None
    if not task.step_m > 0.0:
        raise UsageError(f"--step {task.step_m:g} m: expected more than 0")
    features = read_features(task.path, "LineString")
    if crs is not None:
        features = features.into(crs)
    found = []
    for line in features.geometry:
        count = max(int(np.ceil(line.length / task.step_m)), 1)
        for share in np.linspace(0.0, 1.0, count + 1):
            point = shapely.line_interpolate_point(line, share, normalized=True)
            found.append((float(point.x), float(point.y)))
    return found
