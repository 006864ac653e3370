"""`swath reflectance` as a list of stages: what there is, where the sensor was, surfaces, constants, clouds with reflectance."""

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from flightlog.errors import CoverageError
from groundproc.cloud import reader
from groundproc.cloud.reader import Chunk
from groundproc.cloud.rewriter import Rewriter
from groundproc.cloud.selection import CLASS, standing
from groundproc.cloud.tiles import Found, Tile, Tiles, side_for
from groundproc.files import made_folder, written_aside
from groundproc.numerics import normals
from groundproc.radiometry import nearrange, report, signal
from groundproc.radiometry.agreement import agreement
from groundproc.radiometry.atmosphere import transmission
from groundproc.radiometry.calibration import FEWEST, Constant, Echoes, combine, constant_of
from groundproc.radiometry.gains import Gains, speckle
from groundproc.radiometry.leaves import Leaves, leaves_of
from groundproc.radiometry.nearrange import RangeGain
from groundproc.radiometry.sensorpath import Flown, Tally
from groundproc.radiometry.site import STEEPEST, Progress, Sample, Site, Task, check_names, check_path, look
from groundproc.radiometry.targets import Target

Array = npt.NDArray[np.float64]

REPORT: Final = "calibration.json"
COLUMNS: Final = ("reflectance", "reflectance_sigma")
_ROUGHEST_M: Final = 0.2
_LEAST_KNOWN_RAD: Final = np.deg2rad(2.0)
"""Beyond these a plane is a canopy or a chance, whose leaves lie otherwise: real strips over wood differ more with its cosine."""
_LEAVES: Final = 0.5
"""Relative sigma of an echo from no surface, whose incidence is taken as 0."""
_KEPT: Final = {
    "strength": "f4", "range": "f4", "east": "f4", "north": "f4", "up": "f4", "laser": "u1", "strip": "u2", "single": "?",
    "stands": "?",
}  # fmt: skip
_FOUND: Final = {"range": "f4", "cosine": "f4", "tilt": "f4", "rise": "f4"}


def run(task: Task, progress: Progress) -> dict[str, Any]:
    """Calibrate, write, and give what the report holds.

    Raises
    ------
    SwathError
        Input that cannot be used; nothing is written then.
    """
    signal.check_kind(task.kind)
    transmission(np.zeros(1), task.visibility_km, task.wavelength_nm)
    check_names(task)
    site = look(task, progress)
    with made_folder(task.folder):
        found = _surfaces(site, progress)
        told, constants = _constants(site)
        _write(site, found, constants, progress)
        with written_aside(task.folder / REPORT) as aside:
            aside.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    return told


def _placed(site: Site, progress: Progress, stage: str) -> Iterator[tuple[Chunk, int, Array, npt.NDArray[np.bool_]]]:
    for number, cloud in enumerate(site.clouds):
        for chunk in reader.chunks(cloud, site.path.clock, ("laser", "range", "point_source_id", CLASS)):
            place, known = site.path.at(chunk)
            yield chunk, number, place, known
            progress(stage, len(chunk.points))


def _tallies(site: Site) -> list[Tally]:
    """One a cloud, where the path is that of a trajectory."""
    path, trajectory = site.path, site.task.trajectory
    if trajectory is None or not isinstance(path, Flown):
        return []
    return [Tally(trajectory, path, cloud) for cloud in site.clouds]


