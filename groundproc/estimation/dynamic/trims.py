"""Trims over time: splines between them, the second pass over the trajectory, and trims.csv."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from flightlog import frames
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError
from groundproc.estimation.dynamic.search import VARIABLES, Found
from groundproc.text import decimal_comma, open_text, table_of
from groundproc.trajectory.table import from_poses
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

LONGEST_STEP_NS: Final = NS_PER_S
"""Over a longer silence of the lidar no spline is laid: it would swing; a straight line takes its place."""
COLUMNS: Final = (
    "utc_ns", "heading_deg", "yaw_deg", "altitude_m", "pitch_deg", "roll_deg", "x_m", "y_m", "course_minus_heading_deg",
    "ground_before_m", "ground_after_m", "plan_before_m", "plan_after_m", "pixels",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Trims:
    """Trims of a flight, one row for each revolution.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
    heading_rad : ndarray, shape (n,)
        As the compass had it.
    values : ndarray, shape (n, 6)
        In the order of search.VARIABLES, in all: that of a compass curve included.
    course_rad : ndarray, shape (n,)
        Course over ground less heading; nan where there is none.
    found : sequence of Found
        What the search says of each.
    """

    time_ns: Times
    heading_rad: Array
    values: Array
    course_rad: Array
    found: Sequence[Found]

    def figures(self) -> dict[str, npt.NDArray[Any]]:
        """The same as plain arrays, for the picture and the table.

        trims.time_ns, heading_rad, course_rad; the trims yaw_rad, altitude_m, pitch_rad, roll_rad, x_m, y_m, shape (n,);
        trims.ground_m, plan_m, shape (n, 2): RMSE before and after; trims.pixels, shape (n,).
        """
        units = {name: "rad" if name in ("yaw", "pitch", "roll") else "m" for name in VARIABLES}
        return {
            "trims.time_ns": self.time_ns,
            "trims.heading_rad": self.heading_rad,
            "trims.course_rad": self.course_rad,
            **{f"trims.{name}_{unit}": self.values[:, i] for i, (name, unit) in enumerate(units.items())},
            "trims.ground_m": np.array([each.ground_m for each in self.found], np.float64).reshape(-1, 2),
            "trims.plan_m": np.array([each.plan_m for each in self.found], np.float64).reshape(-1, 2),
            "trims.pixels": np.array([each.pixels for each in self.found], np.int64),
        }


def interpolated(time_ns: Times, values: Array, asked_ns: Times, rate_hz: float) -> Array:
    """Trims, shape (n, 6), at asked times, shape (m, 6), by a cubic spline on a grid of `rate_hz`; held beyond the first and the last."""
    step_ns = max(1, round(NS_PER_S / rate_hz))
    grid = np.arange(time_ns[0], time_ns[-1] + step_ns, step_ns, dtype=np.int64)
    seconds, asked_s = (time_ns - time_ns[0]) * 1e-9, (grid - time_ns[0]) * 1e-9
    on_grid = np.stack([np.interp(asked_s, seconds, column) for column in values.T], axis=1)
    edges = [0, *(np.flatnonzero(np.diff(time_ns) > LONGEST_STEP_NS) + 1).tolist(), len(time_ns)]
    for a, b in itertools.pairwise(edges):
        inside = (asked_s >= seconds[a]) & (asked_s <= seconds[b - 1])
        if b - a > 3 and inside.any():
            on_grid[inside] = CubicSpline(seconds[a:b], values[a:b])(asked_s[inside])
    at_s = (asked_ns - time_ns[0]) * 1e-9
    return np.stack([np.interp(at_s, asked_s, column) for column in on_grid.T], axis=1)


def applied(trajectory: Trajectory, values: Array) -> Trajectory:
    """The trajectory with trims, shape (n, 6), at its knots: step 3 of the source's geometry."""
    heading, pitch, roll = frames.attitude_of(frames.mat_from_quat(trajectory.quat_local_ins_wxyz))
    turned = frames.mat_local_ins(heading + values[:, 0], pitch + values[:, 2], roll + values[:, 3])
    position = trajectory.position_m + values[:, [4, 5, 1]]
    made = from_poses(
        trajectory.frame,
        trajectory.time_ns,
        position,
        frames.quat_from_mat(turned),
        trajectory.sigma_position_m,
        trajectory.sigma_attitude_rad,
    )
    return replace(
        made,
        covered=made.covered & trajectory.covered,
        interpolation=trajectory.interpolation,
        correlation=trajectory.correlation,
    )


def read_yaw(path: Path) -> tuple[Times, Array, Array]:
    """Times [ns], compass headings and yaw trims [rad] of a trims.csv, each of shape (n,).

    Raises
    ------
    LogError
        It cannot be read, or is not such a table.
    """
    try:
        with open_text(path) as file:
            trims = table_of(file, str(path), "utc_ns", LogError, f"expected {', '.join(COLUMNS[:3])}")
            places = [trims.names.index(name) for name in ("utc_ns", "heading_deg", "yaw_deg")]
            rows = [words for _, words in trims.rows()]
        if rows and (comma := decimal_comma(rows[0])):
            raise LogError(f"{path}: {comma}")
        time_ns = np.array([int(row[places[0]]) for row in rows], np.int64)
        angles = np.array([[float(row[place]) for place in places[1:]] for row in rows]).reshape(-1, 2)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, IndexError, OverflowError):
        raise LogError(
            f"{path}: is no table of trims; expected the columns {', '.join(COLUMNS[:3])} and numbers"
        ) from None
    if not np.isfinite(angles).all():
        raise LogError(f"{path}: a heading or yaw trim is no finite number")
    return time_ns, np.deg2rad(angles[:, 0]), np.deg2rad(angles[:, 1])
