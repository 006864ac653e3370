"""How far a live session is behind the lidar."""

import math
from collections import deque
from typing import Final

from flightlog.constants import NS_PER_S

_BIN_NS: Final = 10 * NS_PER_S


class Lag:
    """How far results are behind the lidar: against the fastest packet of the last minute."""

    def __init__(self) -> None:
        self._bins: deque[tuple[int, int]] = deque(maxlen=6)

    def arrived(self, device_ns: int, arrival_ns: int) -> None:
        """Take the newest packet's times: lidar's and this computer's monotonic clock."""
        number, delay = device_ns // _BIN_NS, arrival_ns - device_ns
        if self._bins and self._bins[-1][0] == number:
            self._bins[-1] = (number, min(self._bins[-1][1], delay))
        else:
            self._bins.append((number, delay))

    def of(self, device_ns: int, now_ns: int) -> float:
        """Seconds from a lidar time to now, less what the fastest packet takes; not a number before the first."""
        if not self._bins:
            return math.nan
        return (now_ns - device_ns - min(delay for _, delay in self._bins)) / NS_PER_S
