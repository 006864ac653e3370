"""THE table of point classes: those of LAS 1.4 (R15, table 17) that the programs give or look at, and of the user's range those of ours.

A command writes the numbers that it finds and leaves others as they are. Numbers from 64 on are the user's: another program may mean
something else by them.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

UNCLASSIFIED: Final = 1
GROUND: Final = 2
LOW: Final = 3
MEDIUM: Final = 4
HIGH: Final = 5
BUILDING: Final = 6
LOW_NOISE: Final = 7
WATER: Final = 9
GUARD: Final = 13
CONDUCTOR: Final = 14
TOWER: Final = 15
HIGH_NOISE: Final = 18
MAST: Final = 64
POLE: Final = 65
FENCE: Final = 66
STAY: Final = 67
PANE: Final = 68
MOVING: Final = 69

NAMES: Final = {
    0: "never classified", UNCLASSIFIED: "unclassified", GROUND: "ground", LOW: "low vegetation", MEDIUM: "medium vegetation",
    HIGH: "high vegetation", BUILDING: "building", LOW_NOISE: "low noise", WATER: "water", GUARD: "guard wire",
    CONDUCTOR: "conductor", TOWER: "tower of wires", HIGH_NOISE: "high noise", MAST: "mast", POLE: "pole", FENCE: "fence",
    STAY: "stay", PANE: "pane, and what is behind it", MOVING: "what moved",
}  # fmt: skip
"""All of them, in words."""
NO_SURFACE: Final = (LOW_NOISE, HIGH_NOISE, MOVING)
"""What belongs to no surface that stands: left out of heights, rasters, volumes and comparisons unless they are asked for."""
OF_USES: Final = (GUARD, CONDUCTOR, TOWER, MAST, POLE, FENCE, STAY, PANE, MOVING)
"""What a use found by more than height: one that classes the same points later leaves it."""


def merged(given: npt.ArrayLike, found: npt.ArrayLike, own: Sequence[int] = ()) -> npt.NDArray[np.uint8]:
    """Classes to write, shape (n,): those found, but for points that another use has classed already.

    Parameters
    ----------
    given : array of integers, shape (n,)
        As the cloud has them.
    found : array of integers, shape (n,)
        0 where nothing was found: the class stays.
    own : sequence of int
        Classes of `OF_USES` that this use gives: it may replace its own.
    """
    given, found = np.asarray(given), np.asarray(found)
    others = [each for each in OF_USES if each not in own]
    return np.where((found == 0) | np.isin(given, others), given, found).astype(np.uint8)
