"""What is calibrated: clouds, strengths, where the sensor was, targets; and whether they belong together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj
import shapely

from flightlog.errors import CaptureError, CoverageError, UsageError
from groundproc.cloud import reader
from groundproc.cloud.metres import metres_of
from groundproc.cloud.reader import Chunk, Cloud
from groundproc.cloud.sameness import agreed_map_crs
from groundproc.radiometry import sensorpath, signal
from groundproc.radiometry.atmosphere import transmission
from groundproc.radiometry.patches import Patches
from groundproc.radiometry.sensorpath import SensorPath
from groundproc.radiometry.signal import Signal
from groundproc.radiometry.targets import Target, read_targets

Array = npt.NDArray[np.float64]
Progress = Callable[[str, int], object]
"""Is told the stage and how many more points are through it."""

STEEPEST: Final = float(np.cos(np.deg2rad(85.0)))
"""Beyond, the cosine says nothing any more."""
_NEAREST_M: Final = 0.5
_FARTHEST_M: Final = 10_000.0
_FARTHEST_COMPENSATED_M: Final = 300.0
"""Sensors that compensate their intensities themselves see a fraction of this."""
_STRAY_M: Final = 2.0
"""Ranges by a right trajectory and by the sensor differ by less, half of them."""
_SAMPLE: Final = 50_000


@dataclass(frozen=True, slots=True)
class Task:
    """What to calibrate, and with what.

    Attributes
    ----------
    clouds : sequence of Path
    folder : Path
    trajectory, targets : Path or None
    kind : str or None
        Of `signal.KINDS`.
    visibility_km : float or None
    wavelength_nm : float
    crs : pyproj.CRS or None
        In place of the clouds' own.
    week : int or None
    undulation_m : float
        Taken off the trajectory's heights.
    lever_m : sequence of 3 floats
        Sensor in the body frame: right, forward, up.
    all_classes : bool
        Noise and what moves are looked at as surfaces too.
    """

    clouds: Sequence[Path]
    folder: Path
    trajectory: Path | None = None
    targets: Path | None = None
    kind: str | None = None
    visibility_km: float | None = None
    wavelength_nm: float = 905.0
    crs: pyproj.CRS | None = None
    week: int | None = None
    undulation_m: float = 0.0
    lever_m: Sequence[float] = (0.0, 0.0, 0.0)
    all_classes: bool = False


@dataclass(slots=True)
class Survey:
    """What the clouds hold, from a first reading."""

    counts: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(1 << 16, np.int64))
    points: int = 0
    low: Array = field(default_factory=lambda: np.full(3, np.inf))
    high: Array = field(default_factory=lambda: np.full(3, -np.inf))

    def add(self, chunk: Chunk) -> None:
        """Take a chunk."""
        if "intensity" in chunk.record.point_format.dimension_names:
            self.counts += np.bincount(np.asarray(chunk.record.intensity), minlength=1 << 16)
        xyz = chunk.points.xyz_m
        self.points += len(xyz)
        self.low, self.high = np.minimum(self.low, xyz.min(axis=0)), np.maximum(self.high, xyz.max(axis=0))

    @property
    def largest(self) -> int:
        """Largest intensity."""
        used = np.flatnonzero(self.counts)
        return int(used[-1]) if len(used) else 0


@dataclass(slots=True)
class Site:
    """All that is known of a task before the surfaces are looked at."""

    task: Task
    clouds: list[Cloud]
    survey: Survey
    signal: Signal
    path: SensorPath
    targets: list[Target]
    saturated: int
    echoes: list[list[npt.NDArray[Any]]] = field(default_factory=list)
    patches: Patches = field(default_factory=Patches)
    known: int = 0
    on_surface: int = 0

    def good(self, raw: Array) -> npt.NDArray[np.bool_]:
        """Echoes that have a reflectance, shape (n,)."""
        if self.signal.kind == signal.COMPENSATED:
            return np.asarray(raw < signal.RETRO)
        return np.asarray(raw < self.saturated) if self.signal.field == "intensity" else np.isfinite(raw)

    def factor(self, range_m: Array, cosine: Array) -> Array:
        """What the linear strength is multiplied by to be freed of range, air and incidence, shape (n,)."""
        eta = transmission(range_m, self.task.visibility_km, self.task.wavelength_nm)
        return np.asarray((range_m**2 if self.signal.by_range else 1.0) / (eta * np.maximum(cosine, STEEPEST)))


def check_names(task: Task) -> None:
    """See that outputs have names of their own.

    Raises
    ------
    UsageError
    """
    names = [path.with_suffix(".laz").name for path in task.clouds]
    for path, name in zip(task.clouds, names, strict=True):
        if names.count(name) > 1:
            raise UsageError(f"{name}: two files would get this name; calibrate files of different names")
        if path.resolve() == (task.folder / name).resolve():
            raise UsageError(f"{path}: is an input; say another folder with -o")


def look(task: Task, progress: Progress) -> Site:
    """The first reading: strengths, extent, and where the sensor was."""
    clouds = [reader.look(path) for path in task.clouds]
    crs = task.crs
    if crs is None and (task.trajectory is not None or task.targets is not None):
        crs = agreed_map_crs(clouds, None)
    for cloud in clouds:
        unit = metres_of(cloud)
        if crs is None and not unit.plain:
            raise CaptureError(f"{cloud.path}: is in {unit.name}, expected metres; `swath transform` makes them")
        if not cloud.timed:
            raise CaptureError(f"{cloud.path}: its points have no gps_time, by which the place of the sensor is known")
    path: SensorPath | None = None
    if task.trajectory is not None:
        path = sensorpath.flown(
            clouds, task.trajectory, crs=crs, week=task.week, undulation_m=task.undulation_m, lever_m=task.lever_m
        )
    targets = [] if task.targets is None else read_targets(task.targets, crs)
    survey, rays = Survey(), sensorpath.Rays()
    for cloud in clouds:
        for chunk in reader.chunks(cloud, columns=()):
            survey.add(chunk)
            if path is None:
                rays.add(chunk)
            progress("looking", len(chunk.points))
    _check_targets(task, targets, survey)
    how = signal.recognise(clouds[0], task.kind, survey.largest)
    saturated = signal.saturation(survey.counts)
    return Site(
        task, clouds, survey, how, rays.path() if path is None else path, targets, saturated, [[] for _ in targets]
    )


def _check_targets(task: Task, targets: Sequence[Target], survey: Survey) -> None:
    box = shapely.box(survey.low[0], survey.low[1], survey.high[0], survey.high[1])
    outside = [each.id for each in targets if not each.polygon.intersects(box)]
    if targets and len(outside) == len(targets):
        raise CoverageError(
            f"{task.targets}: all {len(targets)} targets lie outside of the clouds, which span {survey.low[0]:.0f} to "
            f"{survey.high[0]:.0f} E and {survey.low[1]:.0f} to {survey.high[1]:.0f} N"
        )


class Sample:
    """Some strengths and ranges of all points, and how the ranges differ from the sensor's own."""

    def __init__(self, points: int) -> None:
        self._step = max(1, points // _SAMPLE)
        self.raw: list[Array] = []
        self.range_m: list[Array] = []
        self.differs: list[Array] = []

    def add(self, raw: Array, range_m: Array, measured: npt.NDArray[Any] | None, known: npt.NDArray[np.bool_]) -> None:
        """Take strengths and ranges of points whose sensor is known, and the ranges that the sensor measured, of all."""
        self.raw.append(raw[:: self._step])
        self.range_m.append(range_m[:: self._step])
        if measured is not None:
            self.differs.append(np.abs(range_m - measured[known])[:: self._step])


def check_path(site: Site, sample: Sample) -> None:
    """See that the path belongs to the points, and that the strengths are strengths.

    Raises
    ------
    CoverageError, CaptureError
    """
    task, total = site.task, site.survey.points
    if isinstance(site.path, sensorpath.Flown):
        assert task.trajectory is not None
        first, last = site.path.route.poses.time_ns[[0, -1]]
        if site.known < total / 2:
            raise CoverageError(
                f"{task.trajectory}: {total - site.known} of {total} points were measured when it has no pose "
                f"({sensorpath.span(int(first), int(last))}); is it of this flight?"
            )
    raw, range_m = np.concatenate(sample.raw), np.concatenate(sample.range_m)
    middle = float(np.median(range_m))
    differs = float(np.median(np.concatenate(sample.differs))) if sample.differs else 0.0
    farthest = _FARTHEST_COMPENSATED_M if site.signal.kind == signal.COMPENSATED else _FARTHEST_M
    if not _NEAREST_M <= middle <= farthest or differs > _STRAY_M:
        why = (
            f"{differs:.1f} m off what the sensor measured" if differs > _STRAY_M else f"{middle:.1f} m from the points"
        )
        raise CoverageError(
            f"{task.trajectory or site.clouds[0].path}: the sensor would have been {why} (median): is the trajectory of this flight, "
            "and are its heights those of the cloud (--geoid)?"
        )
    if site.signal.kind == signal.COMPENSATED and signal.is_power_index(raw, range_m, site.survey.counts):
        raise CaptureError(
            f"{site.clouds[0].path}: its intensities are {len(np.flatnonzero(site.survey.counts))} numbers that rise with the range, as "
            "HDL-32E firmware 1 sends the laser's power in place of a strength: no reflectance can be made of them, but with firmware 2"
        )
