"""A trajectory made leg by leg."""

from collections.abc import Callable

import numpy as np

from flightlog.errors import LogError
from groundproc.estimation.method import Given
from groundproc.estimation.ownsolution import PositionFixes
from groundproc.flight.timeline import Leg
from groundproc.trajectory.trajectory import Trajectory, joined


def leg_by_leg(given: Given, make: Callable[[Leg, PositionFixes], Trajectory]) -> Trajectory:
    """The legs' trajectories one after the other; a boot that never had a fix leaves a gap.

    A boot that continued over a jump of the lidar's clock belongs to two legs, one on either side of the jump.

    Parameters
    ----------
    given : Given
    make : callable
        Makes the trajectory of one leg; LogError where it cannot.

    Raises
    ------
    LogError
        No leg gives a trajectory.
    """
    placed = given.placed
    parts: list[Trajectory] = []
    reasons: list[LogError] = []
    for number, (leg, fixes) in enumerate(zip(placed, given.fixes, strict=True)):
        try:
            part = make(leg, fixes)
        except LogError as error:
            reasons.append(error)
            continue
        if number and placed[number - 1].boot is leg.boot and parts:
            part = part.after(int(parts[-1].time_ns[-1]))
        if number + 1 < len(placed) and placed[number + 1].boot is leg.boot:
            part = part.before(int(leg.utc_from_lidar(np.array([leg.last_lidar_ns]))[0]))
        if len(part) > 1:
            parts.append(part)
    if reasons and not parts:
        raise reasons[0]
    return joined(parts)
