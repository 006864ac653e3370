"""Step place: every shot given its time and pose, projected, and handed to the products."""

import contextlib
import functools
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError, LogError, UsageError
from groundproc import geodesy
from groundproc.cloud import attributes, placing
from groundproc.cloud.points import Points
from groundproc.cloud.pointsigma import MountErrors
from groundproc.cloud.setaside import Parts, SetAside
from groundproc.flight.lidar import lidar_of
from groundproc.flight.shots import Tally, shots
from groundproc.flight.timeline import tied
from groundproc.geodesy import LocalFrame
from groundproc.machine.system import cores
from groundproc.products import chosen, longest_first, plain
from groundproc.products.product import Context, streamed
from groundproc.reporting.cloudpart import CLOUDS, foreseen
from groundproc.sensors.model import Lidar
from groundproc.sensors.shots import Gate
from groundproc.steps.ledger import INSIDE
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders, Step
from groundproc.steps.trim import check_times, selection_of
from groundproc.strips.cutting import line_begins_ns
from groundproc.strips.options import StripOptions
from groundproc.survey import AttributeSettings, PlacingSettings, Survey, TrimSettings, section
from groundproc.trajectory.estimate import Estimate
from groundproc.vectors.features import read_features
from groundproc.viewer.thinning import stretches

FOUND: Final = f"{INSIDE}/place.json"
"""What quality.json says of shots and points."""
OCTREE, CLOUD = CLOUDS
REPORT: Final = "report.html"


def settings(request: Request) -> Mapping[str, Any]:
    """The window of shots, what is said of each point, the CRS, and what heights refer to."""
    survey = request.survey
    return section(survey, PlacingSettings, AttributeSettings, TrimSettings) | {
        "crs": survey.crs,
        "crs_anyway": survey.crs_anyway,
        "height": survey.height,
    }


def files(request: Request) -> Mapping[str, Path]:
    """The file of the area, if there is one."""
    area = request.survey.area
    return {} if area is None else {"area": Path(area)}


def parts(request: Request) -> Mapping[str, Any]:
    """What became of the shots, and each product that takes points: one more costs a pass, and those that are there stay."""
    return {WHOLE: {}} | {each.name: plain([each]) for each in chosen(request.survey.products) if each.takes_points}


def check(request: Request) -> None:
    """Refuse what cannot be, or would not be used, before the work, not after."""
    survey = request.survey
    chosen(survey.products)
    attributes.wanted(survey.attributes)
    check_times(survey.times)
    if survey.area is not None:
        read_features(Path(survey.area), "Polygon")
    elif survey.area_keeps == "outside":
        raise UsageError("area_keeps: outside given, but nothing uses it; expected with an area")
    if survey.crs is not None:
        geodesy.projected_crs(survey.crs)
    elif survey.crs_anyway:
        raise UsageError("crs_anyway given, but no crs; without one the UTM zone of the flight is taken")
    if survey.geoid is not None and survey.height != "ellipsoid" and survey.positions is None:
        raise UsageError(
            f"geoid: {survey.geoid} given, but nothing uses it: heights are {survey.height}, and there are no outside "
            "positions; expected with height ellipsoid or with positions"
        )


def projection_of(frame: LocalFrame, survey: Survey) -> geodesy.Projection:
    """Into the survey's CRS, or the UTM zone of the frame's origin."""
    code = survey.crs or geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg)
    return geodesy.Projection(frame, geodesy.projected_crs(code))


def check_place(survey: Survey, latitude_deg: npt.ArrayLike, longitude_deg: npt.ArrayLike) -> None:
    """Refuse a CRS that is not made for where the flight was, unless the user wants it anyway."""
    if survey.crs is not None and not survey.crs_anyway:
        geodesy.check_area(geodesy.projected_crs(survey.crs), latitude_deg, longitude_deg)


