"""What a level flight leaves behind on level ground: points a square metre, at any place, from the legs that are flown.

Every laser fires at its rate, evenly in azimuth. A beam meets the ground where its direction says, to the side and ahead of the
aircraft. What it meets is carried along a leg: a place gets what lies as far to the side and has come past it between the leg's begin
and its end. A scanner that looks ahead leaves nothing at the first metres of a leg. In a turn the aircraft swings round and leans: there
what it meets is summed up step by step.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import UsageError
from flightlog.frames import mat_local_ins
from flightlog.mount import Mount
from groundproc.planning.motion import motion
from groundproc.sensors.model import Lidar
from groundproc.sensors.shots import Gate

Array = npt.NDArray[np.float64]

_CELL_M: Final = 0.5
_AZIMUTHS: Final = 7200
_TURN_CELL_M: Final = 1.0
_TURN_AZIMUTHS: Final = 720
_LEAN_DEG: Final = 4.0
"""Turns are over soon: footprints for steps of lean are near enough."""


@dataclass(frozen=True, slots=True)
class Swath:
    """One line without ends.

    Attributes
    ----------
    across_m : ndarray, shape (n,)
        Middles of strips of ground, right positive.
    density : ndarray, shape (n,)
        Points a square metre.
    """

    across_m: Array
    density: Array

    def width_m(self) -> float:
        """Of the strip that holds 95 % of the points."""
        order = np.argsort(np.abs(self.across_m))
        share = np.cumsum(self.density[order]) / self.density.sum()
        return 2.0 * float(np.abs(self.across_m[order])[np.searchsorted(share, 0.95)])


@dataclass(frozen=True, slots=True)
class Footprint:
    """What meets the ground in a second, as it lies about the aircraft.

    Attributes
    ----------
    reach_m : float
        Nothing is met farther to any side.
    cell_m : float
    before : ndarray, shape (n, n + 1)
        Points a second and metre across, by column across (right positive): how many lie less far ahead than each edge of the
        cells.
    """

    reach_m: float
    cell_m: float
    before: Array

    @property
    def rate(self) -> float:
        """Points a second."""
        return float(self.before[:, -1].sum()) * self.cell_m

    def swath(self, speed_m_s: float) -> Swath:
        """The strip of ground of one line."""
        middle = (np.arange(len(self.before)) + 0.5) * self.cell_m - self.reach_m
        return Swath(np.asarray(middle, np.float64), self.before[:, -1] / speed_m_s)

    def of_leg(self, places_m: Array, begin_m: Array, end_m: Array, speed_m_s: float) -> Array:
        """Points a square metre that a leg leaves at places on the ground, shape (n,)."""
        length = float(np.hypot(*(end_m - begin_m)))
        ahead = (end_m - begin_m) / length
        along = (places_m - begin_m) @ ahead
        across = (places_m - begin_m) @ np.array([ahead[1], -ahead[0]])
        near = np.flatnonzero((np.abs(across) < self.reach_m) & (np.abs(along - 0.5 * length) < self.reach_m + length))
        column = ((across[near] + self.reach_m) / self.cell_m).astype(int)
        found = np.zeros(len(places_m))
        found[near] = self._before(column, along[near]) - self._before(column, along[near] - length)
        return found / speed_m_s

    def of_place(self, places_m: Array, at_m: Array, heading_rad: float, seconds: float) -> Array:
        """Points a square metre that some time at one place leaves on the ground, shape (n,)."""
        sine, cosine = np.sin(heading_rad), np.cos(heading_rad)
        east, north = (places_m - at_m).T
        column = np.floor((east * cosine - north * sine + self.reach_m) / self.cell_m).astype(int)
        row = np.floor((east * sine + north * cosine + self.reach_m) / self.cell_m).astype(int)
        near = (column >= 0) & (column < len(self.before)) & (row >= 0) & (row < len(self.before))
        column, row = column[near], row[near]
        found = np.zeros(len(places_m))
        found[near] = (self.before[column, row + 1] - self.before[column, row]) * (seconds / self.cell_m)
        return found

    def _before(self, column: npt.NDArray[np.int64], ahead_m: Array) -> Array:
        """`before` of columns, between the edges of the cells too."""
        edge = np.clip((ahead_m + self.reach_m) / self.cell_m, 0.0, len(self.before))
        low = np.minimum(edge.astype(int), len(self.before) - 1)
        part = edge - low
        return np.asarray((1.0 - part) * self.before[column, low] + part * self.before[column, low + 1], np.float64)


class Coverage:
    """What a scanner under an aircraft leaves on level ground.

    Parameters
    ----------
    lidar : Lidar
    mount : Mount
    gate : Gate
        Field of view and ranges that are kept.
    height_m : float
        Of the sensor above the ground.
    speed_m_s : float
    pitch_rad : float
        Of the aircraft on a straight leg, nose up.

    Raises
    ------
    UsageError
        No beam meets the ground within the range gate.
    """

    def __init__(
        self, lidar: Lidar, mount: Mount, gate: Gate, height_m: float, speed_m_s: float, pitch_rad: float
    ) -> None:
        self._lidar, self._mount, self._gate, self._height_m = lidar, mount, gate, height_m
        self._speed_m_s, self._pitch_rad = speed_m_s, pitch_rad
        self.straight = self._footprint(pitch_rad, 0.0, _CELL_M, _AZIMUTHS)
        if self.straight.rate == 0.0:
            raise UsageError(
                f"from {height_m:g} m no beam meets the ground within {gate.min_range_m:g} to {gate.max_range_m:g} m; fly lower"
            )
        self.swath = self.straight.swath(speed_m_s)
        self._leaning: dict[tuple[int, int], Footprint] = {}

    def density(self, places_m: Array, turns_m: Array) -> Array:
        """Points a square metre at places on the ground, shape (n,), of a flight from turning point to turning point."""
        flown = motion(turns_m, self._speed_m_s, self._pitch_rad)
        total = np.zeros(len(places_m))
        for begin, end in flown.legs_m:
            total += self.straight.of_leg(places_m, begin, end, self._speed_m_s)
        leans = np.rint(np.rad2deg([flown.pitch_rad, flown.roll_rad]) / _LEAN_DEG).astype(int).T
        for turn in np.split(np.arange(len(flown.turn)), np.flatnonzero(np.diff(flown.turn)) + 1):
            footprints = [self._turning(*lean) for lean in leans[turn].tolist()]
            reach = np.sqrt(2.0) * max((each.reach_m for each in footprints), default=0.0)
            at = flown.places_m[turn]
            # a turn of a large area reaches little of it
            low, high = at.min(axis=0, initial=np.inf) - reach, at.max(axis=0, initial=-np.inf) + reach
            near = np.flatnonzero(((places_m >= low) & (places_m <= high)).all(axis=1))
            for step, seen in zip(turn, footprints, strict=True):
                total[near] += seen.of_place(
                    places_m[near], flown.places_m[step], flown.heading_rad[step], flown.step_s[step]
                )
        # differences of sums: nothing may be some 1e-13 less than nothing
        return np.maximum(total, 0.0)

    def _turning(self, pitch: int, roll: int) -> Footprint:
        """The footprint of a lean in whole multiples of `_LEAN_DEG`."""
        if (pitch, roll) not in self._leaning:
            pitch_rad, roll_rad = np.deg2rad(pitch * _LEAN_DEG), np.deg2rad(roll * _LEAN_DEG)
            self._leaning[pitch, roll] = self._footprint(pitch_rad, roll_rad, _TURN_CELL_M, _TURN_AZIMUTHS)
        return self._leaning[pitch, roll]

    def _footprint(self, pitch_rad: float, roll_rad: float, cell_m: float, azimuths: int) -> Footprint:
        azimuth = (np.arange(azimuths) + 0.5) * (2.0 * np.pi / azimuths)
        start, width = np.deg2rad(self._gate.window_deg())
        azimuth = azimuth[(azimuth - start) % (2.0 * np.pi) <= width]
        elevation = self._lidar.lasers.elevation_rad[:, None]
        flat = np.cos(elevation)
        beams = np.stack([flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation) + 0.0 * azimuth], axis=-1)
        # the aircraft leans, and the lidar with it as it sits on it: one rotation after the other
        beams = beams.reshape(-1, 3) @ (mat_local_ins(0.0, pitch_rad, roll_rad) @ self._mount.mat_ins_lidar()).T
        with np.errstate(divide="ignore"):
            range_m = np.where(beams[:, 2] < 0.0, -self._height_m / beams[:, 2], np.inf)
        met = (range_m >= self._gate.min_range_m) & (range_m <= self._gate.max_range_m)
        place = beams[met, :2] * range_m[met, None]
        half = int(np.abs(place).max(initial=0.0) / cell_m) + 1
        cell = np.floor(place / cell_m).astype(int) + half
        count = np.bincount(cell[:, 0] * 2 * half + cell[:, 1], minlength=4 * half * half).reshape(2 * half, 2 * half)
        rate = count * (1e9 / self._lidar.firing_ns / azimuths / cell_m)
        before = np.concatenate([np.zeros((2 * half, 1)), np.cumsum(rate, axis=1)], axis=1)
        return Footprint(half * cell_m, cell_m, np.asarray(before, np.float64))
