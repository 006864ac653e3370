"""Line of sight through leaves: transmittance of voxels, from the beams that went through them.

A voxel lets through the share of beams that entered it and were not thrown back in it. Beams are those of the flight where its
trajectory is given, else vertical ones from above the cloud. Between two places the shares multiply, each to the power of the way in
its voxel over its edge. The voxels that hold the two ends are left out: what one stands on does not hide one. A voxel that no beam met is
as those beside it in its layer; where none of these was met either, nothing is known, and of no line that crosses it unless the rest of it
is closed.

One stands on the lowest point of a column, unless all around it there is lower ground: then that point is a crown, whose ground no beam
met in this column.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from flightlog.errors import CoverageError, UsageError
from groundproc.analysis.sighttask import Task, accompanied, alone, along
from groundproc.cloud import reader
from groundproc.cloud.metres import Metres, metres_of, unstated
from groundproc.cloud.sameness import agreed_crs
from groundproc.cloud.selection import SURFACES
from groundproc.files import written_aside
from groundproc.numerics.lonely import Lonely
from groundproc.numerics.voxelwalk import begin, next_axis
from groundproc.radiometry import sensorpath
from groundproc.raster import geotiff
from groundproc.raster.geotiff import Band
from groundproc.raster.grid import Grid, Window, checked_cell

Array = npt.NDArray[np.float64]

_EDGE_M: Final = 0.5
_MOST: Final = 400_000_000
_UNKNOWN: Final = -1.0
_CROWN_M: Final = 4.0
"""What stands higher than its surroundings and is narrower than this is nothing to stand on."""


def run(task: Task, progress: Callable[[int], object]) -> dict[str, Any]:
    """Transmittance from a place, or its mean over the places of a path, to every cell.

    Raises
    ------
    SwathError
    """
    if task.source.suffix.lower() in (".tif", ".tiff"):
        raise UsageError(f"{task.source}: is a raster; --mode voxels looks through a cloud")
    edge_m = checked_cell(task.cell_m or _EDGE_M)
    cloud = reader.look(task.source, SURFACES)
    crs, metres = agreed_crs([cloud]), metres_of(cloud)
    path = None if task.trajectory is None else sensorpath.flown([cloud], task.trajectory)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    company, strays = accompanied(cloud, metres, edge_m, progress), 0
    for chunk in reader.chunks(cloud, columns=()):
        xyz = metres.of(chunk.points.xyz_m)
        stray = company.alone(xyz)
        strays += int(stray.sum())
        if stray.all():
            continue
        xyz = xyz[~stray]
        low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
        progress(len(chunk.points))
    if not np.isfinite(low).all():
        raise CoverageError(f"{task.source}: all its points are classed as noise or as what moves, or are alone")
    first = np.floor(low / edge_m).astype(np.int64)
    shape = np.floor(high / edge_m).astype(np.int64) - first + 1
    if int(np.prod(shape)) > _MOST:
        raise UsageError(
            f"{task.source}: {shape[0]} x {shape[1]} x {shape[2]} voxels of {edge_m:g} m found, expected at most {_MOST:,}; choose a "
            "larger --cell, or cut out the part of interest with `swath section`"
        )
    hits, passes, ground = _met(task, cloud, path, (first, shape, edge_m, company), metres, progress)
    ground = _standing(ground, edge_m)
    through = _through(hits, passes)
    grid = Grid(int(first[0]), int(first[1]), int(shape[0]), int(shape[1]), edge_m / metres.across)
    total, known = np.zeros((shape[0], shape[1])), np.zeros((shape[0], shape[1]), np.int64)
    places = _places(task, crs, ground, first, edge_m, metres.across)
    for place in places:
        one = np.full((shape[0], shape[1]), np.nan)
        above, target = (task.target_m, task.height_m) if task.reverse else (task.height_m, task.target_m)
        i, j = int(np.floor(place[0] / edge_m)) - first[0], int(np.floor(place[1] / edge_m)) - first[1]
        eye = (place[0] / edge_m - first[0], place[1] / edge_m - first[1], (ground[i, j] + above) / edge_m - first[2])
        _transmittance(through, ground / edge_m - first[2], eye, target / edge_m, one)
        known += np.isfinite(one)
        total += np.nan_to_num(one)
        progress(1)
    mean = np.divide(total, known, out=np.full(total.shape, np.nan), where=known > 0)
    image: npt.NDArray[np.float32] = mean.T[::-1].astype(np.float32)

    def block(window: Window) -> npt.NDArray[Any]:
        top, left = grid.row + grid.rows - window.row - window.rows, window.column - grid.column
        return image[top : top + window.rows, left : left + window.columns]

    with written_aside(task.output) as aside:
        geotiff.write(aside, grid, crs, Band("transmittance"), block)
    seen = np.isfinite(image)
    return {
        "mode": task.mode, "places": len(places), "cells": int(image.size), "unknown_cells": int((~seen).sum()),
        "mean_transmittance": float(image[seen].mean()) if seen.any() else None,
        "warnings": [*alone(task.source, strays), *unstated(cloud)],
    }  # fmt: skip


def _met(
    task: Task,
    cloud: reader.Cloud,
    path: sensorpath.Flown | None,
    voxels: tuple[Any, Any, float, Lonely],
    metres: Metres,
    progress: Callable[[int], object],
) -> tuple[Any, Any, Array]:
    """Beams that ended in each voxel and that went through, and the lowest point of each column.

    Voxels are given by their first, shape and edge; points that are alone are left out.
    """
    first, shape, edge_m, company = voxels
    hits, passes = np.zeros(shape, np.uint32), np.zeros(shape, np.uint32)
    ground = np.full((shape[0], shape[1]), np.inf)
    tally = None if path is None or task.trajectory is None else sensorpath.Tally(task.trajectory, path, cloud)
    for chunk in reader.chunks(cloud, None if path is None else path.clock, ()):
        xyz = metres.of(chunk.points.xyz_m)
        local = xyz / edge_m - first
        if path is None:
            away, known = np.tile([0.0, 0.0, 1.0], (len(local), 1)) * float(shape[2] + 1), np.ones(len(local), np.bool_)
        else:
            sensor, known = path.at(chunk)
            away = sensor / edge_m - first - local
            if tally is not None:
                tally.add(away * edge_m, known)
        last = np.asarray(chunk.record.return_number) >= np.asarray(chunk.record.number_of_returns)
        some = ~company.alone(xyz)
        _beams(local[known & some], away[known & some], last[known & some], hits, passes)
        _lowest(local[some], xyz[some, 2], ground)
        progress(len(chunk.points))
    if tally is not None:
        tally.check()
    return hits, passes, ground


def _through(hits: Any, passes: Any) -> npt.NDArray[np.float32]:
    """Share of beams that each voxel lets through, `_UNKNOWN` where none met it or those beside it."""
    through = np.full(hits.shape, _UNKNOWN, np.float32)
    for layer in range(hits.shape[2]):
        passed = passes[:, :, layer].astype(np.float64)
        met = passed + hits[:, :, layer]
        # sums of whole numbers: what is less than one beam is rounding
        around = [9.0 * uniform_filter(each, 3, mode="constant") for each in (passed, met)]
        own, beside = met > 0, (met == 0) & (around[1] > 0.5)
        np.divide(passed, met, out=through[:, :, layer], where=own, casting="same_kind")
        np.divide(around[0], around[1], out=through[:, :, layer], where=beside, casting="same_kind")
    return through


def _standing(lowest: Array, edge_m: float) -> Array:
    """Heights to stand on, by the lowest point of each column: an opening, where it lowers a column by more than an edge."""
    size = 2 * max(round(_CROWN_M / edge_m / 2.0), 1) + 1
    seen = np.isfinite(lowest)
    eroded = minimum_filter(lowest, size, mode="constant", cval=np.inf)
    opened = maximum_filter(np.where(np.isfinite(eroded), eroded, -np.inf), size, mode="constant", cval=-np.inf)
    return np.where(seen & (lowest - opened > edge_m), opened, lowest)


def _places(task: Task, crs: Any, ground: Array, first: Any, edge_m: float, across: float) -> list[tuple[float, float]]:
    """Places of the observer in metres."""
    places = [task.at_m] if task.at_m is not None else along(task, crs)
    found = []
    for place in ((east * across, north * across) for east, north in places):
        i, j = int(np.floor(place[0] / edge_m)) - first[0], int(np.floor(place[1] / edge_m)) - first[1]
        if 0 <= i < ground.shape[0] and 0 <= j < ground.shape[1] and np.isfinite(ground[i, j]):
            found.append(place)
    if not found:
        raise CoverageError(
            f"{places[0][0]:.2f},{places[0][1]:.2f}: the cloud has no point there, expected a place within it"
        )
    return found


@njit(cache=True, nogil=True)
def _lowest(local: Any, z: Any, ground: Any) -> None:
    for n in range(len(local)):
        i, j = int(local[n, 0]), int(local[n, 1])
        ground[i, j] = min(ground[i, j], z[n])


@njit(cache=True, nogil=True)
def _beams(local: Any, away: Any, last: Any, hits: Any, passes: Any) -> None:
    """Count beams that end in voxels, and those that go through: from the echo towards the sensor until they leave the grid.

    Of a beam with several echoes only the last is followed; at the others it was thrown back in part.
    """
    at, step, following, each = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3), np.empty(3)
    for n in range(len(local)):
        i, j, k = int(local[n, 0]), int(local[n, 1]), int(local[n, 2])
        hits[i, j, k] += 1
        if not last[n]:
            continue
        at[0], at[1], at[2] = i, j, k
        begin(local[n], away[n], at, 1.0, step, following, each)
        while True:
            a = next_axis(following)
            if following[a] >= 1.0:
                break
            at[a] += step[a]
            if at[a] < 0 or at[a] >= hits.shape[a]:
                break
            following[a] += each[a]
            passes[at[0], at[1], at[2]] += 1


@njit(cache=True, nogil=True)
def _transmittance(through: Any, ground: Any, eye: Any, target: float, out: Any) -> None:
    """Product over the voxels between the observer and each target, both in voxels."""
    step, following, each = np.empty(3, np.int64), np.empty(3), np.empty(3)
    for i1 in range(out.shape[0]):
        for j1 in range(out.shape[1]):
            if not np.isfinite(ground[i1, j1]):
                continue
            end = np.array([i1 + 0.5, j1 + 0.5, ground[i1, j1] + target])
            start = np.array([eye[0], eye[1], eye[2]])
            way = end - start
            length = np.sqrt((way * way).sum())
            at, last = np.floor(start).astype(np.int64), np.floor(end).astype(np.int64)
            first = at.copy()
            begin(start, way, at, 1.0, step, following, each)
            share, value, known = 0.0, 1.0, True
            while share < 1.0 and value > 1e-6:
                a = next_axis(following)
                reach = min(following[a], 1.0)
                inside = True
                for b in range(3):
                    inside = inside and 0 <= at[b] < through.shape[b]
                own = (at == first).all() or (at == last).all()
                if inside and not own:
                    own_share = np.float64(through[at[0], at[1], at[2]])
                    if own_share >= 0.0:
                        value *= own_share ** ((reach - share) * length)
                    else:
                        known = False
                share = reach
                at[a] += step[a]
                following[a] += each[a]
            if known or value <= 1e-6:
                out[i1, j1] = value if value > 1e-6 else 0.0
