"""Errors of a cloud: every point against its own true echo, a second of flight at a time.

The floor is the same cloud made with the true trajectory and the true mount: what is left is the sensor's noise, and no trajectory can
do better. Both hold the same points, those that the estimated trajectory covers.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.accuracy import patches
from groundproc.accuracy.alignment import Rigid
from groundproc.accuracy.ground import LEVEL, Ground, cell_keys
from groundproc.accuracy.patches import ESTIMATED, FLOOR, Moments
from groundproc.accuracy.truth import Truth, shot_numbers
from groundproc.cloud.georeference import georeference
from groundproc.cloud.points import Points
from groundproc.flight import load
from groundproc.flight.lidar import lidar_of
from groundproc.sensors.shots import Gate, LaserTable, Shots, turns
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

GATE: Final = Gate(255.0, 105.0, 1.0, 100.0)
"""What `swath process` lets through by default."""
PASS_NS: Final = 2_000_000_000
"""Points of so long a time are one pass over a facade."""
SAME_ECHO_M: Final = 0.5
"""A measured range further than this from the true one belongs to another echo."""
_BINS: Final = np.concatenate([[0.0], np.geomspace(1e-5, 1e4, 901)])
"""Edges of the histograms that medians are taken from: steps of 2.3 %."""


@dataclass(frozen=True, slots=True)
class CloudFigures:
    """Errors of a cloud after one rigid alignment, and of its floor.

    Attributes
    ----------
    points : int
        Compared.
    unmatched : int
        Points of which no true echo was found: the airframe's, and wrong matches of range.
    covered_share : float
        Part of the floor's points that the trajectory covers.
    point_rms_m, point_median_m, floor_point_rms_m, cloud_floor_ratio : float
        Distance of points from their true echoes, and the ratio of the two RMS values.
    surface_rms_m, surface_median_m, floor_surface_rms_m : float
        Distance from the true plane of the echo; mixed echoes left out.
    facade_m, floor_facade_m, facade_floor_ratio : float
        Thickness of facade patches over all passes: mean over patches without the extreme tenths.
    facade_pass_m, floor_facade_pass_m : float
        The same within passes of 2 s.
    facade_patches : int
    ground_revolution_m, floor_ground_revolution_m, ground_revolution_floor_ratio : float
        RMS difference of ground models of 5 cm between consecutive revolutions.
    ground_strip_m, floor_ground_strip_m, ground_strip_floor_ratio : float
        The same between strips of 10 s with at least one between.
    """

    points: int
    unmatched: int
    covered_share: float
    point_rms_m: float
    point_median_m: float
    floor_point_rms_m: float
    cloud_floor_ratio: float
    surface_rms_m: float
    surface_median_m: float
    floor_surface_rms_m: float
    facade_m: float
    floor_facade_m: float
    facade_floor_ratio: float
    facade_pass_m: float
    floor_facade_pass_m: float
    facade_patches: int
    ground_revolution_m: float
    floor_ground_revolution_m: float
    ground_revolution_floor_ratio: float
    ground_strip_m: float
    floor_ground_strip_m: float
    ground_strip_floor_ratio: float


@dataclass(frozen=True, slots=True)
class Section:
    """A horizontal slice through a facade, seen from above.

    Attributes
    ----------
    centre_m : ndarray, shape (3,)
        On the true wall.
    normal : ndarray, shape (2,)
        Of the wall, east and north.
    half_length_m, half_depth_m, half_height_m : float
        Echoes within these of the centre, along the wall, across it, and in height.
    """

    centre_m: Array
    normal: Array
    half_length_m: float = 6.0
    half_depth_m: float = 0.6
    half_height_m: float = 0.15

    def coordinates(self, points_m: Array) -> Array:
        """Along the wall, out of it, and height, from the centre, shape (n, 3)."""
        away = points_m - self.centre_m
        east, north = self.normal
        along = away[:, 1] * east - away[:, 0] * north
        return np.stack([along, away[:, 0] * east + away[:, 1] * north, away[:, 2]], axis=1)

    def holds(self, hits_m: Array) -> npt.NDArray[np.bool_]:
        """Which true echoes lie in it, shape (n,)."""
        limits = np.array([self.half_length_m, self.half_depth_m, self.half_height_m])
        return np.asarray((np.abs(self.coordinates(hits_m)) <= limits).all(axis=1))


@dataclass(frozen=True, slots=True)
class CloudErrors:
    """What `judge_cloud` finds.

    Attributes
    ----------
    figures : CloudFigures
    time_ns : ndarray of int64, shape (s,)
        Start of each piece of about a second.
    point_rms_m, floor_point_rms_m : ndarray, shape (s,)
        Of its points.
    section_m : ndarray, shape (k, 3)
        Estimated points in the section's coordinates.
    section_time_ns : ndarray of int64, shape (k,)
    """

    figures: CloudFigures
    time_ns: Times
    point_rms_m: Array
    floor_point_rms_m: Array
    section_m: Array
    section_time_ns: Times


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
    sums = _Sums(truth, section)
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


class _Sums:
    """All that is kept of the points that went by."""

    def __init__(self, truth: Truth, section: Section | None) -> None:
        self._start_ns, self._section = truth.lidar.start_ns, section
        self._walls = patches.facade_surfaces(truth.surfaces)
        self._compared, self._unmatched, self._of_floor = 0, 0, 0
        self._squares, self._on_surface = np.zeros(2), np.zeros(2)
        self._unmixed = 0
        self._histogram, self._surface_histogram = (np.zeros(len(_BINS) - 1) for _ in range(2))
        self._all, self._pass, self._pass_number = Moments(3), Moments(3), -1
        self._passes: list[Array] = []
        self._ground = Ground(2)
        self._seconds: list[tuple[int, float, float]] = []
        self._slices: list[tuple[Array, Times]] = []

    def add(
        self,
        placed: Points,
        floor: Points,
        motion: Rigid,
        echoes: npt.NDArray[np.void],
        numbers: Times,
        begins_ns: Times,
        revolution: npt.NDArray[np.int64],
    ) -> None:
        """Add the points of a piece: the estimate's, the floor's, the true echoes and their numbers, the revolutions and their begins."""
        self._of_floor += len(floor)
        if not len(placed) or not len(floor) or not len(echoes):
            self._unmatched += len(placed)
            return
        at, of_floor, of_echo = _matched(self._numbers(placed), self._numbers(floor), numbers)
        same = np.abs(placed["range"][at] - echoes["range_m"][of_echo]) < SAME_ECHO_M
        at, of_floor, of_echo = at[same], of_floor[same], of_echo[same]
        self._unmatched += len(placed) - len(at)
        if not len(at):
            return
        hits = np.stack([echoes[axis][of_echo] for axis in "xyz"], axis=1)
        normals = echoes["normal"][of_echo].astype(np.float64)
        surface, pure = echoes["surface"][of_echo], ~echoes["mixed"][of_echo]
        found, best = motion.points(placed.xyz_m[at]), floor.xyz_m[of_floor]
        time_ns = placed.time_ns[at]
        self._points(hits, found, best, int(time_ns[0]))
        self._surfaces(hits[pure], normals[pure], found[pure], best[pure])
        wall = np.flatnonzero(pure & (np.abs(normals[:, 2]) < patches.STEEPEST) & self._walls[surface])
        keys = patches.patch_keys(hits[wall], normals[wall], surface[wall])
        self._facades(keys, hits[wall], found[wall], best[wall], time_ns[wall])
        level = np.flatnonzero(pure & (normals[:, 2] > LEVEL))
        turn = np.clip(np.searchsorted(begins_ns, time_ns[level], side="right") - 1, 0, len(begins_ns) - 1)
        heights = np.stack([found[level, 2], best[level, 2]], axis=1)
        self._ground.add(cell_keys(hits[level], surface[level]), heights, revolution[turn], time_ns[level])
        if self._section is not None:
            inside = self._section.holds(hits)
            self._slices.append((self._section.coordinates(found[inside]), time_ns[inside]))

    def _numbers(self, points: Points) -> Times:
        rank = points["return_number"].astype(np.int64) - 1
        return shot_numbers(points.time_ns, points["laser"], rank, self._start_ns)

    def _points(self, hits: Array, found: Array, best: Array, time_ns: int) -> None:
        square = np.stack([np.square(points - hits).sum(axis=1) for points in (found, best)], axis=1)
        self._compared += len(hits)
        self._squares += square.sum(axis=0)
        self._histogram += np.histogram(np.sqrt(square[:, 0]), _BINS)[0]
        here, floor = np.sqrt(square.mean(axis=0)).tolist()
        self._seconds.append((time_ns, here, floor))

    def _surfaces(self, hits: Array, normals: Array, found: Array, best: Array) -> None:
        away = np.stack([np.einsum("ni,ni->n", points - hits, normals) for points in (found, best)], axis=1)
        self._unmixed += len(hits)
        self._on_surface += np.square(away).sum(axis=0)
        self._surface_histogram += np.histogram(np.abs(away[:, 0]), _BINS)[0]

    def _facades(self, keys: Times, hits: Array, found: Array, best: Array, time_ns: Times) -> None:
        self._all.add(keys, hits, hits, found, best)
        number = time_ns // PASS_NS
        for part in np.split(np.arange(len(number)), np.flatnonzero(np.diff(number)) + 1):
            if len(part) and int(number[part[0]]) != self._pass_number:
                self._close_pass()
                self._pass_number = int(number[part[0]])
            self._pass.add(keys[part], hits[part], hits[part], found[part], best[part])

    def _close_pass(self) -> None:
        thin = [patches.thickness_m(self._pass, which) for which in (ESTIMATED, FLOOR)]
        self._passes.append(np.stack(thin, axis=1))
        self._pass = Moments(3)

    def result(self) -> CloudErrors:
        """The figures of all that was added."""
        self._close_pass()
        self._ground.finish()
        points, floor = np.sqrt(self._squares / max(self._compared, 1)).tolist()
        surface, floor_surface = np.sqrt(self._on_surface / max(self._unmixed, 1)).tolist()
        thin = [patches.thickness_m(self._all, which) for which in (ESTIMATED, FLOOR)]
        facade, floor_facade = (patches.trimmed_mean(values) for values in thin)
        within, floor_within = (patches.trimmed_mean(values) for values in np.concatenate(self._passes).T)
        turn, floor_turn = self._ground.revolutions.rms_m().tolist()
        strip, floor_strip = self._ground.strips.rms_m().tolist()
        figures = CloudFigures(
            points=self._compared,
            unmatched=self._unmatched,
            covered_share=(self._compared + self._unmatched) / max(self._of_floor, 1),
            point_rms_m=points,
            point_median_m=_median(self._histogram),
            floor_point_rms_m=floor,
            cloud_floor_ratio=_ratio(points, floor),
            surface_rms_m=surface,
            surface_median_m=_median(self._surface_histogram),
            floor_surface_rms_m=floor_surface,
            facade_m=facade,
            floor_facade_m=floor_facade,
            facade_floor_ratio=_ratio(facade, floor_facade),
            facade_pass_m=within,
            floor_facade_pass_m=floor_within,
            facade_patches=len(thin[0]),
            ground_revolution_m=turn,
            floor_ground_revolution_m=floor_turn,
            ground_revolution_floor_ratio=_ratio(turn, floor_turn),
            ground_strip_m=strip,
            floor_ground_strip_m=floor_strip,
            ground_strip_floor_ratio=_ratio(strip, floor_strip),
        )
        seconds = np.array([row[1:] for row in self._seconds]).reshape(-1, 2)
        slices = [(np.zeros((0, 3)), np.zeros(0, np.int64)), *self._slices]
        return CloudErrors(
            figures,
            np.array([row[0] for row in self._seconds], np.int64),
            seconds[:, 0],
            seconds[:, 1],
            np.concatenate([points for points, _ in slices]),
            np.concatenate([times for _, times in slices]),
        )


@njit(cache=True, nogil=True)
def _matched(ours: Any, theirs: Any, echoes: Any) -> Any:
    """Places in three growing lists of numbers where all three hold the same number."""
    found = np.empty((3, len(ours)), np.int64)
    count, j, k = 0, 0, 0
    for i in range(len(ours)):
        while j < len(theirs) and theirs[j] < ours[i]:
            j += 1
        while k < len(echoes) and echoes[k] < ours[i]:
            k += 1
        if j < len(theirs) and k < len(echoes) and theirs[j] == ours[i] and echoes[k] == ours[i]:
            found[0, count], found[1, count], found[2, count] = i, j, k
            count += 1
    return found[0, :count], found[1, :count], found[2, :count]


def _median(histogram: Array) -> float:
    """The median of what a histogram over `_BINS` counts; not a number where it is empty."""
    total = histogram.sum()
    if not total:
        return float("nan")
    return float(np.interp(0.5 * total, np.concatenate([[0.0], np.cumsum(histogram)]), _BINS))


def _ratio(value: float, floor: float) -> float:
    """A value in parts of its floor; not a number where there is no floor."""
    return value / floor if floor > 0.0 else float("nan")


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
