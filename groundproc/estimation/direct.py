"""Method `ins`: the autopilot's own solution as it is, interpolated. Its parts are in `ins`."""

from typing import Final

from groundproc.estimation import ins
from groundproc.estimation.legs import leg_by_leg
from groundproc.estimation.method import Given, Method, Progress
from groundproc.estimation.ownsolution import PositionFixes
from groundproc.flight.timeline import Leg
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory


def ins_estimate(given: Given, progress: Progress) -> Estimate:
    """The autopilot's own solution, interpolated; a boot that never had a fix leaves a gap.

    Raises
    ------
    LogError
        No boot gives a trajectory.
    """
    del progress
    grid_ms = given.survey.pose_grid_ms
    grid_ns = None if grid_ms is None else round(grid_ms * 1e6)

    def of_leg(leg: Leg, fixes: PositionFixes) -> Trajectory:
        return ins.ins_trajectory(leg.boot, fixes, given.frame, leg.utc_from_boot, given.mount, grid_ns)

    return Estimate(leg_by_leg(given, of_leg), given.mount, ins.SIGMA_SOURCE)


METHOD: Final = Method(ins_estimate, options=("pose_grid_ms",))
