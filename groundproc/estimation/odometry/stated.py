"""What the autopilot states of the path, in the local frame: positions and attitudes, whose errors last."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(slots=True)
class Positions:
    """Positions in the local frame.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        UTC.
    position_m, sigma_m : ndarray, shape (n, 3)
    lever_m : ndarray, shape (3,)
        From the sensor to the point that they are of, sensor frame.
    tau_s : ndarray, shape (3,)
        How long their errors last.
    white_m : float
        The part of them that is new in each second.
    """

    time_ns: Ints
    position_m: Array
    sigma_m: Array
    lever_m: Array
    tau_s: Array
    white_m: float

    def only(self, chosen: npt.NDArray[np.bool_]) -> "Positions":
        """Some of them, by a mask of shape (n,)."""
        return replace(
            self, time_ns=self.time_ns[chosen], position_m=self.position_m[chosen], sigma_m=self.sigma_m[chosen]
        )


@dataclass(slots=True)
class Attitudes:
    """Attitudes of the ins frame.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        UTC.
    quat : ndarray, shape (n, 4)
        Local from ins.
    sigma_rad : ndarray, shape (3,)
        About east, north, up.
    tau_s : float
    """

    time_ns: Ints
    quat: Array
    sigma_rad: Array
    tau_s: float


@dataclass(frozen=True, slots=True)
class Fix:
    """One position.

    Attributes
    ----------
    time_ns : int
        On the time scale of the motion.
    position_m, sigma_m : ndarray, shape (3,)
        In the local frame.
    rate_hz : float
        How often such positions come.
    """

    time_ns: int
    position_m: Array
    sigma_m: Array
    rate_hz: float


class Stated(Protocol):
    """What the autopilot states, as it becomes known: read from a log, or heard in flight and perhaps late."""

    @property
    def lever_m(self) -> Array:
        """From the sensor to the point that the positions are of, sensor frame, shape (3,)."""

    def fixes(self, now_ns: int) -> Sequence[Fix]:
        """Positions not given before, of times up to now."""

    def attitude(self, now_ns: int) -> tuple[int, Array] | None:
        """The newest attitude up to now, its time and the quaternion "local from ins"; None where there is none to be taken."""


class Recorded:
    """What the log says, with nothing late: what is older than its stream allows lies before a start or in a gap.

    Parameters
    ----------
    positions : Positions
    attitudes : Attitudes or None
    """

    OLDEST_FIX_S: Final = 0.5
    OLDEST_ATTITUDE_S: Final = 0.2

    def __init__(self, positions: Positions, attitudes: Attitudes | None) -> None:
        self._positions, self._attitudes, self._next = positions, attitudes, 0

    @property
    def lever_m(self) -> Array:
        """From the sensor to the point that the positions are of, sensor frame, shape (3,)."""
        return self._positions.lever_m

    def fixes(self, now_ns: int) -> list[Fix]:
        """Positions since the last call."""
        given, first = self._positions, self._next
        self._next = first + int(np.searchsorted(given.time_ns[first:], now_ns, side="right"))
        found = []
        for i in range(first, self._next):
            if (now_ns - int(given.time_ns[i])) * 1e-9 > self.OLDEST_FIX_S:
                continue
            rate_hz = 1e9 / max(float(np.median(np.diff(given.time_ns[max(i - 5, 0) : i + 6]))), 1e7)
            found.append(Fix(int(given.time_ns[i]), given.position_m[i], given.sigma_m[i], rate_hz))
        return found

    def attitude(self, now_ns: int) -> tuple[int, Array] | None:
        """The newest attitude."""
        given = self._attitudes
        i = -1 if given is None else int(np.searchsorted(given.time_ns, now_ns)) - 1
        if given is None or i < 0 or (now_ns - int(given.time_ns[i])) * 1e-9 > self.OLDEST_ATTITUDE_S:
            return None
        return int(given.time_ns[i]), given.quat[i]
