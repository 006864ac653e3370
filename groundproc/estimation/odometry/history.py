"""Where the sensor was in the last seconds: what a late position is compared with."""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames

Array = npt.NDArray[np.float64]

KEPT: Final = 100
"""Poses that are remembered, one a slice: 10 s."""


@dataclass(frozen=True, slots=True)
class Was:
    """A pose of the past.

    Attributes
    ----------
    position_m : ndarray, shape (3,)
    mat_map_sensor : ndarray, shape (3, 3)
    """

    position_m: Array
    mat_map_sensor: Array


class History:
    """Poses at the ends of the last slices."""

    def __init__(self) -> None:
        self._time_ns: deque[int] = deque(maxlen=KEPT)
        self._poses: deque[tuple[Array, Array]] = deque(maxlen=KEPT)

    def add(self, time_ns: int, position_m: Array, quat: Array) -> None:
        """Append a pose, shape (3,) and (4,), later than those before."""
        self._time_ns.append(time_ns)
        self._poses.append((position_m, quat))

    def shift(self, by_m: Array) -> None:
        """Move all by a correction of the path, shape (3,): it is not to be made again by what is still on its way."""
        for i, (place, quat) in enumerate(self._poses):
            self._poses[i] = place + by_m, quat

    def clear(self) -> None:
        """Forget all: they are of a map that is no more."""
        self._time_ns.clear()
        self._poses.clear()

    def at(self, time_ns: int) -> Was | None:
        """The pose at a time, straight between two slices; None before the first and after the last."""
        stamps = np.array(self._time_ns, np.int64)
        after = int(np.searchsorted(stamps, time_ns))
        if after == len(stamps) or (after == 0 and time_ns < stamps[0]):
            return None
        before = max(after - 1, 0)
        (place, quat), (next_place, next_quat) = self._poses[before], self._poses[after]
        share = 0.0 if after == before else (time_ns - stamps[before]) / (stamps[after] - stamps[before])
        mat, next_mat = frames.mat_from_quat(np.stack([quat, next_quat]))
        turn = share * frames.quat_log(frames.quat_from_mat((mat.T @ next_mat)[None]))
        return Was(place + share * (next_place - place), mat @ frames.mat_from_quat(frames.quat_exp(turn))[0])
