"""From a cloud to the things that moved while it was measured: points of class 69, in the order of time, made into tracks.

Only what moved is kept in memory: some hundredth of a cloud. It is looked at in stretches of ten seconds.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from flightlog.clock import utc_text
from flightlog.errors import CaptureError, UsageError
from groundproc.analysis.tracks import Burst, Track, bursts, tracks
from groundproc.cloud import reader
from groundproc.cloud.classes import MOVING
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.metres import metres_of, unstated
from groundproc.files import written_aside
from groundproc.vectors.features import Features, write_features
from groundproc.verdict import warnings_in

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

CLOUDS: Final = ("cloud.laz", "cloud.copc.laz")
"""Of a folder of `swath process`."""
QUALITY: Final = "quality.json"
EVERY_S: Final = 0.5
_STRETCH_S: Final = 10.0
_SIGMAS: Final = 2.0
_SLOWEST_M_S: Final = 0.3


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath moving`.

    Attributes
    ----------
    cloud, output : Path
    ways : Path or None
        For a line for each thing.
    every_s : float
        Between places of one thing.
    week : int or None
    """

    cloud: Path
    output: Path
    ways: Path | None = None
    every_s: float = EVERY_S
    week: int | None = None


@dataclass(slots=True)
class Made:
    """What was found."""

    points: int = 0
    in_tracks: int = 0
    tracks: list[Track] = field(default_factory=list)
    unsure: int = 0
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        speeds = [each.mean_m_s for each in self.tracks]
        return {
            "things": len(self.tracks), "fastest_m_s": max(speeds, default=None), "points": self.points,
            "points_in_tracks": self.in_tracks, "tracks_without_speed": self.unsure, "warnings": self.warnings,
        }  # fmt: skip


def cloud_in(path: Path) -> Path:
    """The cloud of a finished folder, or the file itself.

    Raises
    ------
    UsageError
        The folder holds none.
    """
    if not path.is_dir():
        return path
    for name in CLOUDS:
        if (path / name).is_file():
            return path / name
    raise UsageError(f"{path}: holds no {' or '.join(CLOUDS)}; expected a folder of `swath process`, or a cloud")


def work(task: Task, progress: Progress) -> Made:
    """Find what moved, and write it; `progress` is told of points read.

    Raises
    ------
    CaptureError, GeodesyError, SourceError, UsageError
        A file is not as it should be.
    """
    if not 0.05 <= task.every_s <= 60.0:
        raise UsageError(f"--every {task.every_s:g} s: expected 0.05 to 60 s, for example {EVERY_S:g}")
    cloud = reader.look(task.cloud)
    if not cloud.timed:
        raise CaptureError(f"{cloud.path}: its points have no gps_time, expected the time of each point")
    made, metres = Made(), metres_of(cloud)
    made.warnings += unstated(cloud)
    time_ns, xyz = _points(cloud, task.week, progress)
    made.points = len(time_ns)
    start_ns = int(time_ns[0]) if len(time_ns) else 0
    found = tracks(_bursts(np.asarray((time_ns - start_ns) * 1e-9, np.float64), np.asarray(metres.of(xyz), np.float64)))
    sure = [each for each in found if each.mean_m_s > max(_SIGMAS * each.mean_sigma_m_s, _SLOWEST_M_S)]
    made.tracks, made.unsure = sure, len(found) - len(sure)
    made.in_tracks = sum(each.points for each in sure)
    if not made.points:
        made.warnings.append(f"{cloud.path}: no point of class {MOVING}: {_why_none(cloud.path)}")
    with written_aside(task.output) as aside:
        _write_places(aside, task, sure, start_ns, cloud, metres)
        if task.ways is not None:
            with written_aside(task.ways) as other:
                _write_ways(other, task.ways.suffix, sure, start_ns, cloud, metres)
    return made


def _why_none(path: Path) -> str:
    """Why a cloud has nothing of the class, as far as the folder of its flight knows."""
    beside = path.parent / QUALITY
    try:
        points = json.loads(beside.read_text(encoding="utf-8"))["points"]
        classed, said = "classes" in points, warnings_in(points)
    except (OSError, ValueError, KeyError, TypeError):
        return "`swath process` gives it to what moved; clouds of other programs have nothing to tell it by"
    if not classed:
        return "its classes were not asked for; leave `--attributes` out, or name classes there"
    if said:
        return "; ".join(said)
    return "no beam passed through a place where something was at another time; a place that was looked at once tells nothing"


