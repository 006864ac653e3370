"""A vehicle that stands has no velocity: rows of the smoother."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.observations.measured import Heard, Learnt, Measured, Rows
from groundproc.estimation.observations.states import VELOCITY

STANDING_HZ: Final = 5.0
"""So often it is said."""


@dataclass(frozen=True, slots=True)
class Standing(Measured):
    """At which nodes the vehicle stands, shape (n,)."""

    stands: npt.NDArray[np.bool_]
    learnt: Mapping[str, Learnt] = field(default_factory=dict)

    def rows(self, rows: Rows) -> None:
        """No velocity, along three axes."""
        every = max(round(1e9 / STANDING_HZ / rows.step_ns), 1)
        node = np.flatnonzero(self.stands)
        node = node[node % every == 0]
        for axis in range(3):
            left = -rows.reference.velocity_m_s[node, axis]
            rows.add("standing", node, [(VELOCITY + axis, 1.0)], left, rows.model.standing_m_s)


def of_leg(heard: Heard) -> list[Measured]:
    """Any leg: where it never stands there are no rows."""
    return [Standing(heard.stands)]
