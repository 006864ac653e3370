"""From files to an assessment: plain values for JSON, and text for the terminal."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from flightlog.errors import CoverageError
from groundproc.assessment import checkpoints, pairs
from groundproc.assessment.checkpoints import CheckPoint, Compared
from groundproc.assessment.figures import figures, table
from groundproc.assessment.targets import Wanted
from groundproc.cloud import reader
from groundproc.cloud.metres import Metres, metres_of
from groundproc.cloud.selection import SURFACES

Array = np.ndarray[Any, Any]


@dataclass(frozen=True, slots=True)
class Assessed:
    """What a comparison with points gave.

    Attributes
    ----------
    told : dict
        For JSON.
    text : str
    ids, modes : list of str
    place_m, d_m : ndarray, shape (n, 3)
        Of the reference, and this less the reference as it is to be drawn; NaN where it says nothing of the accuracy.
    """

    told: dict[str, Any]
    text: str
    ids: list[str]
    modes: list[str]
    place_m: Array
    d_m: Array


@dataclass(frozen=True, slots=True)
class PointsTask:
    """A cloud, surveyed points, and how they are compared.

    Attributes
    ----------
    cloud, points : Path
    mode : str or None
        Of `checkpoints.MODES`.
    wanted : Wanted
    """

    cloud: Path
    points: Path
    mode: str | None = None
    wanted: Wanted = field(default_factory=Wanted)


def of_pairs(path: Path) -> Assessed:
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
    return Assessed(told, table(both.ids, d_m, found), list(both.ids), ["pair"] * len(both.ids), both.first_m, d_m)


def of_cloud(task: PointsTask, progress: Callable[[int], object]) -> Assessed:
    """A cloud against surveyed points.

    Raises
    ------
    CaptureError
        A file cannot be read or is not as it should be.
    GeodesyError
        The cloud is in degrees.
    CoverageError
        Not one point could be compared.
    """
    cloud = reader.look(task.cloud, SURFACES)
    unit = metres_of(cloud)
    points = checkpoints.read_points(task.points, unit)
    near = checkpoints.around(cloud, points, unit, progress)
    compared, unmatched = checkpoints.compare(points, near, task.mode, task.wanted)
    if not compared:
        raise CoverageError(
            f"{task.cloud}: not one of the {len(points)} points of {task.points} can be compared; the first, "
            f"{unmatched[0].id}: {unmatched[0].reason}; are both in the same CRS?"
        )
    by_id = {point.id: point for point in points}
    d_m = np.array([each.d_m for each in compared])
    survey_m = np.array([by_id[each.id].sigma_m for each in compared])
    # the nearest of the points on a natural surface tells how far apart they are, and nothing of their places
    in_plan = np.array([task.mode == "point" or each.target is not None for each in compared])
    found = figures(d_m, survey_m, in_plan)
    if not unit.plain:
        # axes in the unit of the CRS; what is in metres says so in its name
        found |= {name: value for name, value in figures(unit.back(d_m)).items() if isinstance(value, list)}
    told = {
        "points": [_told(each, by_id[each.id], unit) for each in compared],
        "unmatched": [{"id": each.id, "reason": each.reason} for each in unmatched],
        "crs": None if cloud.crs is None else cloud.crs.name,
        "unit": unit.name,
    } | found
    ids, modes = [each.id for each in compared], [_mode(each) for each in compared]
    text = table(ids, unit.back(d_m), found, modes, "m" if unit.plain else unit.name)
    lines = [f"{each.id}: not compared: {each.reason}" for each in unmatched]
    place_m = np.array([by_id[each.id].place_m for each in compared])
    if any(each.mode == "point" for each in compared) and task.mode is None:
        lines.append(_SAMPLED)
    drawn_m = np.where(np.column_stack([in_plan, in_plan, np.ones(len(d_m), np.bool_)]), d_m, np.nan)
    return Assessed(told, "\n".join([text, *lines]), ids, modes, place_m, drawn_m)


_SAMPLED: Final = (
    f"dx and dy of mode point are those of a point of the cloud within {checkpoints.NEAR_M * 100:g} cm: they say how densely it was "
    "sampled, and count for no accuracy in plan"
)


def _mode(compared: Compared) -> str:
    if compared.target is None:
        return compared.mode
    sigma = compared.target.sigma_m
    return f"{compared.target.kind} (sigma {1e3 * sigma[0]:.1f}, {1e3 * sigma[1]:.1f}, {1e3 * sigma[2]:.1f} mm)"


def _told(compared: Compared, point: CheckPoint, unit: Metres) -> dict[str, Any]:
    """One point for JSON."""
    told = _plain(compared.id, unit.back(compared.d_m), compared.mode)
    told["sigma_m"] = _number(compared.sigma_m[2])
    told["sigma_xyz_m"] = [_number(value) for value in compared.sigma_m]
    told["survey_sigma_xyz_m"] = [_number(value) for value in point.sigma_m]
    if compared.target is not None:
        target = compared.target
        told["target"] = {
            "kind": target.kind, "size_m": round(target.size_m, 4), "points": target.points, "explained": _number(target.told),
        }  # fmt: skip
    return told


def _plain(name: str, d: Array, mode: str) -> dict[str, Any]:
    dx, dy, dz = (_number(value) for value in d)
    return {"id": name, "dx": dx, "dy": dy, "dz": dz, "mode": mode}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
