"""The heading of the odometry's map against the Earth's."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

BEARING_SIGMA: Final = 0.15
"""How well the first heading is known [rad]: compasses are off by five to ten degrees."""
LARGEST_BEARING: Final = 0.35
"""What a compass may be off by at most [rad]; a path that turns farther away from the fixes is lost, not turned."""


@dataclass(slots=True)
class Bearing:
    """The heading of the odometry's map against the Earth's, by the path and the fixes.

    The map takes its axes from the first attitude. With a compass that is 6 deg off, a straight street of 200 m ends
    20 m beside the fixes, and nothing is wrong with the path.

    Attributes
    ----------
    begin_m : ndarray, shape (3,)
        Where the way began.
    product : complex
        Of where the fixes are from there with where the way is, conjugate; its angle is the turn.
    count : int
    """

    begin_m: Array
    product: complex = 0j
    count: int = 0

    def on_map(self, way_m: Array, fix_m: Array, sigma_m: float) -> Array:
        """A fix turned into the map's axes, shape (3,), and taken into account.

        Of a turn little is believed until the way is several times as wide as the error of a fix, which may last.
        """
        way, fix = way_m - self.begin_m, fix_m - self.begin_m
        self.product += complex(fix[0], fix[1]) * complex(way[0], -way[1])
        self.count += 1
        turn = float(np.angle(self.product + self.count * (sigma_m / BEARING_SIGMA) ** 2))
        turn = min(max(turn, -LARGEST_BEARING), LARGEST_BEARING)
        level = complex(fix[0], fix[1]) * np.exp(-1j * turn)
        return np.asarray(self.begin_m + np.array([level.real, level.imag, fix[2]]))
