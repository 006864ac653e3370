"""Lines over an area: parallel, the way that needs fewest turns, each as long as the area there; and a pattern that calibrates."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from flightlog.errors import UsageError

Array = npt.NDArray[np.float64]

_MOST_LINES: Final = 2000
_TURN_S: Final = 6.0
"""Of a multirotor at the end of a line: brake, move over, speed up."""
_CLIMB_S: Final = 20.0
_PATTERN_M: Final = 30.0


@dataclass(frozen=True, slots=True)
class Route:
    """What is flown.

    Attributes
    ----------
    places_m : ndarray, shape (n, 2)
        Turning points, east and north.
    heading_deg : float
        Of the first line.
    lines : int
    length_m, seconds : float
        Turns, climb and return included in the time.
    speed_m_s : float
    """

    places_m: Array
    heading_deg: float
    lines: int
    length_m: float
    seconds: float
    speed_m_s: float

    def batteries(self, each_s: float) -> int:
        """How many a flight takes, if each climbs at the first place, goes on where the one before it turned, and returns.

        Raises
        ------
        UsageError
            One is not enough for the way to a line, the line and the way back.
        """
        count, at, turns = 1, 0, len(self.places_m) - 1
        while True:
            reached = self._reached(at, each_s)
            if reached == at:
                need = self._seconds(at, at + 1) / 60.0
                raise UsageError(
                    f"--battery {each_s / 60.0:g}: {need:.1f} min are needed from turning point {at + 1} to the next one, with "
                    "climb and the ways there and back; fly faster, or a smaller area"
                )
            if reached == turns:
                return count
            # a line that the battery does not end is begun anew: what lies between two turns is flown in one
            count, at = count + 1, reached

    def _reached(self, at: int, each_s: float) -> int:
        """The last turning point that a battery reaches from another."""
        last = at
        while last + 1 < len(self.places_m) and self._seconds(at, last + 1) <= each_s:
            last += 1
        return last

    def _seconds(self, first: int, last: int) -> float:
        """Of a flight from home to a turning point, on to another, and back."""
        part = self.places_m[[0, *range(first, last + 1), 0]]
        length = np.linalg.norm(np.diff(part, axis=0), axis=1).sum()
        return float(length) / self.speed_m_s + (last - first + 1) * _TURN_S + _CLIMB_S


def route(
    area: Any, spacing_m: float, speed_m_s: float, heading_deg: float | None, margin_m: float, calibrate: bool
) -> Route:
    """Lines over a polygon.

    Parameters
    ----------
    area : shapely Polygon
        In metres.
    spacing_m, speed_m_s : float
    heading_deg : float or None
        Of the lines; None: along the longer side.
    margin_m : float
        That each line begins before and ends after the area.
    calibrate : bool
        Fly a cross over the middle first, both ways on each arm, with two turns: what mount and compass are estimated from.

    Raises
    ------
    UsageError
        The area would need too many lines.
    """
    heading = _along(area) if heading_deg is None else heading_deg
    lines = _lines(area, spacing_m, heading, margin_m)
    places = [end for number, line in enumerate(lines) for end in (line if number % 2 == 0 else line[::-1])]
    if calibrate:
        places = [*_cross(np.array([area.centroid.x, area.centroid.y]), heading), *places]
    path = np.array(places)
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    home = float(np.linalg.norm(path[-1] - path[0]))
    seconds = (length + home) / speed_m_s + len(path) * _TURN_S + _CLIMB_S
    return Route(path, heading, len(lines), length, seconds, speed_m_s)


def evened(area: Any, spacing_m: float, heading_deg: float | None) -> float:
    """The spacing of as many lines as an area needs with a spacing, the outer ones on its edges: no wider than that.

    Lines beyond the edges would leave there what nobody asked for.
    """
    across = _across(area, _along(area) if heading_deg is None else heading_deg)
    spaces = max(int(np.ceil(across / spacing_m)), 1)
    # by rounding, one line more would be laid
    return min(spacing_m, across / spaces * (1.0 + 1e-9))


def _across(area: Any, heading_deg: float) -> float:
    """Width of an area across lines of a heading."""
    angle = np.deg2rad(heading_deg)
    return float(np.ptp(shapely.get_coordinates(area) @ np.array([np.cos(angle), -np.sin(angle)])))


def _along(area: Any) -> float:
    """Heading of the longer side of the smallest rectangle about an area."""
    corners = np.array(area.minimum_rotated_rectangle.exterior.coords)[:3]
    sides = np.diff(corners, axis=0)
    longer = sides[np.argmax(np.linalg.norm(sides, axis=1))]
    return float(np.rad2deg(np.arctan2(longer[0], longer[1])) % 180.0)


def _lines(area: Any, spacing_m: float, heading_deg: float, margin_m: float) -> list[Array]:
    """Ends of each line, shape (2, 2), from one side of the area to the other; every place of the area lies between two."""
    angle = np.deg2rad(heading_deg)
    ahead, right = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
    places = shapely.get_coordinates(area)
    across, along = places @ right, places @ ahead
    count = int(np.ceil((across.max() - across.min()) / spacing_m)) + 1
    if count > _MOST_LINES:
        raise UsageError(
            f"{count} lines of {spacing_m:g} m spacing found, expected {_MOST_LINES} at most; take a smaller area"
        )
    first = 0.5 * (across.max() + across.min() - (count - 1) * spacing_m)
    low, high = along.min() - 1.0, along.max() + 1.0
    found = []
    for number in range(count):
        offset = first + number * spacing_m
        sides = (
            (offset - spacing_m, low),
            (offset - spacing_m, high),
            (offset + spacing_m, high),
            (offset + spacing_m, low),
        )
        # the ground on both sides as far as the next lines: between any two lines both are needed
        part = (
            shapely.get_coordinates(area.intersection(shapely.Polygon([x * right + y * ahead for x, y in sides])))
            @ ahead
        )
        if len(part):
            ends = part.min() - margin_m, part.max() + margin_m
            found.append(np.array([offset * right + end * ahead for end in ends]))
    return found


def _cross(middle: Array, heading_deg: float) -> list[Array]:
    """Two arms at right angles over a place, each flown both ways."""
    places = []
    for turn in (0.0, 90.0):
        angle = np.deg2rad(heading_deg + turn)
        arm = _PATTERN_M * np.array([np.sin(angle), np.cos(angle)])
        places += [middle - arm, middle + arm, middle - arm]
    return places
