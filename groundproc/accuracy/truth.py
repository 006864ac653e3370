"""What really was in a simulated flight: poses, mount and true echoes, all on the lidar's clock.

Estimate and truth are compared at the lidar's own stamps, because a cloud hangs on them: an error of the clock between lidar and
autopilot then counts as the error of the pose that it is, and an error in the label UTC, which moves nothing, does not count.
"""

import bisect
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import config
from flightlog.constants import HOUR_NS
from flightlog.errors import LogError
from flightlog.mount import Mount
from groundproc import sensors
from groundproc.flight.timeline import Line
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.table import read_trajectory
from groundproc.trajectory.trajectory import Trajectory

Times = npt.NDArray[np.int64]

LOG: Final = "flight.mcap"
HITS: Final = "truth_points.npy"


@dataclass(frozen=True, slots=True)
class Clock:
    """A clock that shows `start_ns` at the flight's start and goes `drift_ppm` too fast."""

    start_ns: int
    drift_ppm: float

    def elapsed_s(self, time_ns: Times) -> npt.NDArray[np.float64]:
        """True seconds since the start when it shows times, shape (n,)."""
        return np.asarray((time_ns - self.start_ns) * 1e-9 / (1.0 + self.drift_ppm * 1e-6))

    def shows_ns(self, elapsed_s: npt.NDArray[np.float64]) -> Times:
        """What it shows so many true seconds after the start, shape (n,)."""
        return np.asarray(self.start_ns + np.rint(elapsed_s * 1e9 * (1.0 + self.drift_ppm * 1e-6)).astype(np.int64))


@dataclass(frozen=True, slots=True)
class Truth:
    """The truth of one flight.

    Attributes
    ----------
    folder : Path
    frame : LocalFrame
        Of its positions and echoes; heights above mean sea level.
    trajectory : Trajectory
        True poses of the INS origin; times are the lidar's clock [ns], unwrapped.
    mount : Mount
        The true one.
    nominal_mount : Mount
    utc, lidar : Clock
    surfaces : tuple of str
        Names of the surfaces that echoes lie on.
    duration_s : float
    content : dict
        All of truth.json.
    """

    folder: Path
    frame: LocalFrame
    trajectory: Trajectory
    mount: Mount
    nominal_mount: Mount
    utc: Clock
    lidar: Clock
    surfaces: tuple[str, ...]
    duration_s: float
    content: dict[str, Any]

    @property
    def log(self) -> Path:
        """The flight's log."""
        return self.folder / LOG

    def hits(self) -> "Hits":
        """The true echoes, to be read in order of time.

        Raises
        ------
        LogError
            The flight was simulated without them.
        """
        path = self.folder / HITS
        if not self.has_hits:
            raise LogError(f"{path}: is not there; the flight must be simulated with --truth-points")
        return Hits(np.load(path, mmap_mode="r"), self.lidar.start_ns)

    @property
    def has_hits(self) -> bool:
        """Whether the flight was simulated with its true echoes."""
        return (self.folder / HITS).is_file()

    def from_device_ns(self, device_ns: Times) -> Times:
        """The lidar's clock as the truth counts it, of times that a reader carried on over the hours, shape (n,)."""
        if not len(device_ns):
            return device_ns
        hours = round((int(device_ns[0]) - self.lidar.start_ns) / HOUR_NS)
        return np.asarray(device_ns - hours * HOUR_NS)


def read_truth(folder: Path) -> Truth:
    """Read truth.json and truth.csv of a simulated flight.

    Raises
    ------
    LogError
        A file is missing or is not what the simulator writes.
    """
    path = folder / "truth.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: cannot be read as the truth of a simulated flight ({error})") from None
    try:
        origin, clocks = content["local_origin"], content["clocks"]
        frame = LocalFrame(origin["latitude_deg"], origin["longitude_deg"], origin["height_msl_m"])
        mount, nominal = (
            config.from_mapping(content[name], Mount, f"{path}: {name}") for name in ("mount_true", "mount_nominal")
        )
        utc, lidar = (Clock(clocks[name]["start_ns"], clocks[name]["drift_ppm"]) for name in ("utc", "lidar"))
        surfaces, duration_s = tuple(content["surfaces"]), float(content["duration_s"])
    except KeyError as error:
        raise LogError(f"{path}: {error} is missing; expected what swath simulate writes") from None
    poses = read_trajectory(folder / "truth.csv", frame)
    poses = replace(poses, time_ns=lidar.shows_ns(utc.elapsed_s(poses.time_ns)))
    return Truth(folder, frame, poses, mount, nominal, utc, lidar, surfaces, duration_s, content)


def on_lidar_clock(trajectory: Trajectory, lines: Sequence[Line], truth: Truth) -> Trajectory:
    """An estimated trajectory in UTC, put on the lidar's clock and into the truth's local frame.

    Parameters
    ----------
    trajectory : Trajectory
    lines : sequence of Line
        From lidar time to UTC, as the points were given theirs: `Leg.lidar_line`.
    truth : Truth
    """
    time_ns = trajectory.time_ns
    for line in reversed(lines):
        time_ns = line.inverse()(time_ns)
    position = truth.frame.from_geodetic(*trajectory.frame.to_geodetic(trajectory.position_m))
    return replace(trajectory, frame=truth.frame, time_ns=truth.from_device_ns(time_ns), position_m=position)


def shot_numbers(
    time_ns: Times, laser: npt.NDArray[np.uint8], rank: npt.NDArray[np.integer[Any]], start_ns: int
) -> Times:
    """A number for each echo that grows with time, shape (n,): twice the running number of its shot, plus its rank by range.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (n,)
        Lidar time of the shot; cut to a microsecond, as packets have it, will do.
    laser, rank : ndarray, shape (n,)
        Rank 0 is the nearest echo of a shot.
    start_ns : int
        Lidar time of the flight's first shot.
    """
    lidar = sensors.lidar(sensors.FLOWN)  # which is what the simulator simulates
    late_ns = time_ns - start_ns - laser.astype(np.int64) * lidar.laser_ns
    firing = (late_ns + lidar.firing_ns // 2) // lidar.firing_ns
    return (firing * len(lidar.lasers) + laser) * 2 + rank.astype(np.int64)


class Hits:
    """True echoes in order of time, read piece by piece from the file.

    Parameters
    ----------
    records : ndarray
        As the simulator writes them; may be mapped from a file.
    start_ns : int
        Lidar time of the flight's first shot.
    """

    def __init__(self, records: npt.NDArray[np.void], start_ns: int) -> None:
        self._records, self._start_ns, self._next = records, start_ns, 0

    def until(self, lidar_ns: int) -> tuple[npt.NDArray[np.void], Times]:
        """The echoes not given yet whose shots were before a lidar time [ns], and their shot numbers, in growing order."""
        time = self._records["lidar_ns"]
        end = bisect.bisect_left(range(len(time)), lidar_ns, lo=self._next, key=lambda i: int(time[i]))
        piece = np.array(self._records[self._next : end])
        self._next = end
        stamps = np.ascontiguousarray(piece["lidar_ns"])
        rank = np.zeros(len(piece), np.int64)
        if len(piece) > 1 and (piece["number"] > 0).any():  # the two echoes of a shot stand together: nearest first
            order = np.lexsort((piece["range_m"], stamps))
            piece, stamps = piece[order], stamps[order]
            rank[1:] = stamps[1:] == stamps[:-1]
        return piece, shot_numbers(stamps, piece["laser"], rank, self._start_ns)
