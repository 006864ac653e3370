"""Method `filtered`: strapdown navigation with the gyros and accelerometers of the autopilot and the lidar, smoothed over the whole flight.

What it estimates and what it assumes stands in `groundproc.estimation.inertial`; docs/methods/filtered.md explains it.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.inertial.readings import read
from groundproc.estimation.inertial.smoother import solve
from groundproc.estimation.inertial.solution import Solution
from groundproc.estimation.legs import leg_by_leg
from groundproc.estimation.method import Given, Method, Progress
from groundproc.estimation.observations.outside import delay_sigma_s, shared
from groundproc.estimation.observations.states import (
    ATTITUDE,
    COMPASS,
    COURSE,
    FIX_AGE,
    FORCE_BIAS,
    FORCE_MATRIX,
    GYRO_BIAS,
    GYRO_MATRIX,
    POSITION,
)
from groundproc.estimation.ownsolution import PositionFixes
from groundproc.estimation.surveyed import surveyed
from groundproc.flight.positions.fixes import OutsideFixes
from groundproc.flight.timeline import Leg
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.covariance import SIZE, correlation_of, mat_attitude_turn
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

SIGMA_SOURCE: Final = (
    "covariance of the smoother; position: what the fixes state, their errors correlated over 60 s; noise of the autopilot's attitude "
    "learnt from the flight"
)
CONVERGED_M: Final = 1.0
CONVERGED_RAD: Final = np.deg2rad(1.0)


def filtered_estimate(given: Given, progress: Progress, outside: Sequence[OutsideFixes] = ()) -> Estimate:
    """Smooth each leg; a boot that never had a fix leaves a gap.

    Parameters
    ----------
    given : Given
    progress : Progress
    outside : sequence of OutsideFixes
        Positions or poses from elsewhere, in the local frame of `given`, beside those of the survey.

    Raises
    ------
    LogError
        No leg gives a trajectory, or the survey's positions cannot be read.
    """
    del progress
    outside = [*outside, *surveyed(given)]
    reports: list[dict[str, Any]] = []
    warnings: list[str] = []

    def of_leg(leg: Leg, fixes: PositionFixes) -> Trajectory:
        solution = solve_leg(given, leg, fixes, outside)
        reports.append({"boot": leg.boot.number, "lidar_run": leg.run} | report(solution))
        warnings.extend(_warnings(solution))
        return trajectory_in(given.frame, solution, late_sigma_s(solution, leg))

    trajectory = leg_by_leg(given, of_leg)
    return Estimate(trajectory, given.mount, SIGMA_SOURCE, report={"legs": reports}, warning="; ".join(warnings))


def solve_leg(given: Given, leg: Leg, fixes: PositionFixes, outside: Sequence[OutsideFixes] = ()) -> Solution:
    """The smoothed states of one leg, for those who want more than the trajectory.

    Raises
    ------
    LogError
        Position and attitude do not overlap.
    """
    run = given.flight.runs[leg.run]
    lidar = None if run.gyro is None or run.force_m_s2 is None else (run.gyro, run.force_m_s2)
    readings = read(
        leg.boot,
        fixes,
        given.frame,
        leg.utc_from_boot,
        given.mount,
        lidar=lidar,
        utc_from_lidar=leg.utc_from_lidar,
        mat_ins_lidar=leg.sync.mat_ins_lidar,
        outside=outside,
    )
    return solve(readings, given=given, leg=leg)


def late_sigma_s(solution: Solution, leg: Leg) -> float:
    """How well the lidar's clock is known to show the UTC of the outside positions in a solution [s]; without any, 0.

    Poses of an earlier estimate of the same log are on its clocks.
    """
    strange = any(len(fixes) and fixes.tied is None for fixes in solution.readings.outside)
    return delay_sigma_s(leg.utc) if strange else 0.0


def trajectory_in(frame: LocalFrame, solution: Solution, late_s: float = 0.0) -> Trajectory:
    """The trajectory of a solution, with the covariance of its poses.

    Parameters
    ----------
    frame : LocalFrame
        That of its readings.
    solution : Solution
    late_s : float
        By how much the whole may be late, one sigma: it is off by so much of its way.
    """
    covariance = pose_covariance(solution, late_s)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    kept_s = (solution.kept_ns - solution.time_ns[0]) * 1e-9
    nodes_s = (solution.time_ns - solution.time_ns[0]) * 1e-9
    at_nodes = np.stack([np.interp(nodes_s, kept_s, column) for column in sigma.T], axis=1)
    return Trajectory(
        frame=frame,
        time_ns=solution.time_ns,
        position_m=solution.position_m,
        velocity_m_s=solution.velocity_m_s,
        quat_local_ins_wxyz=solution.quat,
        rate_rad_s=solution.rate_rad_s,
        sigma_position_m=at_nodes[:, :3],
        sigma_attitude_rad=at_nodes[:, 3:],
        covered=solution.covered,
        correlation=correlation_of(solution.kept_ns, covariance),
    )


def pose_covariance(solution: Solution, late_s: float = 0.0) -> Array:
    """Covariance of east, north, up [m], roll, pitch, heading [rad] at the kept times, shape (k, 6, 6)."""
    row = np.searchsorted(solution.time_ns, solution.kept_ns)
    heading, pitch, _ = frames.attitude_of(frames.mat_from_quat(solution.quat[row]))
    states = np.r_[POSITION : POSITION + 3, ATTITUDE : ATTITUDE + 3]
    covariance = solution.covariance[:, states[:, None], states].astype(np.float64)
    covariance += shared(solution.readings.outside, solution.kept_ns)
    way = late_s * solution.velocity_m_s[row]
    covariance[:, :3, :3] += way[:, :, None] * way[:, None, :]
    # a small turn in the local frame as changes of roll, pitch, heading
    to_angles = np.tile(np.eye(SIZE), (len(row), 1, 1))
    to_angles[:, 3:, 3:] = mat_attitude_turn(heading, pitch)
    return np.asarray(to_angles @ covariance @ np.swapaxes(to_angles, 1, 2))


def report(solution: Solution) -> dict[str, Any]:
    """What quality.json says of one leg."""
    r, model = solution.readings, solution.model
    middle = len(solution.kept_ns) // 2
    state, sigma = solution.states[middle], np.sqrt(solution.variance[middle])

    def stated(first: int, count: int, unit: float = 1.0) -> dict[str, list[float]]:
        part = slice(first, first + count)
        return {"value": (state[part] * unit).tolist(), "sigma": (sigma[part] * unit).tolist()}

    degree = float(np.rad2deg(1.0))
    found: dict[str, Any] = {
        "gyros": None if r.gyro is None else r.gyro.sources,
        "accelerometers": None if r.force is None else r.force.sources,
        "iterations": solution.iterations,
        "last_step_m": solution.last_step_m,
        "last_step_deg": solution.last_step_rad * degree,
        "gyro_bias_deg_s": stated(GYRO_BIAS, 3, degree),
        "gyro_matrix": stated(GYRO_MATRIX, 9),
        "accelerometer_bias_m_s2": stated(FORCE_BIAS, 3),
        "accelerometer_matrix": stated(FORCE_MATRIX, 9),
        "fix_age_s": stated(FIX_AGE, 1),
        "compass_deg": {"terms": ["1", "sin h", "cos h", "sin 2h", "cos 2h"]} | stated(COMPASS, 5, degree),
        "tilt_error_deg": model.tilt_rad * degree,
        "heading_error_deg": model.heading_rad * degree,
        "standing_s": solution.stands_s,
        "drives": solution.driving,
        "fixes_dropped_without_gps": r.dropped_fixes,
        "measurements": {
            kind: {"rows": rows, "rms": solution.residual_rms[kind], "outliers": solution.outliers[kind]}
            for kind, rows in solution.rows.items()
        },
    }
    if solution.driving:
        found["course_deg"] = stated(COURSE, 1, degree)
    for name, signal in (("gyros", r.gyro), ("accelerometers", r.force)):
        if signal is not None:
            found[f"{name}_noise_per_sqrt_hz"] = float(np.sqrt(np.median(signal.density)))
            found[f"{name}_share_of_autopilot"] = signal.share
    return found


def _warnings(solution: Solution) -> list[str]:
    """What the self-check has against a solution."""
    if solution.last_step_m <= CONVERGED_M and solution.last_step_rad <= CONVERGED_RAD:
        return []
    moving = f"{solution.last_step_m:.2f} m and {np.rad2deg(solution.last_step_rad):.2f} deg"
    return [f"filtered: after {solution.iterations} iterations still moving by {moving}; expected to settle"]


METHOD: Final = Method(filtered_estimate, options=("positions", "poses"))
