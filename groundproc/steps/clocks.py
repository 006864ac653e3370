"""Step clocks: read the logs but for the points, and put lidar and autopilot on one time scale."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from flightlog.clock import utc_text
from flightlog.constants import HOUR_NS
from flightlog.logfile import LogReader
from flightlog.mount import load_mount
from groundproc.estimation import ownsolution
from groundproc.flight.autopilot import Boot
from groundproc.flight.summary.telemetry import FIX_3D
from groundproc.flight.timeline import Leg
from groundproc.steps.ledger import INSIDE
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders, Step
from groundproc.survey import ClockSettings, MountSettings, section

FOUND: Final = f"{INSIDE}/clocks.json"
"""What quality.json says of the logs and their clocks."""


def settings(request: Request) -> Mapping[str, Any]:
    """How the clocks are tied; the mount tells the rotation between the gyros."""
    return section(request.survey, ClockSettings, MountSettings)


def files(request: Request) -> Mapping[str, Path]:
    """The mount file."""
    return {"mount": Path(request.survey.mount)} if isinstance(request.survey.mount, str) else {}


def check(request: Request) -> None:
    """Refuse a mount file that is none before the work, not after."""
    if isinstance(request.survey.mount, str):
        load_mount(request.survey.mount)


def work(run: Run, folders: Folders) -> None:
    """Tie the clocks and say how well they fit."""
    flight, timeline = run.flight, run.timeline
    main = max(timeline, key=lambda leg: leg.sync.samples)
    found = {
        "inputs": [describe_log(reader) for reader in run.readers],
        "sync": describe_sync(main),
        "legs": [describe_leg(leg) for leg in timeline],
        "autopilot": {
            "system": main.boot.system,
            "component": main.boot.component,
            "boots": len(flight.boots),
            "vehicles": flight.choice.described(),
            "notes": list(flight.choice.notes),
            "frames": flight.frames,
            "bad_bytes": flight.bad_bytes,
            "unknown_frames": flight.unknown,
            "unsigned_frames": flight.unsigned,
            "board_logs": flight.board_logs,
            "board_log_bad_bytes": flight.board_bad_bytes,
            "board_log_not_finite": flight.board_not_finite,
            "impossible": left_out(flight.boots),
        },
    }
    path = folders[WHOLE] / FOUND
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def left_out(boots: Sequence[Boot]) -> dict[str, int]:
    """Messages with values that cannot be, by name."""
    found: Counter[str] = Counter()
    for boot in boots:
        found.update(boot.left_out)
    return dict(sorted(found.items()))


def describe_log(reader: LogReader) -> dict[str, Any]:
    """One input of quality.json."""
    return {
        "file": reader.path.name,
        "bytes": reader.size,
        "start": utc_text(reader.start_ns),
        "end": utc_text(reader.end_ns),
        "truncated": reader.damage.truncated,
        "bad_chunks": reader.damage.bad_chunks,
        "lost_bytes": reader.damage.lost_bytes,
    }


def describe_leg(leg: Leg) -> dict[str, Any]:
    """One leg of quality.json."""
    return {
        "boot": leg.boot.number,
        "lidar_run": leg.run,
        "attitude_from": ownsolution.attitude_source(leg.boot),
        "position_from": ownsolution.position_source(leg.boot),
        "utc": {
            "source": leg.utc.source,
            "sigma_s": leg.utc.sigma_ns * 1e-9,
            "mended": list(leg.utc.mended),
            "warnings": list(leg.utc.doubts),
        },
        "positions": describe_positions(leg),
        "from_board_log": leg.boot.origins,
        "sync": describe_sync(leg),
        "gps_after_first_fix": describe_fixes(leg.boot),
    }


def describe_positions(leg: Leg) -> dict[str, Any] | None:
    """What became of the positions of a leg; None where there are none."""
    if not ownsolution.has_position(leg.boot):
        return None
    fixes = ownsolution.position_fixes(leg.boot, "msl")
    return {"used": len(fixes.time_ns), "left_out": fixes.left_out, "note": fixes.note}


def describe_fixes(boot: Boot) -> dict[str, int] | None:
    """Reports of the receiver since its first fix, and those of them without one; None where there is no fix, or none is reported."""
    if not boot.has("GPS_RAW_INT"):
        return None
    fixed = boot.tables["GPS_RAW_INT"]["fix_type"] >= FIX_3D
    since = fixed[int(np.argmax(fixed)) :]
    return {"reports": len(since), "without": int((~since).sum())} if fixed.any() else None


def describe_sync(leg: Leg) -> dict[str, Any]:
    """One synchronisation of quality.json: boot time = lidar time past the hour + offset, both as stamped, at `at_lidar_s`."""
    found = leg.sync
    # to the lidar's stamps as sent: the hours that carry them on to a date are ours
    hours_ns = found.reference_ns // HOUR_NS * HOUR_NS
    return {
        "method": found.method,
        "offset_s": (found.offset_ns + hours_ns) * 1e-9,
        "sigma_s": found.sigma_offset_ns * 1e-9,
        "at_lidar_s": (found.reference_ns - hours_ns) * 1e-9,
        "drift_ppm": found.drift_ppm,
        "sigma_drift_ppm": found.sigma_drift_ppm,
        "correlation_peak": found.peak,
        "rival_peak": found.rival,
        "residual_deg_s": float(np.rad2deg(found.residual_rad_s)),
        "samples": found.samples,
        "mount_angle_deg": found.mount_angle_deg,
        "note": found.note,
    }


STEP: Final = Step(
    name="clocks",
    about="lidar and autopilot on one time scale",
    after=(),
    reads_logs=True,
    settings=settings,
    files=files,
    work=work,
    check=check,
)
