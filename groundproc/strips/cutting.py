"""Strips: stretches of time between which surfaces are compared."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from flightlog import frames
from groundproc.numerics.filters import peaks
from groundproc.strips.route import Route
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

BIN_NS: Final = 100_000_000
"""Time is looked at in bins of this length."""
WINDOW_S: Final = 6.0
"""A turn is what changes the course within this time."""
_HALF: Final = int(WINDOW_S / 2 * 1e9 / BIN_NS)
"""Bins of half of that."""
_WIDE_RAD: Final = np.deg2rad(100.0)
_PAUSE_NS: Final = 60_000_000_000
"""Between two poses: who has not flown for so long begins another line."""
_SLOWEST_M_S: Final = 0.3
_MIXED: Final = 5
"""More changes than this for each id say that ids do not follow each other in time: tiles, or two scanners at once."""


@dataclass(frozen=True, slots=True)
class Strips:
    """Strips in order of time.

    Attributes
    ----------
    start_ns : int
        UTC of the first bin.
    of_bin : ndarray of int32, shape (bins,)
        Strip of each bin; -1 where there are no points.
    first_bin, last_bin : ndarray of int64, shape (strips,)
    by : str
        What they were cut by.
    """

    start_ns: int
    of_bin: npt.NDArray[np.int32]
    first_bin: Ints
    last_bin: Ints
    by: str

    def __len__(self) -> int:
        return len(self.first_bin)

    def of(self, time_ns: Ints) -> npt.NDArray[np.int32]:
        """Strip of each time, shape (n,); -1 for none."""
        place = np.clip((time_ns - self.start_ns) // BIN_NS, 0, len(self.of_bin) - 1)
        return np.asarray(self.of_bin[place])


@dataclass(slots=True)
class Occupancy:
    """When there are points, and of which source: filled chunk by chunk.

    Parameters
    ----------
    route : Route
    """

    route: Route
    start_ns: int = field(init=False)
    points: Ints = field(init=False)
    source: Ints = field(init=False)
    file: Ints = field(init=False)

    def __post_init__(self) -> None:
        times = self.route.poses.time_ns
        self.start_ns = int(times[0])
        bins = int((times[-1] - times[0]) // BIN_NS) + 1
        self.points = np.zeros(bins, np.int64)
        self.source, self.file = np.zeros(bins, np.int64), np.zeros(bins, np.int64)

    def add(self, time_ns: Ints, source: Ints, file: int) -> None:
        """Take points within the route, shape (n,)."""
        place = (time_ns - self.start_ns) // BIN_NS
        self.points += np.bincount(place, minlength=len(self.points))
        self.source[place] = source
        self.file[place] = file

    def cut(self, gap_s: float, turn_deg: float) -> Strips:
        """Strips: by point source id or by file where those follow each other in time, else by turns; and by gaps."""
        used = np.flatnonzero(self.points)
        ids, by = self._ids(used)
        edges = np.zeros(len(self.points), np.bool_)
        if ids is None:
            edges[self._turns(turn_deg)] = True
        gap = round(gap_s * 1e9 / BIN_NS)
        number = np.zeros(len(used), np.int64)
        if len(used):
            step = np.diff(used) > gap
            turned = np.cumsum(edges)
            step |= np.diff(turned[used]) > 0
            if ids is not None:
                step |= np.diff(ids[used]) != 0
            number[1:] = np.cumsum(step)
        of_bin = np.full(len(self.points), -1, np.int32)
        of_bin[used] = number
        count = int(number[-1]) + 1 if len(used) else 0
        first = used[np.searchsorted(number, np.arange(count))]
        last = used[np.searchsorted(number, np.arange(count), side="right") - 1]
        return Strips(self.start_ns, of_bin, first, last, f"{by} and gaps of {gap_s:g} s")

    def _ids(self, used: Ints) -> tuple[Ints | None, str]:
        for ids, by in ((self.source, "point source id"), (self.file, "file")):
            of_used = ids[used]
            kinds = len(np.unique(of_used))
            if kinds > 1 and int((np.diff(of_used) != 0).sum()) <= _MIXED * kinds:
                return ids, by
        return None, "turns"

    def _turns(self, turn_deg: float) -> Ints:
        return turns(self.route.poses, self.start_ns, len(self.points), turn_deg)


def line_begins_ns(trajectory: Trajectory, turn_deg: float) -> Ints:
    """Times [ns], shape (k,), at which another flight line begins; the first line has none.

    The middle of each turn, as strips are cut, and the end of a pause: so work follows the poses, and not the time between two of them.
    """
    begins: list[Ints] = []
    for part, start_ns, bins in flown(trajectory):
        if begins:
            begins.append(np.array([start_ns], np.int64))
        begins.append(start_ns + BIN_NS * turns(part, start_ns, bins, turn_deg))
    return np.concatenate(begins)


def flown(trajectory: Trajectory) -> Iterator[tuple[Trajectory, int, int]]:
    """Pieces of a flight without long pauses: poses, when the first bin begins, and the number of bins."""
    edges = [0, *(np.flatnonzero(np.diff(trajectory.time_ns) > _PAUSE_NS) + 1), len(trajectory)]
    for first, last in itertools.pairwise(edges):
        part = trajectory.part(slice(int(first), int(last)))
        start_ns = int(part.time_ns[0])
        yield part, start_ns, int((part.time_ns[-1] - start_ns) // BIN_NS) + 1


def turns(poses: Trajectory, start_ns: int, bins: int, turn_deg: float) -> Ints:
    """Bins in the middle of turns, of so many from a time on."""
    course, change = courses(velocities(poses, start_ns, bins))
    half = _HALF
    found = peaks(change, np.deg2rad(turn_deg), np.deg2rad(turn_deg) / 4, half).tolist()
    # a wide turn or a circle has no peak: what turns in its inner part is cut where the course is half-way
    left = list(itertools.pairwise([0, *found, bins - 1]))
    while left:
        start, end = left.pop()
        low, high = start + (end - start) // 5, end - (end - start) // 5
        turned = np.abs(course[low : high + 1] - course[low])
        if end - start < half or turned[-1] < _WIDE_RAD:
            continue
        middle = low + int(np.argmax(turned >= 0.5 * turned[-1]))
        found.append(middle)
        left += [(start, middle), (middle, end)]
    return np.array(sorted(found), np.int64)


def velocities(poses: Trajectory, start_ns: int, bins: int) -> Array:
    """Smoothed velocity in each bin, shape (bins, 3): over a second, what gusts do is gone."""
    times = start_ns + np.arange(bins) * BIN_NS
    place = np.clip(np.searchsorted(poses.time_ns, times), 0, len(poses) - 1)
    smooth = gaussian_filter1d(poses.velocity_m_s[place], 1e9 / BIN_NS, axis=0, mode="nearest")
    return np.asarray(smooth, np.float64)


def courses(velocity_m_s: Array) -> tuple[Array, Array]:
    """Course in each bin [rad], unwrapped, and by how much it changes within `WINDOW_S` around, shape (bins,) each.

    Who stands keeps the course that he had; who never flies has none, and all is 0.
    """
    bins = len(velocity_m_s)
    fast = np.hypot(velocity_m_s[:, 0], velocity_m_s[:, 1]) > _SLOWEST_M_S
    if not fast.any():
        return np.zeros(bins), np.zeros(bins)
    course = np.arctan2(velocity_m_s[:, 0], velocity_m_s[:, 1])
    course = np.unwrap(course[np.maximum.accumulate(np.where(fast, np.arange(bins), np.argmax(fast)))])
    padded = np.pad(course, _HALF, mode="edge")
    return course, np.abs(padded[2 * _HALF :] - padded[: -2 * _HALF])


def headings_differ(route: Route, strips: Strips) -> float:
    """Largest angle between the mean headings of two strips [rad]: constants of the mount show by it."""
    middle = route.poses.time_ns[0] + (strips.first_bin + strips.last_bin) // 2 * BIN_NS
    poses, covered = route.poses.where_covered(middle)
    if not covered.any():
        return 0.0
    heading, _, _ = frames.attitude_of(frames.mat_from_quat(poses.quat_local_ins_wxyz[covered]))
    apart = np.abs((heading[:, None] - heading[None] + np.pi) % (2 * np.pi) - np.pi)
    return float(apart.max())
