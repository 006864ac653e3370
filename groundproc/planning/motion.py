"""A route as it is flown: straight at one speed, and turns, in which the aircraft swings round and leans into the curve.

A turning point is passed as by a path whose position, and heading, are a running mean over time with a Gaussian of one sigma: inside
the corner, without a stop. The simulator flies so (`simulator.route`), and a multirotor roughly.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from flightlog.constants import STANDARD_GRAVITY_M_S2

Array = npt.NDArray[np.float64]

_SMOOTH_S: Final = 1.0
_WINDOW: Final = 2.5
"""Sigmas from a turning point within which it is a turn: beyond, the heading is within 1 % of the next leg's."""
_STEP_S: Final = 0.1
_MOST_TURN_M_S2: Final = STANDARD_GRAVITY_M_S2 * float(np.tan(np.radians(30.0)))
"""Faster aircraft take longer to turn: autopilots lean by 30 deg or so at most."""


@dataclass(frozen=True, slots=True)
class Motion:
    """A flight at one speed, its turns in steps of equal time.

    Attributes
    ----------
    legs_m : ndarray, shape (k, 2, 2)
        Begin and end of what is flown straight.
    places_m : ndarray, shape (n, 2)
        In the turns.
    heading_rad, pitch_rad, roll_rad : ndarray, shape (n,)
    turn : ndarray of int, shape (n,)
        Number of the turn; turns that run into each other are one.
    step_s : ndarray, shape (n,)
        Time spent at each.
    """

    legs_m: Array
    places_m: Array
    heading_rad: Array
    pitch_rad: Array
    roll_rad: Array
    turn: npt.NDArray[np.int64]
    step_s: Array


def motion(places_m: Array, speed_m_s: float, pitch_rad: float) -> Motion:
    """Fly from turning point to turning point.

    Parameters
    ----------
    places_m : ndarray, shape (n, 2)
        East and north.
    speed_m_s : float
    pitch_rad : float
        On a straight leg, nose up: what the air's drag makes of it, and in proportion in the turns.
    """
    steps = np.diff(places_m, axis=0)
    steps = steps[np.hypot(*steps.T) > 0.0]
    length = np.hypot(*steps.T)
    at_s = np.concatenate([[0.0], np.cumsum(length)]) / speed_m_s
    corners = np.concatenate([places_m[:1], places_m[0] + np.cumsum(steps, axis=0)])
    smooth_s = max(_SMOOTH_S, np.sqrt(2.0) * speed_m_s / np.sqrt(2.0 * np.pi) / _MOST_TURN_M_S2)
    windows: list[list[float]] = []
    for middle in at_s[1:-1]:
        low, high = max(0.0, middle - _WINDOW * smooth_s), min(at_s[-1], middle + _WINDOW * smooth_s)
        if windows and low <= windows[-1][1]:
            windows[-1][1] = high
        else:
            windows.append([low, high])
    edges = np.array([0.0, *np.ravel(windows), at_s[-1]]).reshape(-1, 2)
    edges = edges[edges[:, 1] - edges[:, 0] > 0.0]
    legs_m = np.stack([np.interp(edges, at_s, corners[:, axis]) for axis in range(2)], axis=-1)
    time_s, turn, step_s = _steps(windows)
    leg = np.clip(np.searchsorted(at_s, time_s, side="right") - 1, 0, len(steps) - 1)
    velocity = steps / length[:, None] * speed_m_s
    course = np.arctan2(velocity[:, 0], velocity[:, 1])
    place = np.stack([np.interp(time_s, at_s, corners[:, axis]) for axis in range(2)], axis=-1)
    heading, moving, force = course[leg], velocity[leg], np.zeros((len(time_s), 2))
    for number, middle in enumerate(at_s[1:-1]):
        near = slice(*np.searchsorted(time_s, [middle - 6.0 * smooth_s, middle + 6.0 * smooth_s]))
        z = (time_s[near] - middle) / smooth_s
        bell, share = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi), ndtr(z) - (z >= 0.0)
        change = velocity[number + 1] - velocity[number]
        swing = (course[number + 1] - course[number] + np.pi) % (2.0 * np.pi) - np.pi
        place[near] += (smooth_s * (bell - np.abs(z) * ndtr(-np.abs(z))))[:, None] * change
        moving[near] += share[:, None] * change
        force[near] += (bell / smooth_s)[:, None] * change
        heading[near] += share * swing
    force += moving * (-np.tan(pitch_rad) * STANDARD_GRAVITY_M_S2 / speed_m_s)
    sine, cosine = np.sin(heading), np.cos(heading)
    right, ahead = force[:, 0] * cosine - force[:, 1] * sine, force[:, 0] * sine + force[:, 1] * cosine
    pitch = np.arctan2(-ahead, STANDARD_GRAVITY_M_S2)
    roll = np.arctan2(right, np.hypot(ahead, STANDARD_GRAVITY_M_S2))
    return Motion(legs_m, place, heading, pitch, roll, turn, step_s)


def _steps(windows: list[list[float]]) -> tuple[Array, npt.NDArray[np.int64], Array]:
    """Middles of steps in all windows, the window of each, and its length."""
    counts = [max(1, round((high - low) / _STEP_S)) for low, high in windows]
    middles = [low + (high - low) * (np.arange(n) + 0.5) / n for (low, high), n in zip(windows, counts, strict=True)]
    lengths = [(high - low) / n for (low, high), n in zip(windows, counts, strict=True)]
    time_s = np.concatenate([np.zeros(0), *middles])
    return time_s, np.repeat(np.arange(len(windows)), counts), np.repeat(np.array(lengths, np.float64), counts)
