"""Step place: every shot given its time and pose, projected, and handed to the products."""

import functools
import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

from flightlog.hdl32e import RANGE_LSB_M
from groundproc import geodesy
from groundproc.cloud.placing import write_cloud
from groundproc.flight.timeline import tied
from groundproc.geodesy import LocalFrame
from groundproc.products.pictures import draw_cloud
from groundproc.steps.ledger import INSIDE
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders, Request, Step
from groundproc.survey import PlacingSettings, Survey, section

FOUND: Final = f"{INSIDE}/place.json"
"""What quality.json says of shots and points."""


def settings(request: Request) -> Mapping[str, Any]:
    """The window of shots, the CRS, and what heights refer to."""
    survey = request.survey
    return section(survey, PlacingSettings) | {"crs": survey.crs, "height": survey.height}


def check(request: Request) -> None:
    """Refuse a wrong code before the work, not after."""
    if request.survey.crs is not None:
        geodesy.projected_crs(request.survey.crs)


def projection_of(frame: LocalFrame, survey: Survey) -> geodesy.Projection:
    """Into the survey's CRS, or the UTM zone of the frame's origin."""
    code = survey.crs or geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg)
    return geodesy.Projection(frame, geodesy.projected_crs(code))


def work(run: Run, folders: Folders) -> None:
    """Place the points and finish the products that are made of them."""
    folder = folders[WHOLE]
    made = run.estimate
    timeline = tied(run.timeline, made.ties) if made.ties else run.timeline
    projection = projection_of(made.trajectory.frame, run.survey)
    tally, sample = write_cloud(
        run.readers, timeline, made, run.survey, projection, folder, functools.partial(run.progress, "place")
    )
    draw_cloud(folder, sample, projection.crs.name)
    found = {
        "crs": {"epsg": projection.crs.to_epsg(), "name": projection.crs.name},
        "lidar": {
            "packets": tally.packets,
            "packets_outside_every_leg": tally.packets_without_leg,
            "aboard": {
                "masked_packets": tally.masked_packets,
                "masked_blocks": tally.masked_blocks,
                "kernel_drops": tally.kernel_drops,
                "queue_drops": tally.queue_drops,
                "rejected": tally.rejected,
            },
        },
        "points": {"written": tally.written, "range_step_m": RANGE_LSB_M, "shots_dropped": asdict(tally.dropped)},
    }
    path = folder / FOUND
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


STEP: Final = Step(
    name="place",
    about="points, and the products made of them",
    after=("trajectory",),
    reads_logs=True,
    settings=settings,
    work=work,
    check=check,
)
