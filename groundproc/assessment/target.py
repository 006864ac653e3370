"""What a target is, once it is found."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.assessment.patterns import TARGETS

Array = npt.NDArray[np.float64]

SPHERE: Final = "sphere"
KINDS: Final = (*(each.name for each in TARGETS), SPHERE)
SEARCH_M: Final = 0.5
"""How far from the surveyed point the centre of a target is looked for."""


@dataclass(frozen=True, slots=True)
class Target:
    """A target that was found.

    Attributes
    ----------
    kind : str
    centre_m : ndarray, shape (3,)
    covariance_m2 : ndarray, shape (3, 3)
        Of the centre.
    size_m : float
        Diameter, length of an arm from end to end; of a checkerboard the part that was used.
    points : int
        What it rests on.
    told : float
        Share of the variance of the intensities that it explains; of a sphere NaN.
    """

    kind: str
    centre_m: Array
    covariance_m2: Array
    size_m: float
    points: int
    told: float

    @property
    def sigma_m(self) -> Array:
        """Of the centre, each axis."""
        return np.sqrt(np.diag(self.covariance_m2))
