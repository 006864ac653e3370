"""What stays of a live session: the trajectory as it went, and the thinned cloud."""

import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np

from flightlog import frames
from flightlog.errors import SourceError
from groundproc import geodesy
from groundproc.cloud.packer import round_origin_m
from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter
from groundproc.files import written_aside
from groundproc.flight.positions.posetable import COLUMNS
from groundproc.geodesy import LocalFrame
from groundproc.live.place import Place
from groundproc.live.voxelcloud import VoxelCloud

MORE_COLUMNS: Final = ("lidar_ns", "matched", "seen", "residual_m", "lag_s")
_FORMATS: Final = "%.9f,%.9f,%.4f,%.4f,%.4f,%.4f,%.5f,%.5f,%.5f,%.4f,%.4f,%.4f,%.4f,%.4f,%.4f"
_PART: Final = 500_000


class LiveTrajectory:
    """trajectory_live.csv: a row for each slice, in the columns of trajectory.csv and some more, readable at any time.

    Parameters
    ----------
    path : Path

    Raises
    ------
    SourceError
        It cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._last_ns = path, -1
        self.rows = 0
        try:
            self._file = path.open("w", encoding="ascii", newline="\n")
            self._file.write(",".join((*COLUMNS, *MORE_COLUMNS)) + "\n")
        except OSError as error:
            raise SourceError(f"{path}: cannot be written ({error.strerror})") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        lost = isinstance(error, SourceError)
        try:
            self._file.close()
        except OSError as failed:
            lost = True
            if error is None:
                raise SourceError(f"{self._path}: cannot be written ({failed.strerror})") from None
        finally:
            if lost:
                self._leave_whole()

    def _leave_whole(self) -> None:
        """Take off a row that a full disk cut, and the file where no row is left."""
        with contextlib.suppress(OSError):
            content = self._path.read_bytes()
            whole = content.rfind(b"\n") + 1
            if whole < len(content):
                os.truncate(self._path, whole)
            if content.count(b"\n", 0, whole) < 2:
                self._path.unlink()

    def write(self, place: Place, frame: LocalFrame, lag_s: float) -> None:
        """Append a row; one that is not later than the last is left out, for the lidar's clock was set."""
        if place.utc_ns <= self._last_ns:
            return
        self._last_ns = place.utc_ns
        heading, pitch, roll = frames.attitude_of(frames.mat_from_quat(place.quat_local_ins_wxyz[None]))
        geodetic = (float(value[0]) for value in frame.to_geodetic(place.position_m[None]))
        heading_deg = round(float(np.rad2deg(heading[0])) % 360.0, 5) % 360.0
        row = (
            *geodetic, *place.position_m.tolist(), float(np.rad2deg(roll[0])), float(np.rad2deg(pitch[0])), heading_deg,
            *place.sigma_m.tolist(), *np.rad2deg(place.sigma_rad).tolist(),
        )  # fmt: skip
        residual = f"{place.residual_m:.4f}" if np.isfinite(place.residual_m) else ""
        more = f"{place.end_ns},{place.matched},{place.seen},{residual},{lag_s:.3f}"
        try:
            self._file.write(f"{place.utc_ns},{_FORMATS % row},{more}\n")
        except OSError as error:
            raise SourceError(f"{self._path}: cannot be written ({error.strerror})") from None
        self.rows += 1

    def flush(self) -> None:
        """Let others see what was written."""
        try:
            self._file.flush()
        except OSError as error:
            raise SourceError(f"{self._path}: cannot be written ({error.strerror})") from None


def write_cloud(path: Path, cloud: VoxelCloud, frame: LocalFrame, utc_offset_ns: int, height: str) -> int:
    """Write the thinned cloud as LAZ in the UTM zone of the place; gives the number of points."""
    xyz, intensity, time_ns = cloud.points()
    if not len(xyz):
        return 0
    crs = geodesy.projected_crs(geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg))
    projection = geodesy.Projection(frame, crs)
    stated = geodesy.with_sea_level(crs) if height == "msl" else crs
    origin_m = round_origin_m(projection.exact(np.zeros((1, 3)))[0])
    with written_aside(path) as aside, CloudWriter(aside, ["intensity"], crs=stated, offset_m=origin_m) as writer:
        for first in range(0, len(xyz), _PART):
            part = slice(first, first + _PART)
            world = projection.exact(xyz[part].astype(np.float64))
            writer.write(Points(time_ns[part] + utc_offset_ns, world, {"intensity": intensity[part]}))
    return len(xyz)
