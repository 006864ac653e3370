"""Things that move, from their points: what a revolution sees of one, and how these sightings follow each other.

A revolution meets a thing in one burst of a few hundredths of a second. Its points, joined in space and time, give a
place; places that one speed connects make a track. Speed is the slope of a line through the places of a second and a
half. The part of a thing that is seen changes as it passes, and with it the middle. The sigma therefore includes the
scatter about the line, and half of the thing's size over the time for which it was seen.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

JOINED_M: Final = 0.9
"""Points of one thing are no farther from each other than this ..."""
_JOINED_S: Final = 0.02
"""... and this: bursts of two revolutions are at least twice as far apart."""
_SAME_S: Final = 0.03
"""Parts of one thing in one revolution are no farther from each other."""
_CELL: Final = 0.25
"""Of `JOINED_M`: points nearer than this are one, for speed."""
_FEWEST: Final = 4
"""Points of a burst."""
_LOST_S: Final = 1.5
_FASTEST_M_S: Final = 25.0
_GATE_M: Final = 0.7
_TURNS_M_S2: Final = 4.0
_KNOWN: Final = 4
"""Places after which a track has a speed to go on by."""
_LEAST_PLACES: Final = 5
_LEAST_S: Final = 0.5
_ALONGSIDE: Final = 0.7
"""Share of a track that goes along with another: it is a part of the same thing."""
_WINDOW_S: Final = 0.75
_LEAST_SCATTER_M: Final = 0.05


@dataclass(frozen=True, slots=True)
class Burst:
    """What a revolution saw of something.

    Attributes
    ----------
    time_s : float
    low_m, high_m : ndarray, shape (3,)
        Extent.
    points : int
    """

    time_s: float
    low_m: Array
    high_m: Array
    points: int

    @property
    def place_m(self) -> Array:
        """Middle of its extent in plan; its lowest point in height."""
        return np.array([*((self.low_m + self.high_m) / 2.0)[:2], self.low_m[2]])

    @property
    def size_m(self) -> Array:
        """Its extent."""
        return np.asarray(self.high_m - self.low_m)

    def joined(self, other: "Burst") -> "Burst":
        """Both parts of one thing."""
        points = self.points + other.points
        time_s = (self.points * self.time_s + other.points * other.time_s) / points
        return Burst(time_s, np.minimum(self.low_m, other.low_m), np.maximum(self.high_m, other.high_m), points)


@dataclass(frozen=True, slots=True)
class Track:
    """Something that moved.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
    place_m : ndarray, shape (n, 3)
    velocity_m_s : ndarray, shape (n, 2)
    sigma_m_s : ndarray, shape (n,)
        Of each component.
    size_m : ndarray, shape (3,)
        Along the way, across it, and in height: what most bursts see.
    points : int
    """

    time_s: Array
    place_m: Array
    velocity_m_s: Array
    sigma_m_s: Array
    size_m: Array
    points: int

    @property
    def mean_m_s(self) -> float:
        """Speed on the way, the mean."""
        return float(np.hypot(*self.velocity_m_s.T).mean())

    @property
    def mean_sigma_m_s(self) -> float:
        """Of that: windows overlap, so that only some of them are independent."""
        windows = max(float(np.ptp(self.time_s)) / (2.0 * _WINDOW_S), 1.0)
        return float(np.sqrt(np.mean(self.sigma_m_s**2) / windows))


def bursts(time_s: Array, xyz_m: Array) -> list[Burst]:
    """What each revolution saw, in the order of time.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
    xyz_m : ndarray, shape (n, 3)
    """
    if not len(time_s):
        return []
    scaled = np.column_stack([xyz_m - xyz_m.min(axis=0), (time_s - time_s.min()) * (JOINED_M / _JOINED_S)])
    cell = np.floor(scaled / (_CELL * JOINED_M)).astype(np.int64)
    _, first, number = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    pairs = cKDTree(scaled[first]).query_pairs(JOINED_M, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(first), len(first)))
    group = connected_components(graph, directed=False)[1][number.ravel()]
    order = np.argsort(group, kind="stable")
    found = []
    for rows in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        if len(rows) >= _FEWEST:
            low, high = xyz_m[rows].min(axis=0), xyz_m[rows].max(axis=0)
            found.append(Burst(float(time_s[rows].mean()), low, high, len(rows)))
    return sorted(found, key=lambda each: each.time_s)


def tracks(seen: list[Burst]) -> list[Track]:
    """Things that moved, of bursts in the order of time."""
    ended: list[list[Burst]] = []
    open_: list[list[Burst]] = []
    for burst in seen:
        still = [way for way in open_ if burst.time_s - way[-1].time_s <= _LOST_S]
        ended += [way for way in open_ if burst.time_s - way[-1].time_s > _LOST_S]
        open_ = still
        away = [_misfit(way, burst) for way in open_]
        if away and min(away) < 1.0:
            way = open_[int(np.argmin(away))]
            if burst.time_s - way[-1].time_s < _SAME_S:
                way[-1] = way[-1].joined(burst)
            else:
                way.append(burst)
        else:
            open_.append([burst])
    whole = _absorbed(ended + open_)
    long = [way for way in whole if len(way) >= _LEAST_PLACES and way[-1].time_s - way[0].time_s >= _LEAST_S]
    return [_track(way) for way in sorted(long, key=lambda way: way[0].time_s)]


def _absorbed(ways: list[list[Burst]]) -> list[list[Burst]]:
    """Tracks, with those that go along within the length of another as parts of it: both ends of a car."""
    kept: list[list[Burst]] = []
    for way in sorted(ways, key=len, reverse=True):
        other = next((each for each in kept if _along(way, each)), None)
        if other is None:
            kept.append(way)
            continue
        parts = sorted(other + way, key=lambda each: each.time_s)
        other.clear()
        for burst in parts:
            if other and burst.time_s - other[-1].time_s < _SAME_S:
                other[-1] = other[-1].joined(burst)
            else:
                other.append(burst)
    return kept


def _along(way: list[Burst], other: list[Burst]) -> bool:
    """Whether most of a track lies within the length of another at its times."""
    if len(other) < _LEAST_PLACES:
        return False
    time = np.array([each.time_s for each in other])
    place = np.array([each.place_m[:2] for each in other])
    at = np.array([each.time_s for each in way])
    near = (at > time[0] - _LOST_S) & (at < time[-1] + _LOST_S)
    if near.mean() < _ALONGSIDE:
        return False
    own = np.array([each.place_m[:2] for each in way])
    # beyond its ends straight on
    time = np.concatenate([[time[0] - _LOST_S], time, [time[-1] + _LOST_S]])
    first, last = (np.polyfit(time[1:-1][end], place[end], 1)[0] for end in (np.s_[:8], np.s_[-8:]))
    place = np.concatenate([place[:1] - _LOST_S * first, place, place[-1:] + _LOST_S * last])
    away = np.hypot(*(own - np.stack([np.interp(at, time, axis) for axis in place.T], axis=1)).T)
    long = float(np.percentile([np.max(each.size_m[:2]) for each in other], 75))
    return bool(np.mean(near & (away < 0.75 * long + 0.5 * _GATE_M)) >= _ALONGSIDE)


def _misfit(way: list[Burst], burst: Burst) -> float:
    """How far a burst lies from where a track goes on, of what is allowed: below 1 it is of the track."""
    last = way[-1]
    gap = burst.time_s - last.time_s
    if gap < _SAME_S:  # a part of the same thing, where it is as long as that
        if len(way) < _KNOWN:
            return float("inf")
        long = float(np.median([np.max(each.size_m[:2]) for each in way[-8:]]))
        return float(np.hypot(*(burst.place_m[:2] - last.place_m[:2]))) / (0.5 * long + 0.5 * _GATE_M)
    if len(way) < _KNOWN:
        ahead, allowed = last.place_m[:2], _GATE_M + _FASTEST_M_S * gap
    else:
        some = way[-8:]
        time = np.array([each.time_s for each in some])
        place = np.array([each.place_m[:2] for each in some])
        line = np.polyfit(time - last.time_s, place, 1)
        ahead, allowed = line[1] + gap * line[0], _GATE_M + 0.5 * _TURNS_M_S2 * gap**2 + 0.5 * gap
    # a car is seen in parts of its length
    allowed += 0.5 * float(np.max(last.size_m[:2]))
    return float(np.hypot(*(burst.place_m[:2] - ahead)) / allowed)


def _track(way: list[Burst]) -> Track:
    time = np.array([each.time_s for each in way])
    place = np.array([each.place_m for each in way])
    extent = np.array([each.size_m for each in way])
    velocity, sigma = np.empty((len(way), 2)), np.empty(len(way))
    for row, middle in enumerate(time):
        some = _window(time, middle)
        velocity[row], sigma[row] = _slope(time[some], place[some, :2])
    size = np.percentile(extent, 75, axis=0)
    # over the whole pass the middle of what is seen may go from one end of the thing to the other
    sigma = np.hypot(sigma, 0.25 * float(np.max(size[:2])) / max(float(np.ptp(time)), 2.0 * _WINDOW_S))
    along = velocity.mean(axis=0) / max(float(np.hypot(*velocity.mean(axis=0))), 1e-9)
    ways = np.abs(along) @ size[:2], np.abs(np.array([-along[1], along[0]])) @ size[:2]
    return Track(time, place, velocity, sigma, np.array([*ways, size[2]]), sum(each.points for each in way))


def _window(time: Array, middle: float) -> Rows:
    """Places near a time; of those at the ends as many."""
    near = np.flatnonzero(np.abs(time - middle) <= _WINDOW_S)
    if len(near) >= _LEAST_PLACES:
        return near
    return np.sort(np.argsort(np.abs(time - middle), kind="stable")[:_LEAST_PLACES])


def _slope(time: Array, place: Array) -> tuple[Array, float]:
    """Velocity through places, by weights that bear a few that are off, and the sigma of each component."""
    centred, weight = time - time.mean(), np.ones(len(time))
    slope, left = np.zeros(2), np.zeros_like(place)
    for _ in range(3):
        mean_t = weight @ centred / weight.sum()
        mean_p = weight @ place / weight.sum()
        t = centred - mean_t
        slope = (weight * t) @ (place - mean_p) / max(float(weight @ t**2), 1e-9)
        left = place - mean_p - t[:, None] * slope
        scale = max(float(np.median(np.hypot(*left.T))), _LEAST_SCATTER_M)
        weight = 1.0 / (1.0 + np.sum(left**2, axis=1) / (2.0 * scale) ** 2)
    t = centred - weight @ centred / weight.sum()
    scatter = max(float(np.sqrt(weight @ np.sum(left**2, axis=1) / weight.sum() / 2.0)), _LEAST_SCATTER_M)
    return slope, scatter / float(np.sqrt(max(weight @ t**2, 1e-9)))
