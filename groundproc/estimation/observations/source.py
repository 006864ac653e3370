"""What each source of positions or attitudes has of its own: the delay of its clock, and its lever arm."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from groundproc.estimation.observations.rows import RowBuilder, Unknowns

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def _none() -> Array:
    return np.zeros(1)


@dataclass(frozen=True, slots=True)
class Clock:
    """The clock of a source.

    Attributes
    ----------
    name : str
        Of the global.
    sigma_s : float
        How well it was known before; 0: the delay is held where it is, and no unknown.
    delay_s : ndarray, shape (1,)
        What its stamps are ahead of ours of the same moment, as estimated so far.
    """

    name: str
    sigma_s: float = 0.0
    delay_s: Array = field(default_factory=_none)

    def unknowns(self, unknowns: Unknowns) -> None:
        """Add the delay where it is free."""
        if self.sigma_s > 0.0:
            unknowns.add(self.name, np.array([self.sigma_s]), self.delay_s, unit="s")

    def ours_ns(self, time_ns: Ints) -> Ints:
        """Stamps on our scale."""
        return time_ns - round(float(self.delay_s[0]) * 1e9)

    def add(self, builder: RowBuilder, row: Ints, change: Array) -> None:
        """Columns of the delay: `change` is what the modelled quantity changes by in a second, shape (n, m)."""
        if self.name in builder.unknowns.names:
            builder.by(row, self.name, -change[:, :, None])

    def taken(self, part: Mapping[str, Array]) -> "Clock":
        """With a solution put in."""
        return replace(self, delay_s=self.delay_s + part[self.name]) if self.name in part else self

    def held(self, values: Mapping[str, Array]) -> "Clock":
        """With the delay as others found it, and no unknown any more."""
        return replace(self, sigma_s=0.0, delay_s=values.get(self.name, self.delay_s))


@dataclass(frozen=True, slots=True)
class Arm:
    """The point that a source places.

    Attributes
    ----------
    name : str
        Of the global.
    nominal_m : ndarray, shape (3,)
        From the sensor to the point, sensor frame, as it was measured.
    sigma_m : float
        Of that, along each axis; 0: it is held, and no unknown.
    off_m : ndarray, shape (3,)
        What it is off, as estimated so far.
    """

    name: str
    nominal_m: Array
    sigma_m: float = 0.0
    off_m: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def lever_m(self) -> Array:
        """As estimated so far, shape (3,)."""
        return np.asarray(self.nominal_m + self.off_m)

    def unknowns(self, unknowns: Unknowns) -> None:
        """Add the lever arm where it is free."""
        if self.sigma_m > 0.0:
            unknowns.add(self.name, np.full(3, self.sigma_m), self.lever_m, self.nominal_m, "m")

    def add(self, builder: RowBuilder, row: Ints, mats: Array) -> None:
        """Columns of the lever arm, of rows of positions; `mats` is what they change by with it, shape (n, m, 3)."""
        if self.name in builder.unknowns.names:
            builder.by(row, self.name, mats)

    def taken(self, part: Mapping[str, Array]) -> "Arm":
        """With a solution put in."""
        return replace(self, off_m=self.off_m + part[self.name]) if self.name in part else self

    def held(self, values: Mapping[str, Array]) -> "Arm":
        """As others found it, and no unknown any more."""
        return replace(self, sigma_m=0.0, off_m=values.get(self.name, self.lever_m) - self.nominal_m)
