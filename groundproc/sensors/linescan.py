"""A line scanner: one beam that turns in a plane, a line of ranges at a time, on the time base of its kit.

Source of the kind: Nagai, Chen, Ahmed, Shibasaki, *UAV borne mapping by multi sensor integration*: 18 lines a second, 0.25 deg.
Nothing of it is a constant here: each line states its own angles and times. The beam turns in the scanner's xy plane, x right and y
forward; the mount turns forward to the ground.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import records
from flightlog.constants import NS_PER_S
from groundproc.sensors.model import Digest, Ranging, Records, Times
from groundproc.sensors.shots import SINGLE_RETURN, Gate, Gated, LaserTable, Shots

RANGING: Final = Ranging(sigma_m=0.03, divergence_rad=11e-3, pulse_m=1.0)
"""Of scanners of the source's class, by their data sheets (SICK LMS 291: 3 cm, 11 mrad): lines do not state it."""


@dataclass(frozen=True, slots=True)
class LineScanner:
    """See `Lidar`."""

    name: str = "line scanner"
    topic: str = records.LINE_SCAN.topic
    about: str = "line scanner"
    range_step_m: float = 0.0
    ranging: Ranging = RANGING
    firing_ns: int = 0
    laser_ns: int = 0
    idle_ns: int = 0
    records_s: int = 18
    stamp_wraps: bool = False

    @property
    def lasers(self) -> LaserTable:
        """See Lidar: one, in the plane."""
        return LaserTable.of_elevations([0.0])

    @property
    def mode_names(self) -> Mapping[int, str]:
        """See Lidar."""
        return {0: "single"}

    def unpack(self, data: bytes | memoryview) -> Records:
        """See Lidar: `records.line_dtype`."""
        return records.decode_line(data)

    def receive_time_ns(self, lines: Records) -> Times:
        """See Lidar: the kit has one time base."""
        return self.stamp_ns(lines)

    def stamp_ns(self, lines: Records) -> Times:
        """See Lidar."""
        return np.asarray(lines["time_ns"], np.int64)

    def valid(self, lines: Records) -> npt.NDArray[np.bool_]:
        """See Lidar."""
        return np.ones(len(lines), np.bool_)

    def check(self, lines: Records, place: str) -> None:
        """See Lidar: the topic has no other model."""

    def same_kind(self, before: Records, after: Records) -> bool:
        """See Lidar: lines of as many shots."""
        return before.dtype == after.dtype

    def decode(
        self, lines: Records, time_ns: Times, gate: Gate | None = None, lasers: LaserTable | None = None
    ) -> Iterator[Shots]:
        """See Lidar."""
        if len(lines):
            yield _decoded(lines, time_ns, gate or Gate(), lasers or self.lasers)

    def blanks(self) -> Iterator[Records]:
        """See Lidar."""
        yield np.zeros(2, records.line_dtype(4))

    def digest(self, lines: Records) -> Digest:
        """See Lidar."""
        azimuth = np.rint(np.rad2deg(_azimuth_rad(lines)) * 100.0).astype(np.int64) % 36_000
        line_ns = np.rint(lines["scan_time"].astype(np.float64) * NS_PER_S).astype(np.int64)
        returns = int(np.count_nonzero(lines["ranges"] > 0.0))
        return Digest(azimuth, np.zeros(len(lines), np.uint8), line_ns, returns)


LIDAR: Final = LineScanner()


def _azimuth_rad(lines: Records) -> npt.NDArray[np.float64]:
    """Azimuth of every shot, clockwise from forward, shape (n, shots)."""
    step = np.arange(lines["ranges"].shape[1])
    first, increment = (lines[name].astype(np.float64)[:, None] for name in ("angle_min", "angle_increment"))
    return np.asarray(np.pi / 2.0 - (first + step * increment))


def _decoded(lines: Records, time_ns: Times, gate: Gate, lasers: LaserTable) -> Shots:
    """Shots of lines of one length."""
    azimuth = _azimuth_rad(lines)
    shots = azimuth.shape[1]
    late_s = lines["time_increment"].astype(np.float64)[:, None] * np.arange(shots)
    times = (time_ns[:, None] + np.rint(late_s * NS_PER_S).astype(np.int64)).ravel()
    azimuth, ranges = azimuth.ravel(), lines["ranges"].ravel()
    start, width = gate.window_deg()
    # a hair of slack: angles are of float32
    inside = (np.rad2deg(azimuth) - start + 1e-4) % 360.0 <= width + 2e-4
    seen = inside & (ranges > 0.0)  # not a number is no return either
    kept = seen & (ranges >= gate.min_range_m) & (ranges <= gate.max_range_m)
    gated = Gated(int((~inside).sum()), int((inside & ~seen).sum()), int((seen & ~kept).sum()))
    azimuth, ranges = azimuth[kept], ranges[kept]
    intensity = np.clip(np.nan_to_num(lines["intensities"].ravel()[kept]), 0.0, 255.0)
    laser = np.zeros(len(ranges), np.uint8)
    cosine, sine, offset_m, height_m = lasers.kernel_rows()[:, 0]
    reach = ranges + offset_m
    xyz = np.stack(
        [reach * cosine * np.sin(azimuth), reach * cosine * np.cos(azimuth), reach * sine + height_m], axis=1
    )
    return Shots(
        times[kept],
        xyz.astype(np.float32),
        np.ascontiguousarray(ranges),
        np.rint(intensity).astype(np.uint8),
        laser,
        np.full(len(ranges), SINGLE_RETURN, np.uint8),
        lasers,
        gated,
    )
