"""Points: returns placed in the world, and what became of the shots that made none."""

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog.errors import UsageError
from groundproc.cloud.dimensions import dimension

Array = npt.NDArray[np.float64]
Column = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Dropped:
    """Shots that made no point, by the reason met first.

    Attributes
    ----------
    no_pose : int
        Returns within field of view and range gate that the trajectory does not cover.
    outside_fov : int
    no_return : int
    out_of_range : int
        A return outside the range gate.
    impossible : int
        Its place is no number, or far beyond any flight.
    """

    no_pose: int = 0
    outside_fov: int = 0
    no_return: int = 0
    out_of_range: int = 0
    impossible: int = 0

    def __add__(self, other: "Dropped") -> "Dropped":
        return Dropped(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


@dataclass(frozen=True, slots=True)
class Points:
    """Returns placed in the world, in the order they were received.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        UTC; on the sensor's own scale where that is tied to nothing.
    xyz_m : ndarray, shape (n, 3)
        Local (east, north, up); easting, northing, height once projected; right, ahead, up in the sensor's frame.
    columns : mapping of str to ndarray, shape (n,)
        By names of `dimensions.TABLE`, values in the units given there. `points["range"]` is one of them.
    dropped : Dropped
    """

    time_ns: npt.NDArray[np.int64]
    xyz_m: Array
    columns: Mapping[str, Column] = field(default_factory=dict)
    dropped: Dropped = field(default_factory=Dropped)

    def __post_init__(self) -> None:
        assert self.xyz_m.shape == (len(self.time_ns), 3), self.xyz_m.shape
        for name, values in self.columns.items():
            entry = dimension(name)
            assert values.shape == (len(self.time_ns),), (name, values.shape)
            assert entry.holds(values), f"{name}: {values.dtype} found, expected {entry.column}"

    def __len__(self) -> int:
        return len(self.time_ns)

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def __getitem__(self, name: str) -> Column:
        """A column.

        Raises
        ------
        UsageError
            These points have none of that name.
        """
        try:
            return self.columns[name]
        except KeyError:
            entry = dimension(name)
            had = ", ".join(self.columns) or "no attributes"
            raise UsageError(
                f"{name} ({entry.brief}) found in none of the points, which have {had}; {entry.source} fills it"
            ) from None

    def masked(self, where: npt.NDArray[Any] | slice) -> "Points":
        """Some of the points: a mask, numbers or a slice. What was dropped stays as it is."""
        if isinstance(where, slice):
            return self._each(lambda values: values[where])
        # numpy picks rows of coordinates by numbers in a third of the time that it takes by a mask
        numbers = np.flatnonzero(where) if where.dtype == np.bool_ else where
        return self._each(lambda values: values.take(numbers, axis=0))

    def _each(self, picked: Callable[[Column], Column]) -> "Points":
        """The points with something picked of each array."""
        columns = {name: picked(values) for name, values in self.columns.items()}
        return replace(self, time_ns=picked(self.time_ns), xyz_m=picked(self.xyz_m), columns=columns)

    def with_columns(self, **columns: Column) -> "Points":
        """The points with more columns, or with others in their place."""
        return replace(self, columns={**self.columns, **columns})