def _surfaces(site: Site, progress: Progress) -> Found:
    """Range and incidence of all points; what the constants are made of is gathered on the way."""
    survey, folder = site.survey, site.task.folder
    tiles = Tiles(
        folder,
        _KEPT,
        side_for(survey.points, survey.low.tolist(), survey.high.tolist(), normals.HALO_M),
        normals.HALO_M,
    )
    sample, tallies = Sample(survey.points), _tallies(site)
    for chunk, number, place, known in _placed(site, progress, "placing"):
        away = place - chunk.points.xyz_m
        range_m = np.linalg.norm(away, axis=1)
        site.known += int(known.sum())
        raw = site.signal.raw(chunk.record)
        range_m[~known] = np.nan
        if tallies:
            tallies[number].add(away, known)
        away /= np.where(known & (range_m > 0), range_m, 1.0)[:, None]
        source = chunk.points.columns["point_source_id"]
        strength = np.where(site.good(raw), site.signal.linear(raw), np.nan)
        single = np.asarray(chunk.record.number_of_returns) <= 1
        tiles.add(chunk.points.xyz_m, {
            "strength": strength, "range": range_m, "east": away[:, 0], "north": away[:, 1], "up": away[:, 2],
            "laser": chunk.points.columns.get("laser", np.zeros(len(source), np.uint8)),
            "strip": source if len(site.clouds) == 1 or source.any() else np.full(len(source), number, np.uint16),
            "single": single, "stands": standing(chunk.points, site.task.all_classes),
        })  # fmt: skip
        sample.add(raw[known], range_m[known], chunk.points.columns.get("range"), known)
    check_path(site, sample)
    for each in tallies:
        each.check()
    found = Found(folder, _FOUND, survey.points)
    for tile in tiles:
        others = tile.core & ~tile.columns["stands"]
        unknown = np.full(int(others.sum()), np.nan, np.float32)
        found.put(tile.number[others], {"range": tile.columns["range"][others], "cosine": unknown, "tilt": unknown})
        tile = _masked(tile, tile.columns["stands"])
        lies = normals.normals(tile.xyz_m)
        core = np.flatnonzero(tile.core)
        columns = {name: values[core] for name, values in tile.columns.items()}
        way = np.stack([columns["east"], columns["north"], columns["up"]], axis=1).astype(np.float64)
        cosine = np.abs(np.einsum("ni,ni->n", lies.normal[core], way))
        tilt = lies.sigma_rad[core]
        cosine[(lies.roughness_m[core] > _ROUGHEST_M) | (tilt > _LEAST_KNOWN_RAD)] = np.nan
        found.put(tile.number[core], {"range": columns["range"], "cosine": cosine, "tilt": tilt, "rise": columns["up"]})
        site.on_surface += int(np.isfinite(cosine).sum())
        _gather(site, tile.xyz_m[core], columns, cosine, tilt)
        progress("surfaces", len(core))
    return found


def _masked(tile: Tile, wanted: npt.NDArray[np.bool_]) -> Tile:
    columns = {name: values[wanted] for name, values in tile.columns.items()}
    return Tile(tile.xyz_m[wanted], tile.number[wanted], tile.core[wanted], columns)


def _gather(site: Site, xyz_m: Array, columns: dict[str, npt.NDArray[Any]], cosine: Array, tilt: Array) -> None:
    """Take the points of a square: for gains, for the comparison of strips, and within targets."""
    range_m = columns["range"].astype(np.float64)
    strength = columns["strength"].astype(np.float64)
    usable = np.isfinite(strength) & np.isfinite(range_m)
    surface = usable & np.isfinite(cosine)
    freed = strength * site.factor(range_m, np.where(surface, cosine, 1.0))
    single = usable & columns["single"]  # of a beam that meets several things, each echo has a part
    # only a sensor that takes out the range itself leaves something of it
    band = nearrange.band(range_m) * (site.signal.kind == signal.COMPENSATED)
    site.patches.add(
        xyz_m[single],
        columns["strip"][single],
        ~surface[single],
        band[single],
        (strength[single], freed[single], columns["up"][single].astype(np.float64)),
    )
    alone = surface & columns["single"] & (cosine > np.cos(np.deg2rad(70.0)))
    site.patches.add_lasers(
        xyz_m[alone],
        columns["laser"][alone],
        np.arccos(np.minimum(cosine[alone], 1.0)),
        freed[alone],
        nearrange.band(range_m[alone])
        if site.signal.kind == signal.COMPENSATED
        else np.zeros(int(alone.sum()), np.int64),
    )
    for number, target in enumerate(site.targets):
        west, south, east, north = target.polygon.bounds
        near = surface & (xyz_m[:, 0] >= west) & (xyz_m[:, 0] <= east) & (xyz_m[:, 1] >= south) & (xyz_m[:, 1] <= north)
        rows = np.flatnonzero(near)
        rows = rows[shapely.contains_xy(target.polygon, xyz_m[rows, 0], xyz_m[rows, 1])]
        if len(rows):
            part = [strength[rows], range_m[rows], cosine[rows], tilt[rows], columns["laser"][rows]]
            site.echoes[number].append(np.column_stack(part))


@dataclass(frozen=True, slots=True)
class Constants:
    """What strengths are made reflectances by.

    Attributes
    ----------
    gain : Gains
        Of lasers.
    by_range : RangeGain
    leaves : Leaves
    c_cal, c_cal_sigma : float
        The sigma is nan where there are no targets.
    speckle : float
        Relative scatter of single echoes.
    """

    gain: Gains
    by_range: RangeGain
    leaves: Leaves
    c_cal: float
    c_cal_sigma: float
    speckle: float


