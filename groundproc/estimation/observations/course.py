"""A vehicle on wheels goes where it points: rows of the smoother."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from flightlog import frames
from groundproc.estimation.observations.measured import Heard, Learnt, Measured, Rows
from groundproc.estimation.observations.states import ATTITUDE, COURSE, VELOCITY
from groundproc.flight.sync.tracks import low_pass

COURSE_HZ: Final = 2.0
"""So often it is said."""
LEAST_SPEED_M_S: Final = 1.5
STRAIGHT_RAD_S: Final = np.deg2rad(4.0)
"""It counts at this speed and where the vehicle turns no faster: in a turn only the rear axle goes where the car points."""
NO_ROW: Final = 1e3
"""Sigma of rows that count for nothing [m/s]: they stay, so that the rows are the same ones in every iteration."""


@dataclass(frozen=True, slots=True)
class Course(Measured):
    """No speed sideways, but for an angle between the axis of the vehicle and that of the board."""

    learnt: Mapping[str, Learnt] = field(default_factory=dict)

    def rows(self, rows: Rows) -> None:
        """The velocity to the right of the heading."""
        every = max(round(1e9 / COURSE_HZ / rows.step_ns), 1)
        node = np.arange(0, len(rows.nodes_s) - 1, every)
        velocity = rows.reference.velocity_m_s[node]
        turning = low_pass(rows.rates, 0.5, 1e9 / rows.step_ns)[node]
        fast = np.hypot(*velocity[:, :2].T) > LEAST_SPEED_M_S
        straight = fast & (np.linalg.norm(turning, axis=1) < STRAIGHT_RAD_S)
        heading, _, _ = frames.attitude_of(frames.mat_from_quat(rows.reference.quat[node]))
        right, ahead = np.stack([np.cos(heading), -np.sin(heading)]), np.stack([np.sin(heading), np.cos(heading)])
        sideways, speed = (right.T * velocity[:, :2]).sum(axis=1), (ahead.T * velocity[:, :2]).sum(axis=1)
        # a turn to the left by an angle lets the same velocity be more to the right
        columns = [(VELOCITY, right[0]), (VELOCITY + 1, right[1]), (ATTITUDE + 2, speed), (COURSE, speed)]
        rows.add("course", node, columns, -sideways, np.where(straight, rows.model.sideways_m_s, NO_ROW))


def of_leg(heard: Heard) -> list[Measured]:
    """Where the vehicle drives."""
    return [Course()] if heard.driving else []
