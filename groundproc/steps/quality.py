"""Step quality: quality.json, put together from what the finished steps left, with a verdict on all of it."""

import json
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from flightlog import FORMAT_VERSION, __version__, config
from flightlog.clock import utc_text
from groundproc.estimation import ownsolution
from groundproc.steps import OF_IMAGES, clocks, place
from groundproc.steps.photographs import found_in
from groundproc.steps.request import Request, absolute
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders, Step
from groundproc.survey import SECTIONS, Survey, section
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory
from groundproc.verdict.flight import judge_flight


def settings(request: Request) -> Mapping[str, Any]:
    """All of them: they stand in it."""
    return section(absolute(request.survey), *SECTIONS)


def work(run: Run, folders: Folders) -> None:
    """Write quality.json."""
    tied = json.loads((run.folder / clocks.FOUND).read_text(encoding="utf-8"))
    placed = json.loads((run.folder / place.FOUND).read_text(encoding="utf-8"))
    quality = describe(run.survey, run.estimate, tied, placed)
    if run.survey.images is not None:
        quality["images"] = found_in(run.folder)
    # first, where a reader of the file looks
    quality = judge_flight(quality).to_mapping() | quality
    (folders[WHOLE] / "quality.json").write_text(json.dumps(quality, indent=2) + "\n", encoding="utf-8")


def describe(survey: Survey, made: Estimate, tied: dict[str, Any], placed: dict[str, Any]) -> dict[str, Any]:
    """What went in, what was dropped and why, and how well the clocks fit."""
    trajectory = made.trajectory
    frame = trajectory.frame
    seconds = np.diff(trajectory.time_ns) * 1e-9
    return {
        "software": {"swath": __version__, "log_format": FORMAT_VERSION},
        "inputs": tied["inputs"],
        "config": config.to_mapping(survey),
        "mount": config.to_mapping(made.mount) | describe_mount(made),
        "local_frame": {
            "latitude_deg": frame.latitude_deg,
            "longitude_deg": frame.longitude_deg,
            "height_m": frame.height_m,
        },
        "crs": placed["crs"],
        "height": {"reference": survey.height, "meaning": ownsolution.HEIGHTS[survey.height]},
        "sync": tied["sync"],
        "legs": tied["legs"],
        "autopilot": tied["autopilot"],
        "trajectory": {
            "method": made.method,
            "start": utc_text(int(trajectory.time_ns[0])),
            "end": utc_text(int(trajectory.time_ns[-1])),
            "knots": len(trajectory),
            "covered_s": float(seconds[trajectory.covered[:-1]].sum()),
            "gaps_s": float(seconds[~trajectory.covered[:-1]].sum()),
            "median_sigma_m": np.median(trajectory.sigma_position_m, axis=0).tolist(),
            "largest_sigma_m": np.max(trajectory.sigma_position_m, axis=0).tolist(),
            "median_sigma_attitude_deg": np.rad2deg(np.median(trajectory.sigma_attitude_rad, axis=0)).tolist(),
            "turn_rate_deg_s": turn_rate_deg_s(trajectory),
            "sigma_source": made.sigma_source,
            "note": made.note,
            "warning": made.warning,
        },
        **({made.method: made.report} if made.report else {}),
        "lidar": placed["lidar"],
        "points": placed["points"],
    }


def turn_rate_deg_s(trajectory: Trajectory) -> float:
    """What 19 of 20 knots turn slower than [deg/s]."""
    return float(np.rad2deg(np.percentile(np.linalg.norm(trajectory.rate_rad_s, axis=1), 95.0)))


def describe_mount(made: Estimate) -> dict[str, Any]:
    """Where the mount that was used comes from, and how well it is known where it was estimated."""
    sigma, stated = made.mount_sigma, None
    if sigma is not None:
        arm = None if sigma.position_m is None else list(sigma.position_m)
        stated = {"turn_deg": np.rad2deg(sigma.turn_rad).tolist(), "position_m": arm}
    return {"source": made.mount_source, "sigma": stated}


STEP: Final = Step(
    name="quality",
    about="figures about the flight and the products",
    after=("clocks", "trajectory", "place", *OF_IMAGES),
    reads_logs=False,
    settings=settings,
    work=work,
)
