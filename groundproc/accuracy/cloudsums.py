"""What is summed up of a cloud's errors, a second of flight at a time."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.accuracy import patches
from groundproc.accuracy.alignment import Rigid
from groundproc.accuracy.cloudfigures import PASS_NS, CloudErrors, CloudFigures, Section
from groundproc.accuracy.ground import LEVEL, Ground, cell_keys
from groundproc.accuracy.patches import ESTIMATED, FLOOR, Moments
from groundproc.accuracy.truth import Truth, shot_numbers
from groundproc.cloud.points import Points

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
SAME_ECHO_M: Final = 0.5
"""A measured range further than this from the true one belongs to another echo."""
_BINS: Final = np.concatenate([[0.0], np.geomspace(1e-5, 1e4, 901)])
"""Edges of the histograms that medians are taken from: steps of 2.3 %."""


class Sums:
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
