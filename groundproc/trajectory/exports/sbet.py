"""SBET, and where its name begins with sbet, its accuracy file smrmsg beside.

The wander angle is zero: the velocities are north, east, down. Accelerations are those of the origin over the ground, without gravity, and
rates those of the body, both forward, right, down.
"""

from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.flight.positions.sbet import ACCURACY_RECORD, MINUTE_RAD, RECORD, accuracy_beside
from groundproc.flight.positions.scales import EPOCH_NS, WEEK_NS, gps_calendar_from_utc
from groundproc.flight.positions.solution import ELLIPSOID, Solution
from groundproc.trajectory.exports.source import Source
from groundproc.trajectory.table import slopes_at_knots

Array = npt.NDArray[np.float64]

_NOT_STATED: Final = np.nan


def writers(name: Path) -> dict[Path, partial[None]]:
    """The trajectory, and its accuracies where the name has a place for them."""
    beside = accuracy_beside(name)
    return {name: partial(_write)} | ({beside: partial(_write_accuracy)} if beside is not None else {})


def _write(source: Source, path: Path) -> None:
    trajectory, solution = source.trajectory, source.solution((ELLIPSOID,))
    velocity, quat = solution.velocity_m_s, solution.quat_place_ins_wxyz
    assert velocity is not None
    assert quat is not None
    mat_place_ins = frames.mat_from_quat(quat)
    acceleration = slopes_at_knots(velocity, trajectory.time_ns, trajectory.covered[:-1])
    records = np.zeros(len(solution), RECORD)
    records["time"] = _of_week_s(solution)
    records["latitude"], records["longitude"] = np.deg2rad(solution.latitude_deg), np.deg2rad(solution.longitude_deg)
    records["altitude"] = solution.height_m
    heading, records["pitch"], records["roll"] = frames.attitude_of(mat_place_ins)
    records["platform_heading"] = np.where(heading > np.pi, heading - 2.0 * np.pi, heading)
    body = frames.ins_from_frd(np.einsum("nji,nj->ni", mat_place_ins, acceleration))
    for group, values in (
        ("velocity", frames.ins_from_frd(velocity)), ("acceleration", body), ("rate", frames.ins_from_frd(trajectory.rate_rad_s)),
    ):  # fmt: skip
        for axis, column in zip("xyz", values.T, strict=True):
            records[f"{axis}_{group}"] = column
    path.write_bytes(records.tobytes())


def _write_accuracy(source: Source, path: Path) -> None:
    solution = source.solution((ELLIPSOID,))
    records = np.full(len(solution), np.nan).astype(ACCURACY_RECORD)
    records["time"] = _of_week_s(solution)
    records["east"], records["north"], records["down"] = solution.sigma_m.T
    assert solution.attitude_covariance_rad2 is not None
    sigma = np.sqrt(np.einsum("nii->ni", solution.attitude_covariance_rad2)) / MINUTE_RAD
    records["roll"], records["pitch"], records["heading"] = sigma.T
    path.write_bytes(records.tobytes())


def _of_week_s(solution: Solution) -> Array:
    """Seconds of the GPS week in which the first record lies, on over its end, shape (n,)."""
    since_ns = gps_calendar_from_utc(solution.time_ns) - EPOCH_NS
    since_ns -= since_ns[0] // WEEK_NS * WEEK_NS
    return np.asarray(since_ns // NS_PER_S + (since_ns % NS_PER_S) / NS_PER_S)
