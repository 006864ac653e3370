"""Course over ground, by the positions of the vehicle; the witness of yaw trims, as in the source.

If a vehicle drives where it points, its course equals its heading, and the course minus the compass heading is what
the yaw trim should be. A multirotor also flies sideways. For it, the comparison says how it flew, and is no witness.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from groundproc.estimation.ownsolution import PositionFixes
from groundproc.geodesy import LocalFrame
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

LONGEST_STEP_NS = 2_000_000_000
"""Between fixes further apart there is no course."""


@dataclass(frozen=True, slots=True)
class Course:
    """Courses of a flight.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        UTC, increasing.
    course_rad : ndarray, shape (n,)
        Clockwise from north, without steps at a full turn.
    speed_m_s : ndarray, shape (n,)
    """

    time_ns: Times
    course_rad: Array
    speed_m_s: Array

    def trim_rad(self, time_ns: Times, heading_rad: Array, least_m_s: float) -> Array:
        """Course less heading, shape (n,), -pi to pi; nan where there is no fix near or it is slower than `least_m_s`."""
        if len(self.time_ns) < 2:
            return np.full(len(time_ns), np.nan)
        after = np.clip(np.searchsorted(self.time_ns, time_ns), 1, len(self.time_ns) - 1)
        step_ns = self.time_ns[after] - self.time_ns[after - 1]
        part = np.clip((time_ns - self.time_ns[after - 1]) / step_ns, 0.0, 1.0)
        slowest = np.minimum(self.speed_m_s[after], self.speed_m_s[after - 1])
        near = (step_ns < LONGEST_STEP_NS) & (time_ns >= self.time_ns[0]) & (time_ns <= self.time_ns[-1])
        course = (1 - part) * self.course_rad[after - 1] + part * self.course_rad[after]
        apart = (course - heading_rad + np.pi) % (2 * np.pi) - np.pi
        return np.where(near & (slowest >= least_m_s), apart, np.nan)


def course_of(
    fixes: Sequence[PositionFixes], utc_from_boot: Sequence[Callable[[Times], Times]], frame: LocalFrame
) -> Course:
    """The course by the velocities that come with the fixes, else by the differences of positions.

    Parameters
    ----------
    fixes : sequence of PositionFixes
    utc_from_boot : sequence of callable
        Of each, from boot time to UTC [ns].
    frame : LocalFrame
    """
    times, velocities = [], []
    for fix, to_utc in zip(fixes, utc_from_boot, strict=True):
        if len(fix.time_ns) < 2:
            continue
        velocity = fix.velocity_m_s
        if velocity is None or not np.any(velocity):
            east_north_up = frame.from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height_m)
            velocity = np.gradient(east_north_up, fix.time_ns * 1e-9, axis=0)
        times.append(to_utc(fix.time_ns))
        velocities.append(velocity[:, :2])
    if not times:
        return Course(np.empty(0, np.int64), np.empty(0), np.empty(0))
    time_ns, velocity = np.concatenate(times), np.concatenate(velocities)
    time_ns, first = np.unique(time_ns, return_index=True)
    velocity = velocity[first]
    course = np.unwrap(np.arctan2(velocity[:, 0], velocity[:, 1]))
    return Course(time_ns, course, np.linalg.norm(velocity, axis=1))


def compare(trim_rad: Array, course_trim_rad: Array) -> dict[str, Any]:
    """How yaw trims lie against the course over ground, for the report; shapes (n,), nan where there is no course."""
    known = np.isfinite(course_trim_rad)
    if not known.any():
        return {"share": 0.0}
    apart_deg = np.rad2deg((trim_rad - course_trim_rad + np.pi) % (2 * np.pi) - np.pi)[known]
    return {
        "share": float(known.mean()),
        "trim_minus_course_median_deg": float(np.median(apart_deg)),
        "trim_minus_course_rms_deg": float(np.sqrt(np.square(apart_deg).mean())),
        "scatter_deg": robust.sigma(apart_deg),
    }
