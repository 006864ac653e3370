"""Simulated flights, and readers of what they wrote that owe nothing to our own decoders."""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from simulator.config import Options
from simulator.render import render
from simulator.simulation import Job

# 63-9113 Rev A, page 10, retyped: elevation of each laser in firing order
ELEVATIONS_DEG = np.array([v for k in range(16) for v in (-30.67 + k * 4 / 3, -9.33 + k * 4 / 3)])


@dataclass
class Captured:
    """A pcap file, taken apart by hand."""

    frames: list[tuple[float, bytes]] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> "Captured":
        content = path.read_bytes()
        assert struct.unpack_from("<IHHiIII", content) == (0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
        captured, at = cls(), 24
        while at < len(content):
            seconds, micros, size, original = struct.unpack_from("<4I", content, at)
            assert size == original
            captured.frames.append((seconds + micros * 1e-6, content[at + 16 : at + 16 + size]))
            at += 16 + size
        return captured

    def payloads(self, size: int) -> npt.NDArray[np.uint8]:
        joined = b"".join(frame[42:] for _, frame in self.frames if len(frame) == size + 42)
        return np.frombuffer(joined, np.uint8).reshape(-1, size)

    def arrival_s(self, size: int) -> npt.NDArray[np.float64]:
        return np.array([time_s for time_s, frame in self.frames if len(frame) == size + 42])


@dataclass
class Shots:
    """Data packets of 1206 bytes, cut by the manual's table."""

    payloads: npt.NDArray[np.uint8]

    @cached_property
    def stamp_us(self) -> npt.NDArray[np.int64]:
        return self.payloads[:, 1200:1204].copy().view("<u4")[:, 0].astype(np.int64)

    @cached_property
    def _blocks(self) -> npt.NDArray[np.uint8]:
        return self.payloads[:, :1200].reshape(-1, 12, 100)

    @cached_property
    def azimuth_deg(self) -> npt.NDArray[np.float64]:
        return self._blocks[:, :, 2:4].copy().view("<u2")[..., 0] * 0.01

    @cached_property
    def range_m(self) -> npt.NDArray[np.float64]:
        returns = self._blocks[:, :, 4:].reshape(-1, 12, 32, 3).astype(np.int64)
        return (returns[..., 0] + 256 * returns[..., 1]) * 0.002

    @cached_property
    def intensity(self) -> npt.NDArray[np.uint8]:
        return self._blocks[:, :, 4:].reshape(-1, 12, 32, 3)[..., 2]

    def time_s(self, firing_of_block: npt.NDArray[np.int64] | None = None) -> npt.NDArray[np.float64]:
        """Time of each shot on the lidar's clock, shape (packets, 12, 32)."""
        firing = np.arange(12) if firing_of_block is None else firing_of_block
        offset_us = 46.08 * firing[:, None] + 1.152 * np.arange(32)
        return np.asarray((self.stamp_us[:, None, None] + offset_us) * 1e-6)

    def points_m(self, rpm: float) -> npt.NDArray[np.float64]:
        """Points in the sensor frame, shape (packets, 12, 32, 3)."""
        turned = rpm * 6.0 * 1.152e-6 * np.arange(32)
        azimuth, elevation = np.radians(self.azimuth_deg[..., None] + turned), np.radians(ELEVATIONS_DEG)
        across = self.range_m * np.cos(elevation)
        return np.stack([across * np.sin(azimuth), across * np.cos(azimuth), self.range_m * np.sin(elevation)], axis=-1)


@dataclass
class Recorded:
    """The files of one simulation."""

    directory: Path

    @cached_property
    def capture(self) -> Captured:
        return Captured.read(self.directory / "capture.pcap")

    @cached_property
    def shots(self) -> Shots:
        return Shots(self.capture.payloads(1206))

    @cached_property
    def truth(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.directory / "truth.json").read_text())
        return content

    @cached_property
    def poses(self) -> npt.NDArray[np.void]:
        return np.asarray(np.genfromtxt(self.directory / "truth.csv", delimiter=",", names=True, dtype=None))

    @cached_property
    def points(self) -> npt.NDArray[np.void]:
        return np.asarray(np.load(self.directory / "truth_points.npy"))

    @cached_property
    def pose_time_s(self) -> npt.NDArray[np.float64]:
        """True seconds since start."""
        return np.asarray((self.poses["utc_ns"] - self.truth["clocks"]["utc"]["start_ns"]) * 1e-9)

    def true_time_s(self, clock: str, reading_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """True seconds since start at which a clock shows what it does."""
        values = self.truth["clocks"][clock]
        return (reading_s - values["start_ns"] * 1e-9) / (1 + values["drift_ppm"] * 1e-6)

    def mavlink(self) -> list[tuple[float, Any]]:
        """Messages of the tlog as pymavlink reads them, with host seconds."""
        from pymavlink import mavutil

        log = mavutil.mavlink_connection(str(self.directory / "telemetry.tlog"), dialect="ardupilotmega")
        messages = []
        while (message := log.recv_msg()) is not None:
            messages.append((message._timestamp, message))
        log.close()
        return messages


def columns_about(axis: int, angle: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Right-handed rotation matrices about x (0), y (1) or z (2) for column vectors, shape (n, 3, 3)."""
    mat = np.zeros((len(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    mat[:, axis, axis] = 1.0
    mat[:, i, i] = mat[:, j, j] = np.cos(angle)
    mat[:, j, i], mat[:, i, j] = np.sin(angle), -np.sin(angle)
    return mat


@pytest.fixture(scope="session")
def about() -> Callable[[int, npt.NDArray[np.float64]], npt.NDArray[np.float64]]:
    return columns_about


@pytest.fixture(scope="session")
def attitudes() -> Callable[[npt.NDArray[np.void]], npt.NDArray[np.float64]]:
    """Attitude of truth.csv's rows as matrices "local from ins": heading clockwise, then nose up, then right side down."""

    def matrices(poses: npt.NDArray[np.void]) -> npt.NDArray[np.float64]:
        heading, pitch, roll = (np.radians(poses[name]) for name in ("heading_deg", "pitch_deg", "roll_deg"))
        return np.asarray(columns_about(2, -heading) @ columns_about(0, pitch) @ columns_about(1, roll))

    return matrices


@pytest.fixture(scope="session")
def simulate(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Recorded]:
    """Run a simulation: simulate(scene, seconds, options=..., seed=..., workers=..., points=...)."""

    def run(
        scene: str,
        seconds: float,
        options: Options | None = None,
        *,
        seed: int = 3,
        workers: int = 2,
        points: bool = False,
    ) -> Recorded:
        directory = tmp_path_factory.mktemp(scene)
        render(Job(scene, seconds, seed, directory, options or Options(), workers, points))
        return Recorded(directory)

    return run


@pytest.fixture(scope="session")
def field_flight(simulate: Callable[..., Recorded]) -> Recorded:
    """Six seconds over flat ground towards a wall, with all errors."""
    return simulate("field", 6.0, points=True)


@pytest.fixture(scope="session")
def village_dual(simulate: Callable[..., Recorded]) -> Recorded:
    """Three seconds in the village in dual return mode."""
    options = Options()
    return simulate("village", 3.0, replace(options, lidar=replace(options.lidar, returns="dual")), points=True)


@pytest.fixture(scope="session")
def tripod(simulate: Callable[..., Recorded]) -> Recorded:
    """Two seconds among reference panels, standing still."""
    return simulate("panels", 2.0, points=True)