def work(run: Run, folders: Folders) -> None:
    """Place the points and finish the products that are made of them."""
    made = run.estimate
    timeline = tied(run.timeline, made.ties) if made.ties else run.timeline
    latitude, longitude, _ = made.trajectory.frame.to_geodetic(made.trajectory.position_m)
    check_place(run.survey, latitude, longitude)
    projection = projection_of(made.trajectory.frame, run.survey)
    survey, tally, lidar = run.survey, Tally(), lidar_of(run.readers)
    context = Context(run.folder, run.folder, survey, made, projection, inputs=run.names)
    gate = Gate(*survey.fov_deg, survey.min_range_m, survey.max_range_m)
    lasers, names = made.corrections.table(lidar.lasers), attributes.wanted(survey.attributes)
    told = shared(functools.partial(run.progress, "place"), attributes.passes(names))
    tallies = itertools.chain([tally], itertools.repeat(None))  # the packets of a second pass are the same ones

    def stream() -> Iterator[Points]:
        seen = shots(run.readers, timeline, gate, lasers, next(tallies), told)
        return placing.placed(seen, made.trajectory, made.mount)

    found, selection = attributes.Found(), selection_of(survey, made.trajectory, projection.crs)
    lines = line_begins_ns(made.trajectory, StripOptions().turn_deg)
    scene = attributes.Scene(made.trajectory, made.mount, mount_errors(made, survey), lidar.ranging, lines)
    shown = shown_of_laz(run, folders)

    def wanted() -> Parts:
        return [] if selection.choices else stretches(found.points, shown)  # how many a choice leaves is not known yet

    aside = SetAside(wanted) if shown else None
    with contextlib.ExitStack() as stack:
        sinks: list[placing.Sink] = []
        for each in longest_first(chosen(survey.products)):
            if each.name in folders:
                own = replace(context, folder=folders[each.name], set_aside=aside if each.name == CLOUD else None)
                sinks += stack.enter_context(streamed([each], own))
        try:
            described = attributes.described(stream, scene, names, found)
            if shown:
                sinks = foreseeing(run, folders, sinks, shown, aside)
            placed = placing.handed_on(described, made.trajectory, projection, sinks, selection)
        except CoverageError:
            if tally.packets:
                raise
            raise LogError(
                f"{run.readers[0].path}: no lidar packets in the log, so that there is nothing to place"
            ) from None
    if WHOLE in folders:
        _tell(folders[WHOLE] / FOUND, lidar, projection, tally, placed, found)


def shown_of_laz(run: Run, folders: Folders) -> int:
    """How many points of the cloud.laz that is being made its report will show, if they can be found beside the finishing of the others.

    0 where the report shows the octree, where photographs or uses come before it, which may change the cloud and need the memory, and on
    one core.
    """
    survey = run.survey
    asked = {each.name: each for each in chosen(survey.products)}
    late = survey.images is not None or survey.uses
    if REPORT not in asked or OCTREE in asked or CLOUD not in folders or late or not run.whole or cores() == 1:
        return 0
    (options,) = asked[REPORT].options
    return int(options.points)


def foreseeing(
    run: Run, folders: Folders, sinks: list[placing.Sink], shown: int, aside: SetAside | None
) -> list[placing.Sink]:
    """The sinks; what the report will show of cloud.laz is found as soon as that is closed, beside the finishing of the others."""

    def read() -> None:
        run.foreseen = foreseen(folders[CLOUD] / CLOUD, shown, aside)

    return [placing.Then(sinks[0], read), *sinks[1:]]


def mount_errors(made: Estimate, survey: Survey) -> MountErrors:
    """How well the mount is known, where the sigmas of the poses do not hold that already.

    Where poses and mount are estimated together, from the lidar itself, their errors take each other away in the cloud.
    """
    worse = made.figures.get("adjustment.is_worse")
    if made.mount_sigma is not None or (worse is not None and not worse):
        return MountErrors(np.zeros(3), np.zeros(3))
    return MountErrors(np.full(3, np.deg2rad(survey.boresight_sigma_deg)), np.zeros(3))


def shared(told: Callable[[int], None], passes: int) -> Callable[[int], None]:
    """Tell of the bytes of several passes as if they were one."""
    left = 0

    def tell(done: int) -> None:
        nonlocal left
        whole, left = divmod(left + done, passes)
        told(whole)

    return tell


def _tell(
    path: Path,
    lidar: Lidar,
    projection: geodesy.Projection,
    tally: Tally,
    placed: placing.Placed,
    seen: attributes.Found,
) -> None:
    """Write what became of the shots."""
    found = {
        "crs": {"epsg": projection.crs.to_epsg(), "name": projection.crs.name},
        "lidar": {
            "model": lidar.name,
            "packets": tally.packets,
            "packets_outside_every_leg": tally.packets_without_leg,
            "lost_packets": tally.lost_packets,
            "aboard": {
                "masked_packets": tally.masked_packets,
                "masked_blocks": tally.masked_blocks,
                "kernel_drops": tally.kernel_drops,
                "queue_drops": tally.queue_drops,
                "rejected": tally.rejected,
            },
        },
        "points": {
            "written": placed.points,
            "range_step_m": lidar.range_step_m,
            "shots_dropped": asdict(placed.dropped),
            "left_out": dict(placed.left_out),
        }
        | seen.tell(),
    }
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


STEP: Final = Step(
    name="place",
    about="points, and the products made of them",
    after=("trajectory",),
    reads_logs=True,
    settings=settings,
    work=work,
    files=files,
    check=check,
    parts=parts,
)
