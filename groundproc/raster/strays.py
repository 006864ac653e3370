"""Rasters of surfaces without points that are alone: one bird would be the highest point of its cell."""

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.cloud.points import Points
from groundproc.numerics.lonely import Lonely

_WAITING: Final = 2_000_000


class Accompanied:
    """Hands points on as soon as they have company, and holds the others back until all are there: the cloud is read once.

    What is alone in the end is what `swath ground` takes for noise by itself, and `swath viewshed` does not look at.

    Memory: that of `Lonely`, and of the points that have no company among those of their piece.

    Parameters
    ----------
    take : callable
        Is given the points, in no order.
    """

    def __init__(self, take: Callable[[Points], None]) -> None:
        self._take, self._all = take, Lonely()
        self._waiting: list[Points] = []
        self._most = _WAITING

    def add(self, points: Points) -> None:
        """Take points, in metres."""
        piece = Lonely()
        piece.add(points.xyz_m)
        alone = piece.alone(points.xyz_m)
        self._all.join(piece)
        self._hand_on(points, alone)
        if sum(map(len, self._waiting)) > self._most:
            self._look_again()
            self._most = max(_WAITING, 2 * sum(map(len, self._waiting)))

    def finish(self) -> int:
        """Hand on what has company after all, and give the number of points that are alone."""
        self._all.widen()
        self._look_again()
        return sum(map(len, self._waiting))

    def _look_again(self) -> None:
        waiting, self._waiting = self._waiting, []
        for points in waiting:
            self._hand_on(points, self._all.alone(points.xyz_m))

    def _hand_on(self, points: Points, alone: npt.NDArray[np.bool_]) -> None:
        if not alone.all():
            self._take(points.masked(~alone))
        if alone.any():
            self._waiting.append(points.masked(alone))
