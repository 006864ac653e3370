"""Manoeuvres of a flight as spans of time: turns, take-off and landing, of which a survey may want no points."""

from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.strips.cutting import BIN_NS, courses, flown, velocities
from groundproc.trajectory.trajectory import Trajectory

Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_ENDS: Final = 0.05
"""Share of what a turn changes the course by that belongs to the lines before and behind it."""
_UNDER_WAY_M_S: Final = 1.0
"""Over ground: as for the angle of a scan, what is slower has no line of flight."""
_CLIMB: Final = 0.5
"""Vertical by horizontal speed: what is steeper climbs or lands, and does not fly a line."""
_STEADY_NS: Final = 3_000_000_000
"""A line begins with so long of it."""


def turns_ns(trajectory: Trajectory, turn_deg: float) -> Ints:
    """Spans in which the course changes by so much within six seconds, shape (k, 2) [ns].

    Each begins and ends where 5 and 95 % of the change is done, so that a sharp corner costs little and a circle all that it is.
    """
    spans: list[tuple[int, int]] = []
    for part, start_ns, bins in flown(trajectory):
        course, change = courses(velocities(part, start_ns, bins))
        turned = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(course)))))
        for first, last in _runs(change >= np.deg2rad(turn_deg)):
            low, high = turned[first], turned[last]
            inside = turned[first : last + 1]
            begin = first + int(np.searchsorted(inside, low + _ENDS * (high - low)))
            end = first + int(np.searchsorted(inside, high - _ENDS * (high - low)))
            spans.append((start_ns + BIN_NS * begin, start_ns + BIN_NS * (end + 1)))
    return np.array(spans, np.int64).reshape(-1, 2)


def ends_ns(trajectory: Trajectory) -> Ints:
    """Spans of take-off and landing, shape (k, 2) [ns]: before the first and after the last time that it flies on steadily.

    Each piece between long pauses has its own. One that never flies on is on a mast, or hovers: it has none.
    """
    spans: list[tuple[int, int]] = []
    for part, start_ns, bins in flown(trajectory):
        velocity = velocities(part, start_ns, bins)
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        on = _runs((speed > _UNDER_WAY_M_S) & (np.abs(velocity[:, 2]) < _CLIMB * speed))
        on = [(first, last) for first, last in on if (last - first + 1) * BIN_NS >= _STEADY_NS]
        if on:
            end_ns = int(part.time_ns[-1]) + 1
            begins, ends = start_ns + BIN_NS * on[0][0], start_ns + BIN_NS * (on[-1][1] + 1)
            spans += [
                (first, last) for first, last in ((start_ns, begins), (min(ends, end_ns), end_ns)) if last > first
            ]
    return np.array(spans, np.int64).reshape(-1, 2)


def _runs(where: Mask) -> list[tuple[int, int]]:
    """First and last bin of each run of true ones."""
    edges = np.diff(np.concatenate(([False], where, [False])).astype(np.int8))
    return list(zip(np.flatnonzero(edges == 1).tolist(), (np.flatnonzero(edges == -1) - 1).tolist(), strict=True))