def _constants(site: Site) -> tuple[dict[str, Any], Constants]:
    """The report, and what the clouds are written with."""
    table, of_band = site.patches.table()
    gain, by_range = nearrange.both(table, of_band)
    constants: list[Constant] = []
    unused: list[str] = []
    for target, parts in zip(site.targets, site.echoes, strict=True):
        one = constant_of(_echoes(site, target, np.concatenate(parts), gain, by_range)) if parts else None
        if one is None:
            unused.append(target.id)
        else:
            constants.append(one)
    relative = not site.targets
    if site.targets:
        if not constants:
            raise CoverageError(
                f"{site.task.targets}: not one of {len(site.targets)} targets has {FEWEST} echoes from a surface within it"
            )
        c_cal, sigma = combine(constants)
    else:
        c_cal, sigma = _without_targets(site), float("nan")
    seen = site.patches.seen(by_range)
    leaves = leaves_of(seen)
    told = report.told(site, gain, constants, unused, (c_cal, sigma), relative, agreement(leaves.freed(seen)))
    spread = speckle(table)
    told["speckle"], told["range_gains"], told["leaves"] = round(spread, 4), by_range.tell(), leaves.tell()
    return told, Constants(gain, by_range, leaves, c_cal, sigma, spread)


def _echoes(site: Site, target: Target, rows: Array, gain: Gains, by_range: RangeGain) -> Echoes:
    strength, range_m, cosine, tilt, laser = rows.T
    angle = np.arccos(np.minimum(cosine, 1.0))
    strength /= gain.gain[laser.astype(np.int64)] * by_range.at(range_m)[0]
    return Echoes(
        target.id, strength, target.at(angle) / site.factor(range_m, cosine), angle, tilt,
        1.0 if site.signal.unit_db == 1.0 and site.signal.field == "intensity" else 0.0,
    )  # fmt: skip


def _without_targets(site: Site) -> float:
    """c_cal by the sensor's own scale, or such that reflectances have a usual median."""
    if site.signal.kind == signal.COMPENSATED:
        return signal.NOMINAL
    if site.signal.kind == signal.DECIBEL:
        return 1.0
    return report.RELATIVE / max(site.patches.typical(), 1e-300)


def _write(site: Site, found: Found, constants: Constants, progress: Progress) -> None:
    """The clouds once more, with the reflectance of every echo."""
    start = 0
    with ExitStack() as stack:
        for cloud in site.clouds:
            aside = stack.enter_context(written_aside(site.task.folder / cloud.path.with_suffix(".laz").name))
            with Rewriter(cloud, aside, added=COLUMNS) as new:
                for chunk in reader.chunks(cloud, columns=("laser",)):
                    count = len(chunk.points)
                    known = {name: v.astype(np.float64) for name, v in found.take(start, count).items()}
                    start += count
                    laser = chunk.points.columns.get("laser", np.zeros(count, np.uint8))
                    value, sigma = _reflectances(site, constants, site.signal.raw(chunk.record), laser, known)
                    new.write(chunk.record, columns={"reflectance": value, "reflectance_sigma": sigma})
                    progress("writing", count)


def _reflectances(
    site: Site, constants: Constants, raw: Array, laser: npt.NDArray[np.uint8], known: Mapping[str, Array]
) -> tuple[Array, Array]:
    """Reflectance and its sigma, shape (n,) each."""
    flat = np.isfinite(known["cosine"])
    facing = np.where(flat, known["cosine"], constants.leaves.facing(known["rise"]))
    freed = site.signal.linear(raw) * site.factor(known["range"], facing)
    gain = constants.gain
    range_gain, range_sigma = constants.by_range.at(known["range"])
    value = np.where(site.good(raw), constants.c_cal * freed / gain.gain[laser] / range_gain, np.nan)
    steep = np.maximum(np.where(flat, known["cosine"], 1.0), STEEPEST)
    tan = np.sqrt(np.maximum(steep**-2 - 1.0, 0.0))
    parts = (
        0.0 if np.isnan(constants.c_cal_sigma) else constants.c_cal_sigma / constants.c_cal,
        constants.speckle,
        np.where(flat, tan * np.nan_to_num(known["tilt"]), _LEAVES),
        0.2887 / np.maximum(raw, 0.5) if site.signal.field == "intensity" else 0.0,
        gain.sigma[laser] * flat,
        range_sigma / range_gain,
    )
    return value, value * np.sqrt(sum(np.square(part) for part in parts))
