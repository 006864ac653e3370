"""From files to an assessment: plain values for JSON, and text for the terminal."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from flightlog.errors import CoverageError
from groundproc.assessment import checkpoints, pairs
from groundproc.assessment.figures import figures, table
from groundproc.cloud import reader
from groundproc.cloud.selection import SURFACES


def of_pairs(path: Path) -> tuple[dict[str, Any], str]:
    """Two sets of coordinates in one table: the second less the first.

    Raises
    ------
    CaptureError
        The table is not as it should be.
    """
    both = pairs.read_pairs(path)
    d_m = both.second_m - both.first_m
    found = figures(d_m)
    told = {"points": [_plain(name, d, "pair") for name, d in zip(both.ids, d_m, strict=True)], "unmatched": []} | found
    return told, table(both.ids, d_m, found)


def of_cloud(
    cloud_path: Path, points_path: Path, mode: str | None, progress: Callable[[int], object]
) -> tuple[dict[str, Any], str]:
    """A cloud against surveyed points.

    Raises
    ------
    CaptureError
        A file cannot be read or is not as it should be.
    CoverageError
        Not one point could be compared.
    """
    cloud = reader.look(cloud_path, SURFACES)
    points = checkpoints.read_points(points_path)
    near = checkpoints.around(cloud, points, checkpoints.REACH_M, progress)
    compared, unmatched = checkpoints.compare(points, near, mode)
    if not compared:
        raise CoverageError(
            f"{cloud_path}: not one of the {len(points)} points of {points_path} can be compared; the first, "
            f"{unmatched[0].id}: {unmatched[0].reason}; are both in the same CRS?"
        )
    d_m = np.array([each.d_m for each in compared])
    found = figures(d_m)
    told = {
        "points": [_plain(each.id, each.d_m, each.mode) | {"sigma_m": _number(each.sigma_m)} for each in compared],
        "unmatched": [{"id": each.id, "reason": each.reason} for each in unmatched],
        "crs": None if cloud.crs is None else cloud.crs.name,
    } | found
    text = table([each.id for each in compared], d_m, found, [each.mode for each in compared])
    lines = [f"{each.id}: not compared: {each.reason}" for each in unmatched]
    return told, "\n".join([text, *lines])


def _plain(name: str, d_m: np.ndarray[Any, Any], mode: str) -> dict[str, Any]:
    dx, dy, dz = (_number(value) for value in d_m)
    return {"id": name, "dx": dx, "dy": dy, "dz": dz, "mode": mode}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
