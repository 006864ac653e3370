"""Errors of a cloud: every point against its own true echo, a second of flight at a time.

The floor is the same cloud made with the true trajectory and the true mount: what is left is the sensor's noise, and no trajectory can
do better. Both hold the same points, those that the estimated trajectory covers.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.accuracy import patches
from groundproc.accuracy.alignment import Rigid
from groundproc.accuracy.cloudfigures import PASS_NS, CloudErrors, Section
from groundproc.accuracy.cloudsums import Sums
from groundproc.accuracy.truth import Truth
from groundproc.cloud.georeference import georeference
from groundproc.flight import load
from groundproc.flight.lidar import lidar_of
from groundproc.sensors.shots import Gate, LaserTable, Shots, turns
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

GATE: Final = Gate(255.0, 105.0, 1.0, 100.0)
"""What `swath process` lets through by default."""


def judge_cloud(
    readers: Sequence[LogReader],
    truth: Truth,
    estimated: Trajectory,
    mount: Mount,
    motion: Rigid,
    lasers: LaserTable | None = None,
    section: Section | None = None,
    gate: Gate = GATE,
) -> CloudErrors:
    """Place every point twice, with the estimate and with the truth, and compare both with the true echoes.

    Parameters
    ----------
    readers : sequence of LogReader
        The flight's logs.
    truth : Truth
        Of a flight simulated with its true echoes.
    estimated : Trajectory
        On the lidar's clock, see `truth.on_lidar_clock`.
    mount : Mount
        That the estimate comes with.
    motion : Rigid
        Brings the estimate onto the truth.
    lasers : LaserTable, optional
        Corrections that the estimate comes with.
    section : Section, optional
        A slice to keep the points of.
    gate : Gate, optional
    """
    sums = Sums(truth, section)
    hits = truth.hits()
    for best, shots, begins_ns, revolution in _pieces(readers, truth, gate, lasers):
        floor = georeference(best, truth.trajectory, truth.mount)
        placed = georeference(shots, estimated, mount)
        echoes, numbers = hits.until(int(best.time_ns[-1]) + 10**6)
        sums.add(placed, floor, motion, echoes, numbers, begins_ns, revolution)
    return sums.result()


def _pieces(
    readers: Sequence[LogReader], truth: Truth, gate: Gate, lasers: LaserTable | None
) -> Iterator[tuple[Shots, Shots, Times, npt.NDArray[np.int64]]]:
    """About a second of shots on the truth's clock, with the manual's lasers and with the given ones; and the begins of their turns.

    The last two are times [ns], shape (k,), from each of which on the shots are of a revolution, and its number.
    """
    lidar = lidar_of(readers)
    waiting: list[load.LidarBatch] = []
    counted = _Turns()
    for batch in [*load.lidar_batches(readers, None, lidar), None]:
        full = sum(len(each.packets) for each in waiting) >= lidar.records_s
        if waiting and (batch is None or full):
            packets = load.joined([each.packets for each in waiting])
            time_ns = truth.from_device_ns(np.concatenate([each.device_time_ns for each in waiting]))
            waiting = []
            both = zip(lidar.decode(packets, time_ns, gate), lidar.decode(packets, time_ns, gate, lasers), strict=True)
            for best, shots in both:
                if len(best):
                    yield best, shots, *counted.count(best)
        if batch is not None and len(batch.packets):
            waiting.append(batch)


class _Turns:
    """Counts the revolutions of the lidar, from behind to behind, where nothing is seen."""

    def __init__(self) -> None:
        self._last_rad: float | None = None
        self._number = 0

    def count(self, shots: Shots) -> tuple[Times, npt.NDArray[np.int64]]:
        """From which times on shots are of which revolution, shape (k,) each."""
        azimuth = shots.azimuth_rad
        begins = turns(azimuth, self._last_rad)
        numbers = self._number + np.arange(len(begins) + 1)
        self._last_rad, self._number = float(azimuth[-1]), int(numbers[-1])
        return np.concatenate([shots.time_ns[:1], shots.time_ns[begins]]), numbers


def choose_section(truth: Truth, every: int = 20) -> Section | None:
    """A slice through the piece of wall that is seen in most passes of 2 s, by every so many-th true echo; None without a wall."""
    hits, walls = truth.hits(), patches.facade_surfaces(truth.surfaces)
    seen: dict[int, tuple[int, int, Array, Array]] = {}
    end_ns = int(truth.trajectory.time_ns[-1])
    for start_ns in range(truth.lidar.start_ns, end_ns + PASS_NS, PASS_NS):
        met, _ = hits.until(start_ns + PASS_NS)
        met = met[::every]
        normals = met["normal"].astype(np.float64)
        met = met[~met["mixed"] & (np.abs(normals[:, 2]) < patches.STEEPEST) & walls[met["surface"]]]
        if not len(met):
            continue
        points, normals = np.stack([met["x"], met["y"], met["z"]], axis=1), met["normal"].astype(np.float64)
        keys, first, count = np.unique(
            patches.patch_keys(points, normals, met["surface"]), return_index=True, return_counts=True
        )
        for key, at, number in zip(keys.tolist(), first.tolist(), count.tolist(), strict=True):
            if number * every < patches.LEAST_POINTS:
                continue
            passes, total, centre, normal = seen.get(key, (0, 0, points[at], normals[at, :2]))
            seen[key] = passes + 1, total + number, centre, normal
    if not seen:
        return None
    *_, centre, normal = max(seen.values(), key=lambda patch: patch[:2])
    return Section(centre, normal / np.linalg.norm(normal))
