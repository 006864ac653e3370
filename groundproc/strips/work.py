"""`swath adjust` as a list of stages: times and strips, clusters, adjustment, points anew, check, report."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.clock import utc_text
from flightlog.errors import CoverageError, SwathError, UsageError
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.sameness import agreed_map_crs
from groundproc.files import made_folder
from groundproc.geodesy import check_area
from groundproc.strips import report
from groundproc.strips.adjust import COARSEST_M, MOST_INTERVALS, Adjusted, Sigmas, adjust
from groundproc.strips.clouds import chunks, look, rewriters
from groundproc.strips.clusters import CLUSTER, Gatherer
from groundproc.strips.control import as_clusters, read_control
from groundproc.strips.correction import Correction
from groundproc.strips.cutting import BIN_NS, Occupancy, Strips
from groundproc.strips.density import Density
from groundproc.strips.differences import Differences, Patches
from groundproc.strips.options import HOLD, StripOptions
from groundproc.strips.route import Route, read_route
from groundproc.strips.site import Site

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Progress = Callable[[str, int], None]
"""Is told the stage ("times", "patches", "points") and how many more points are through it."""

FEWEST: Final = 30
"""Patches seen by two strips, without which there is nothing to adjust by."""
_DEFAULT_POSITION_M: Final = 0.3
_DEFAULT_ATTITUDE_RAD: Final = np.deg2rad(0.1)
_SLACK: Final = 1.02
_SLACK_SIGMAS: Final = 0.2
"""Differences may seem larger afterwards by this factor and this part of what noise makes of them: they are of other samples of points."""


@dataclass(frozen=True, slots=True)
class Task:
    """What to adjust.

    Attributes
    ----------
    clouds : sequence of Path
    trajectory : Path
    folder : Path
        Of the results.
    crs : pyproj.CRS or None
        In place of the clouds' own.
    week : int or None
        GPS week, where neither clouds nor trajectory know it.
    undulation_m : float
        Taken off the trajectory's heights.
    control : Path or None
    options : StripOptions
    crs_anyway : bool
        Take a CRS that is not made for where the trajectory is.
    """

    clouds: Sequence[Path]
    trajectory: Path
    folder: Path
    crs: pyproj.CRS | None = None
    week: int | None = None
    undulation_m: float = 0.0
    control: Path | None = None
    options: StripOptions = field(default_factory=StripOptions)
    crs_anyway: bool = False


def run(task: Task, progress: Progress) -> dict[str, Any]:
    """Adjust, write, and give what the report holds.

    Raises
    ------
    SwathError
        Input that cannot be used, or a result that is worse than it: then nothing is written.
    """
    site = _site(task)
    control = None if task.control is None else read_control(task.control)
    strips, voxel_m, sigmas = _survey(site, progress)
    clusters, before, share, arm_m = _patches(site, strips, voxel_m, progress)
    start, end = int(site.route.poses.time_ns[0]), int(site.route.poses.time_ns[-1])
    knots_s = max(task.options.knots_s, (end - start) * 1e-9 / MOST_INTERVALS)
    correction = Correction.none(start, end, knots_s)
    adjusted = Adjusted(correction, None, {})
    overlapping = len(before) >= FEWEST or control is not None
    if overlapping:
        control_sigma = np.zeros(len(clusters))
        if control is not None:
            clusters = np.concatenate([clusters, as_clusters(control, site.route.origin_m, end)])
            control_sigma = np.concatenate([control_sigma, control[:, 3]])
        first_m = float(np.clip(2.0 * _capture_m(site, sigmas, arm_m), voxel_m, COARSEST_M))
        adjusted = adjust(
            clusters, control_sigma, correction, voxel_m, first_m, sigmas, task.options, site.route.has_attitude
        )
    note = "" if adjusted.linear is not None else _nothing(strips, before)
    with made_folder(task.folder):
        _write(task, site, strips, voxel_m, sigmas, share, adjusted, before, note, progress)
        return report.finished(task.folder)


def _capture_m(site: Site, sigmas: Sigmas, arm_m: float) -> float:
    """What strips may differ by to begin with: three sigmas of what is known before."""
    options = site.options
    boresight = (
        np.deg2rad(options.boresight_sigma_deg) if options.boresight != HOLD and site.route.has_attitude else 0.0
    )
    angle = np.hypot(sigmas.attitude_rad, boresight)
    return options.capture_m or 3.0 * float(np.hypot(sigmas.position_m, angle * arm_m))


def _nothing(strips: Strips, before: Differences) -> str:
    return (
        f"{len(strips)} strips have {len(before)} planar patches in common, expected {FEWEST} or more: there is nothing to adjust by, "
        "and the points are as they were"
    )


def _site(task: Task) -> Site:
    names = [path.with_suffix(".laz").name for path in task.clouds]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"{name}: two files would get this name; adjust files of different names")
        if any(path.resolve() == (task.folder / name).resolve() for path in task.clouds):
            raise UsageError(f"{task.folder / name}: is an input; say another folder with -o")
    clouds = [look(path) for path in task.clouds]
    crs = agreed_map_crs(clouds, task.crs)
    clock = Clock(task.week)
    near = None
    if (standard := next((c for c in clouds if not c.week_time), None)) is not None:
        # the median: a single point without a time would be of 2011
        near = int(np.median(next(chunks([standard], clock)).time_ns))
    if near is None and task.week is None:
        try:
            route = read_route(task.trajectory, crs, near_utc_ns=None, week=None, undulation_m=task.undulation_m)
        except UsageError as error:
            raise UsageError(f"{error}; say it with --week") from None
    else:
        route = read_route(task.trajectory, crs, near_utc_ns=near, week=task.week, undulation_m=task.undulation_m)
    if not task.crs_anyway:
        check_area(crs, route.latitude_deg, route.longitude_deg)
    times = route.poses.time_ns
    return Site(clouds, Clock(task.week, int(times[len(times) // 2])), route, task.options)


def _survey(site: Site, progress: Progress) -> tuple[Strips, float, Sigmas]:
    """First pass: when there are points and how dense they are."""
    occupancy, density = Occupancy(site.route), Density()
    total, first, last = 0, None, 0
    for chunk in chunks(site.clouds, site.clock, site.options.all_classes):
        _, covered = site.route.poses.where_covered(chunk.time_ns)
        total += len(covered)
        site.outside += int((~covered).sum())
        low, high = int(chunk.time_ns.min()), int(chunk.time_ns.max())
        first, last = low if first is None else min(first, low), max(last, high)
        occupancy.add(chunk.time_ns[covered], chunk.source[covered], chunk.file)
        site.no_surface += int((~chunk.stands).sum())
        density.add(chunk.xyz_m[covered & chunk.stands] - site.route.origin_m)
        progress("times", len(covered))
    if site.outside > total // 2:
        times = site.route.poses.time_ns
        raise CoverageError(
            f"{site.outside} of {total} points lie outside of the trajectory: it covers {utc_text(int(times[0]))} to "
            f"{utc_text(int(times[-1]))}, the points {utc_text(first or 0)} to {utc_text(last)}"
        )
    options = site.options
    strips = occupancy.cut(options.gap_s, options.turn_deg)
    voxel_m = options.voxel_m or density.voxel_m()
    return strips, voxel_m, _sigmas(site.route, options)


def _sigmas(route: Route, options: StripOptions) -> Sigmas:
    def stated(sigma: Array, default: float) -> float:
        return float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else default

    return Sigmas(
        options.position_sigma_m or max(stated(route.poses.sigma_position_m, _DEFAULT_POSITION_M), 1e-3),
        np.deg2rad(options.attitude_sigma_deg)
        or max(stated(route.poses.sigma_attitude_rad, _DEFAULT_ATTITUDE_RAD), 1e-5),
    )


def _patches(
    site: Site, strips: Strips, voxel_m: float, progress: Progress
) -> tuple[npt.NDArray[np.void], Differences, float, float]:
    """Second pass: clusters, differences as they are, share of voxels kept, and the usual distance from the scanner."""
    gatherer, patches = Gatherer(0.5 * voxel_m, site.options.clusters), Patches(voxel_m)
    for chunk in chunks(site.clouds, site.clock, site.options.all_classes):
        covered, place, scanner, quat = site.placed(chunk)
        strip = strips.of(chunk.time_ns)
        use = covered & chunk.stands
        strip[~use] = -1
        bins = (chunk.time_ns - strips.start_ns) // BIN_NS
        gatherer.add(chunk.time_ns[use], place[use], scanner[use], quat[use], strip[use], bins[use])
        patches.add(place, strip)
        progress("patches", len(covered))
    clusters = gatherer.clusters()
    if not len(clusters):
        clusters = np.zeros(0, CLUSTER)
    arm = float(np.median(np.linalg.norm(clusters["arm"], axis=1))) if len(clusters) else 0.0
    return clusters, patches.differences(), gatherer.share, arm


def _write(
    task: Task, site: Site, strips: Strips, voxel_m: float, sigmas: Sigmas, share: float, adjusted: Adjusted, before: Differences,
    note: str, progress: Progress,
) -> None:  # fmt: skip
    """Third pass: every point anew, looked at as it is stored; names are given when the check is passed."""
    patches = Patches(voxel_m)
    moved = report.Moved()
    with contextlib.ExitStack() as stack:
        writers = stack.enter_context(rewriters(site.clouds, task.folder))
        for chunk in chunks(site.clouds, site.clock, site.options.all_classes):
            covered, place, scanner, quat = site.placed(chunk)
            move, _ = adjusted.correction.moved(chunk.time_ns, place - scanner, quat)
            move[~covered] = 0.0
            stored = writers[chunk.file].write(chunk.record, move)
            moved.add(move[covered])
            strip = strips.of(chunk.time_ns)
            strip[~(covered & chunk.stands)] = -1
            patches.add(stored - site.route.origin_m, strip)
            progress("points", len(covered))
        after = patches.differences()
        check(before, after)
        report.write(
            task.folder,
            report.Facts(site, strips, voxel_m, sigmas, share, adjusted, before, after, moved, note, task.control),
        )


def check(before: Differences, after: Differences) -> None:
    """See that strips fit no worse than they did.

    Raises
    ------
    SwathError
        They do; nothing should be kept.
    """
    if len(before) < FEWEST:
        return
    if len(after) < 0.5 * len(before):
        raise SwathError(
            f"self-check: {len(after)} patches are common to strips after the adjustment, {len(before)} were before; nothing was written"
        )
    expected = float(np.median(before.sigma_m))
    for name, old, new in (
        ("along normals", before.along_m, after.along_m),
        ("in height", before.height_m(), after.height_m()),
        ("in plan", before.plan_m(), after.plan_m()),
    ):
        if min(len(old), len(new)) < FEWEST:
            continue
        was, now = float(np.median(np.abs(old))), float(np.median(np.abs(new)))
        if now > _SLACK * was + _SLACK_SIGMAS * expected:
            raise SwathError(
                f"self-check: strips differ by {now:.4f} m {name} (median) after the adjustment, by {was:.4f} m before; nothing was written"
            )
