"""The trajectory as the page of a live session draws it."""

from typing import Final

import numpy as np
import numpy.typing as npt

_PATH_ROWS: Final = 100_000


class PathLine:
    """The trajectory for the page: positions, thinned by half whenever there are too many.

    Attributes
    ----------
    generation : int
        Counts how often they were thinned.
    """

    def __init__(self) -> None:
        self.generation, self.count, self._every, self._seen = 0, 0, 1, 0
        self.xyz = np.empty((_PATH_ROWS, 3), np.float32)

    def add(self, position_m: npt.NDArray[np.float64]) -> None:
        """Append a position, shape (3,)."""
        self._seen += 1
        if self._seen % self._every:
            return
        if self.count == _PATH_ROWS:
            self.xyz[: self.count // 2] = self.xyz[: self.count : 2].copy()
            self.count //= 2
            self._every *= 2
            self.generation += 1
        self.xyz[self.count] = position_m
        self.count += 1
