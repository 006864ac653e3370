"""trajectory.csv: the trajectory of the INS origin, for people and other programs; written and read."""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.files import written_aside
from groundproc.flight.positions.posetable import COLUMNS, read_pose_table
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

_FORMATS: Final = "%.9f,%.9f,%.4f,%.4f,%.4f,%.4f,%.5f,%.5f,%.5f,%.4f,%.4f,%.4f,%.4f,%.4f,%.4f"
LONGEST_STEP_NS: Final = 1_000_000_000
"""Rows further apart than this are the two sides of a gap."""


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write every knot; utc_ns as a whole number, angles in degrees, heading clockwise from true north 0 to 360."""
    with written_aside(path) as aside, aside.open("w", encoding="ascii", newline="\n") as file:
        file.write(",".join(COLUMNS) + "\n")
        for start in range(0, len(trajectory), 20_000):
            part = slice(start, start + 20_000)
            heading, pitch, roll = frames.attitude_of(frames.mat_from_quat(trajectory.quat_local_ins_wxyz[part]))
            heading_deg = np.rad2deg(heading) % 360.0
            heading_deg[heading_deg >= 359.999995] = 0.0  # would be printed as 360
            rows = np.column_stack(
                [
                    *trajectory.frame.to_geodetic(trajectory.position_m[part]),
                    trajectory.position_m[part],
                    np.rad2deg(roll),
                    np.rad2deg(pitch),
                    heading_deg,
                    trajectory.sigma_position_m[part],
                    np.rad2deg(trajectory.sigma_attitude_rad[part]),
                ]
            )
            stamps = trajectory.time_ns[part]
            file.writelines(
                f"{stamp},{_FORMATS % tuple(row)}\n" for stamp, row in zip(stamps.tolist(), rows.tolist(), strict=True)
            )


def read_trajectory(path: Path, frame: LocalFrame | None = None) -> Trajectory:
    """Read a trajectory.csv, ours or another program's with the same column names.

    Parameters
    ----------
    path : Path
        Columns as `read_pose_table` wants them.
    frame : LocalFrame, optional
        Default: its origin is the first row.

    Raises
    ------
    LogError
        The file cannot be read, a column is missing, a value is no number, or the times do not increase.
    """
    table = read_pose_table(path)
    frame = frame or LocalFrame(float(table.latitude_deg[0]), float(table.longitude_deg[0]), float(table.height_m[0]))
    position = frame.from_geodetic(table.latitude_deg, table.longitude_deg, table.height_m)
    return from_poses(
        frame, table.time_ns, position, table.quat_local_ins_wxyz, table.sigma_position_m, table.sigma_attitude_rad
    )


def from_poses(
    frame: LocalFrame,
    time_ns: npt.NDArray[np.int64],
    position_m: Array,
    quat: Array,
    sigma_position_m: Array,
    sigma_rad: Array,
) -> Trajectory:
    """A trajectory through poses, shape (n, ...), with velocities and rates from their differences; steps over 1 s are gaps."""
    step_s = np.diff(time_ns) * 1e-9
    joined = np.diff(time_ns) <= LONGEST_STEP_NS
    velocity = slopes_at_knots(position_m, time_ns, joined)
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])) / step_s[:, None]
    rate = _at_knots(turn, step_s, joined)
    covered = np.append(joined, False)
    return Trajectory(frame, time_ns, position_m, velocity, quat, rate, sigma_position_m, sigma_rad, covered)


def slopes_at_knots(values: Array, time_ns: npt.NDArray[np.int64], joined: npt.NDArray[np.bool_]) -> Array:
    """Slopes of values at their times, shape (n, 3), [unit/s]; `joined`, shape (n - 1,): what follows each other without a gap."""
    step_s = np.diff(time_ns) * 1e-9
    return _at_knots(np.diff(values, axis=0) / step_s[:, None], step_s, joined)


def _at_knots(slope: Array, step_s: Array, joined: npt.NDArray[np.bool_]) -> Array:
    """Slopes at knots, shape (n, 3), from those of the steps between, shape (n - 1, 3): the parabola's; one-sided at a gap."""
    weight = np.where(joined, 1.0 / step_s, 0.0)[:, None]
    total = np.zeros((len(slope) + 1, 1))
    total[:-1] += weight
    total[1:] += weight
    summed = np.zeros((len(slope) + 1, slope.shape[1]))
    summed[:-1] += weight * slope
    summed[1:] += weight * slope
    return np.asarray(summed / np.where(total > 0.0, total, 1.0))