def _points(cloud: reader.Cloud, week: int | None, progress: Progress) -> tuple[npt.NDArray[np.int64], Array]:
    """Times and places of what moved, in the order of time; nobody is asked for the week of a cloud without any."""
    times, places = [np.empty(0, np.int64)], [np.empty((0, 3))]
    clock = Clock(week)
    for chunk in reader.chunks(cloud, columns=("classification",)):
        some = chunk.points.columns.get("classification", np.zeros(len(chunk.points), np.uint8)) == MOVING
        time_s = np.asarray(chunk.record.gps_time, np.float64)
        clock = clock.begun(time_s) if cloud.week_time else clock
        if some.any():
            times.append(clock.utc_ns(cloud.path, cloud.week_time, time_s[some]))
            places.append(chunk.points.xyz_m[some])
        else:
            clock.utc_ns(cloud.path, False, time_s)  # they have to be times at all
        progress(len(some))
    time_ns, xyz = np.concatenate(times), np.concatenate(places)
    order = np.argsort(time_ns, kind="stable")
    return time_ns[order], xyz[order]


def _bursts(time_s: Array, xyz_m: Array) -> list[Burst]:
    """Stretch by stretch; one ends where nothing was seen for a moment, so that no burst is cut."""
    found: list[Burst] = []
    quiet = np.flatnonzero(np.diff(time_s) > 0.02) + 1
    begin = 0
    while begin < len(time_s):
        after = np.searchsorted(time_s, time_s[begin] + _STRETCH_S)
        later = quiet[np.searchsorted(quiet, after) :]
        end = int(later[0]) if len(later) and after < len(time_s) else len(time_s)
        found += bursts(time_s[begin:end], xyz_m[begin:end])
        begin = end
    return found


def _write_places(aside: Path, task: Task, found: list[Track], start_ns: int, cloud: Any, metres: Any) -> None:
    """A point for each thing and time."""
    rows: list[tuple[int, Track, int]] = []
    for number, track in enumerate(found, 1):
        last = -np.inf
        for at, time in enumerate(track.time_s):
            if time - last >= task.every_s - 1e-9:
                rows.append((number, track, at))
                last = float(time)
    places = np.array([track.place_m[at] for _, track, at in rows]).reshape(-1, 3)
    speed = np.array([np.hypot(*track.velocity_m_s[at]) for _, track, at in rows], np.float64)
    heading = np.array([np.rad2deg(np.arctan2(*track.velocity_m_s[at])) % 360.0 for _, track, at in rows], np.float64)
    columns: dict[str, npt.NDArray[Any]] = {
        "thing": np.array([number for number, _, _ in rows], np.int32),
        "time": np.array([utc_text(start_ns + round(track.time_s[at] * 1e9)) for _, track, at in rows], object),
        "speed_m_s": speed,
        "speed_sigma_m_s": np.array([track.sigma_m_s[at] for _, track, at in rows], np.float64),
        "heading_deg": heading,
    }
    for axis, name in enumerate(("length_m", "width_m", "height_m")):
        columns[name] = np.array([track.size_m[axis] for _, track, _ in rows], np.float64)
    shapes = np.array(shapely.points(metres.back(places)), object)
    write_features(aside, Features(shapes, columns, cloud.horizontal), "Point Z", "moving", task.output.suffix)


def _write_ways(aside: Path, ending: str, found: list[Track], start_ns: int, cloud: Any, metres: Any) -> None:
    """A line for each thing."""
    columns: dict[str, npt.NDArray[Any]] = {
        "thing": np.arange(1, len(found) + 1, dtype=np.int32),
        "begin": np.array([utc_text(start_ns + round(each.time_s[0] * 1e9)) for each in found], object),
        "end": np.array([utc_text(start_ns + round(each.time_s[-1] * 1e9)) for each in found], object),
        "speed_m_s": np.array([each.mean_m_s for each in found], np.float64),
        "speed_sigma_m_s": np.array([each.mean_sigma_m_s for each in found], np.float64),
        "points": np.array([each.points for each in found], np.int32),
    }
    shapes = np.array([shapely.LineString(metres.back(each.place_m)) for each in found], object)
    write_features(aside, Features(shapes, columns, cloud.horizontal), "LineString Z", "ways", ending)
