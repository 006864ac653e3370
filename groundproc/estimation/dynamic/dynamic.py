"""Method `dynamic`: the source's dynamic calibration of the trajectory, in two passes over the flight.

Source: FOI-R--4045--SE (2014). First pass: the trims of each revolution (`search`). Second pass: their splines at 100 Hz, added to the
trajectory, with which the cloud is then made.
"""

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.errors import CoverageError
from groundproc.estimation import methods
from groundproc.estimation.calibration.compass import CompassCurve, Run, read_compass
from groundproc.estimation.dynamic import course as courses
from groundproc.estimation.dynamic.revolutions import revolutions
from groundproc.estimation.dynamic.search import VARIABLES, YAW, Found, Search
from groundproc.estimation.dynamic.trims import Trims, applied, interpolated, read_yaw
from groundproc.estimation.method import Given, Method, Progress
from groundproc.numerics import robust
from groundproc.sensors.shots import Gate
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

SETTLED_S: Final = 5.0
"""Yaw trims of the first seconds are not of the compass yet: the source's settle in 2 to 5 s [s]."""

STRAIGHT_S: Final = 2.0
STRAIGHT_RAD: Final = np.deg2rad(5.0)
"""Trims are believed where the heading has changed by less than this over so long."""
WORSE: Final = 1.02
"""Trims that make the revolutions fit each other worse than this ratio are not applied; where there is nothing to see it is 1 and noise."""


def dynamic_estimate(given: Given, progress: Progress) -> Estimate:
    """The trajectory of another method, which the survey names, trimmed.

    Raises
    ------
    CoverageError
        Not one revolution of the lidar has a pose.
    """
    options = given.survey.dynamic
    begun = methods.find(options.start).estimate(given, progress)
    curve = None if given.survey.compass is None else read_compass(Path(given.survey.compass))
    trajectory = begun.trajectory if curve is None else with_compass(begun.trajectory, curve)
    course = courses.course_of(given.fixes, [leg.utc_from_boot for leg in given.placed], given.frame)
    survey = given.survey
    gate = Gate(*survey.fov_deg, survey.min_range_m, survey.max_range_m)
    search, found = Search(options), []
    for revolution in revolutions(
        given.readers, given.timeline, trajectory, begun.mount, gate, functools.partial(progress, "adjust")
    ):
        witness = course.trim_rad(np.array([revolution.time_ns]), revolution.angles_rad[:1], options.course_speed_m_s)[
            0
        ]
        found.append(search.step(revolution, float(witness) if np.isfinite(witness) else None))
    if not found:
        raise CoverageError("method dynamic: not one revolution of the lidar has a pose and points")
    trims = _in_all(found, course, curve, options.course_speed_m_s)
    ratio = search.check.ratio()
    worse = options.robust and ratio > WORSE
    report = _report(trims, ratio, curve) | {"applied": not worse}
    if worse:
        warning = (
            f"method dynamic: with its trims revolutions fit each other worse than without ({ratio:.2f} times); the trajectory is that of "
            f"method {options.start}"
        )
        return replace(begun, trajectory=trajectory, report=report, warning=warning)
    values = interpolated(trims.time_ns, np.array([f.trims for f in found]), trajectory.time_ns, options.spline_hz)
    return replace(
        begun,
        trajectory=applied(trajectory, values),
        sigma_source=f"those of method {options.start}, less the trims: {begun.sigma_source}",
        report=report,
        figures=trims.figures(),
    )


def with_compass(trajectory: Trajectory, curve: CompassCurve) -> Trajectory:
    """The trajectory with its headings corrected by the compass model."""
    heading = _headings(trajectory)
    values = np.zeros((len(trajectory), 6))
    values[:, YAW] = curve.trim_rad(heading)
    return applied(trajectory, values)


def settled_run(path: Path) -> Run:
    """The yaw trims of a trims.csv, without the first seconds and without turns, in which they lag behind."""
    time_ns, heading, yaw = read_yaw(path)
    if len(time_ns) == 0:
        return Run(heading, yaw)
    seconds, course = (time_ns - time_ns[0]) * 1e-9, np.unwrap(heading)
    turned = np.abs(course - np.interp(seconds - STRAIGHT_S, seconds, course))
    settled = (seconds >= SETTLED_S) & (turned < STRAIGHT_RAD)
    return Run(heading[settled], yaw[settled])


def _headings(trajectory: Trajectory) -> Array:
    return frames.attitude_of(frames.mat_from_quat(trajectory.quat_local_ins_wxyz))[0]


def _in_all(found: list[Found], course: courses.Course, curve: CompassCurve | None, least_m_s: float) -> Trims:
    """The trims of the compass itself: what the curve gave and what was found after it."""
    time_ns = np.array([each.time_ns for each in found])
    corrected = np.array([each.heading_rad for each in found])
    values = np.array([each.trims for each in found])
    heading = corrected
    if curve is not None:
        for _ in range(5):  # the heading of the compass is that which the curve corrects to what was used
            heading = corrected - curve.trim_rad(heading)
        values = values.copy()
        values[:, YAW] += corrected - heading
    return Trims(time_ns, heading, values, course.trim_rad(time_ns, heading, least_m_s), found)


def _report(trims: Trims, ratio: float, curve: CompassCurve | None) -> dict[str, Any]:
    """What quality.json says."""
    ground, in_plan = (np.array([getattr(f, name) for f in trims.found]) for name in ("ground_m", "plan_m"))
    yaw_deg = np.rad2deg(np.unwrap(trims.values[:, YAW]))
    return {
        "revolutions": len(trims.found),
        "evaluations_per_revolution": max(f.evaluations for f in trims.found),
        "ground_rmse_m": _before_after(ground),
        "plan_rmse_m": _before_after(in_plan),
        "fit_with_trims_over_without": None if np.isnan(ratio) else ratio,
        "trims": {
            name: {"median": float(np.median(v)), "least": float(v.min()), "largest": float(v.max())}
            for name, v in _named(trims.values).items()
        },
        "yaw_scatter_deg": robust.sigma(np.diff(yaw_deg[::10]), 0.0) / np.sqrt(2) if len(yaw_deg) > 20 else None,
        "course": courses.compare(trims.values[:, YAW], trims.course_rad),
        "compass": None if curve is None else {"runs": curve.runs, "scatter_deg": curve.scatter_deg},
    }


def _named(values: Array) -> dict[str, Array]:
    angles = ("yaw", "pitch", "roll")
    return {
        f"{name}_{'deg' if name in angles else 'm'}": np.rad2deg(values[:, i]) if name in angles else values[:, i]
        for i, name in enumerate(VARIABLES)
    }


def _before_after(pairs: Array) -> dict[str, float] | None:
    """Mean over the revolutions that could be compared; None where none could."""
    known = pairs[np.isfinite(pairs).all(axis=1)]
    return {"before": float(known[:, 0].mean()), "after": float(known[:, 1].mean())} if len(known) else None


METHOD: Final = Method(dynamic_estimate, options=("compass", "dynamic"), uses_points=True)
