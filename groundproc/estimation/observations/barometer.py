"""The barometer's height: a level of its own that walks with the weather. Only the smoother uses it: the lidar knows heights better."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from groundproc.estimation.observations.measured import Heard, Learnt, Measured, Rows, Stated
from groundproc.estimation.observations.states import BARO, POSITION

NOISE: Final = {"barometer": Learnt("baro_noise_m", 0.05, 5.0)}


@dataclass(frozen=True, slots=True)
class Barometer(Measured):
    """Heights by the standard atmosphere."""

    stated: Stated
    learnt: Mapping[str, Learnt] = field(default_factory=lambda: NOISE)

    def rows(self, rows: Rows) -> None:
        """Heights less their median level, which is told from what the state of the level begins with."""
        place, inside = rows.at(self.stated.baro_s)
        offset = np.median(self.stated.baro_m) - np.median(rows.reference.position_m[:, 2])
        left = self.stated.baro_m[inside] - offset - place.position_m[:, 2]
        rows.add("barometer", place.node, [(POSITION + 2, 1.0), (BARO, 1.0)], left, rows.model.baro_noise_m)


def of_leg(heard: Heard) -> list[Measured]:
    """Where the autopilot sends pressures."""
    return [Barometer(heard.stated)] if len(heard.stated.baro_s) else []
