"""A cloud in other coordinates: another CRS with its heights, a site's own, or distances as on the ground."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import GeodesyError, UsageError
from groundproc.analysis import datum, sitecalibration
from groundproc.assessment.pairs import read_pairs
from groundproc.cloud import reader
from groundproc.cloud.reader import Cloud
from groundproc.cloud.rewriter import Frame, Rewriter
from groundproc.files import written_aside

Array = npt.NDArray[np.float64]

_STEP: Final = 1e-3
_STEP_DEG: Final = 1e-8


@dataclass(frozen=True, slots=True)
class Task:
    """What is made of a cloud: one of `crs`, `site` and `ground`.

    Attributes
    ----------
    cloud, output : Path
    crs : str or None
        Codes of another CRS.
    site : Path or None
        Points in both: id, x, y, z on the map, x, y, z of the site.
    ground : bool
        Distances as on the ground, about the middle of the cloud.
    source : str or None
        Codes of the cloud's own CRS, in place of what it states.
    epoch : float or None
    grids : Path or None
    feet : bool
        A CRS in feet is meant.
    """

    cloud: Path
    output: Path
    crs: str | None = None
    site: Path | None = None
    ground: bool = False
    source: str | None = None
    epoch: float | None = None
    grids: Path | None = None
    feet: bool = False


@dataclass(frozen=True, slots=True)
class _Way:
    move: Callable[[Array], Array]
    crs: pyproj.CRS | None
    told: dict[str, Any]


def transform(task: Task, progress: Callable[[int], object]) -> dict[str, Any]:
    """Write it, and say what was done.

    Raises
    ------
    CaptureError
        The cloud or the table cannot be read.
    CoverageError
        The site's points tell no calibration.
    GeodesyError
        There is no way that is as good as it says.
    UsageError
        Feet that were not asked for.
    """
    cloud = reader.look(task.cloud)
    own = datum.crs_of(task.source) if task.source else cloud.crs
    first = next(reader.chunks(cloud, columns=())).points.xyz_m
    if task.site is not None:
        way = _to_site(task.site)
    elif task.ground:
        way = _to_ground(cloud, own)
    else:
        way = _to_crs(task, own)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    start = way.move(first[:1])[0]
    angles = way.crs is not None and way.crs.is_geographic
    scale = np.array([_STEP_DEG, _STEP_DEG, _STEP] if angles else [_STEP] * 3)
    frame = Frame(way.crs, scale, np.floor(start))
    with (
        written_aside(task.output) as aside,
        Rewriter(cloud, aside, task.output.suffix.lower() == ".laz", frame=frame) as writer,
    ):
        for chunk in reader.chunks(cloud, columns=()):
            places = way.move(chunk.points.xyz_m)
            low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
            writer.write_at(chunk.record, places)
            progress(len(places))
    return {
        "points": cloud.points, "from": None if own is None else own.name, "to": None if way.crs is None else way.crs.name,
        "unit": units(way.crs), "low": low.tolist(), "high": high.tolist(),
    } | way.told  # fmt: skip


def units(crs: pyproj.CRS | None) -> str:
    """Of coordinates and heights, as the CRS has them."""
    if crs is None:
        return "metre"
    return ", ".join(dict.fromkeys(axis.unit_name for axis in crs.axis_info))


def _to_crs(task: Task, own: pyproj.CRS | None) -> _Way:
    assert task.crs is not None
    if own is None:
        raise GeodesyError(f"{task.cloud}: states no CRS; say it with --from, such as 32633+5773")
    target = datum.crs_of(task.crs)
    has, wants = datum.heights_of(own), datum.heights_of(target)
    if wants is not None and has is None and len(own.axis_info) < 3:
        raise GeodesyError(
            f"{task.cloud}: is in {own.name}, which does not say what its heights refer to; say it with --from, such as 32633+5773"
        )
    if wants is None and has is not None and len(target.axis_info) < 3:
        # heights stay what they are
        target = pyproj.crs.CompoundCRS(f"{target.name} + {has.name}", [target, has])
    elif wants is None and len(own.axis_info) > 2:
        target = target.to_3d()
    feet = next((axis.unit_name for axis in target.axis_info if "foot" in axis.unit_name.lower()), None)
    if feet is not None and not task.feet:
        # heights that stay what they are stay in feet
        kept = wants is None and has is not None and "foot" not in target.sub_crs_list[0].axis_info[0].unit_name.lower()
        other = ", or say heights in metres after a +, such as 26918+5703" if kept else ""
        raise UsageError(
            f"--crs {task.crs}: {target.name} is in units of {feet}; give --feet too if that is meant{other}"
        )
    found = datum.operation(own, target, task.epoch, task.grids)
    told = {"operation": found.name, "accuracy_m": found.accuracy_m, "grids": list(found.grids), "epoch": task.epoch}
    return _Way(found.move, target, told)


def _to_site(path: Path) -> _Way:
    both = read_pairs(path)
    site = sitecalibration.calibrated(both.first_m, both.second_m)
    points = [
        {"id": name, "residual_m": kept.tolist(), "left_out_m": [float(v) if np.isfinite(v) else None for v in out]}
        for name, kept, out in zip(both.ids, site.residual_m, site.left_out_m, strict=True)
    ]
    return _Way(site.move, None, {"site": site.told() | {"points": points}})


def _to_ground(cloud: Cloud, own: pyproj.CRS | None) -> _Way:
    horizontal = own.sub_crs_list[0] if own is not None and own.is_compound else own
    if horizontal is None or not horizontal.is_projected or units(horizontal) != "metre":
        raise GeodesyError(f"{cloud.path}: is not in a projected CRS in metres, expected one; say it with --from")
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for chunk in reader.chunks(cloud, columns=()):
        low, high = np.minimum(low, chunk.points.xyz_m.min(axis=0)), np.maximum(high, chunk.points.xyz_m.max(axis=0))
    middle = np.round((low + high) / 2.0)
    scale, combined = datum.combined_factor(horizontal, middle)

    def move(places: Array) -> Array:
        return np.asarray(middle + (places - middle) / np.array([combined, combined, 1.0]))

    return _Way(move, None, {"ground": {"about_m": middle.tolist(), "grid_scale": scale, "combined_factor": combined}})


def text(told: dict[str, Any]) -> str:
    """What was done, for the terminal."""
    lines = [
        f"{told['points']:,} points, now in {told['to'] or 'local coordinates without a CRS'}, unit: {told['unit']}"
    ]
    if "operation" in told:
        known = "not stated" if told["accuracy_m"] is None else f"{told['accuracy_m']:g} m"
        lines.append(
            f"by {told['operation']}; accuracy {known}"
            + (f"; grids {', '.join(told['grids'])}" if told["grids"] else "")
        )
    if "ground" in told:
        ground = told["ground"]
        lines.append(
            f"about {ground['about_m'][0]:.0f}, {ground['about_m'][1]:.0f} at {ground['about_m'][2]:.0f} m: grid scale "
            f"{ground['grid_scale']:.8f}, combined factor {ground['combined_factor']:.8f}; distances are those on the ground"
        )
    if "site" in told:
        site = told["site"]
        lines.append(
            f"turn {site['turn_deg']:+.5f} deg, scale {site['scale_ppm']:+.1f} ppm, tilt {_row(site['tilt_mm_per_m'], 3)} mm/m"
        )
        lines.append(f"{'residuals [m]':<14}{'dx':>9}{'dy':>9}{'dz':>9}   without the point")
        for each in site["points"]:
            lines.append(f"{each['id'][:14]:<14}{_row(each['residual_m'], 4)}   {_row(each['left_out_m'], 4)}")
        lines.append(f"{'RMSE':<14}{_row(site['rmse_m'], 4)}")
    return "\n".join(lines)


def _row(values: list[float | None], digits: int) -> str:
    return "".join(f"{'-':>9}" if v is None else f"{v:>+9.{digits}f}" for v in values)
