"""What a flight has to do with the options of a survey, for the survey.yaml that a user begins with."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flightlog.clock import utc_text
from flightlog.errors import LogError, SwathError
from flightlog.words import clean
from groundproc import geodesy
from groundproc.estimation import ownsolution
from groundproc.estimation.method import Given, Progress, gather
from groundproc.estimation.odometry.motion import base_motion
from groundproc.flight.timeline import Leg
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.survey import Survey

Notes = dict[str, list[str]]


def facts(logs: Sequence[Path], progress: Progress) -> tuple[Survey, Notes, str]:
    """A survey for some logs, what they say about its options, by name, and what the flight is.

    Raises
    ------
    LogError
        No points or no autopilot in the logs, or no fix: there is nothing to choose.
    """
    with Run(Request(logs, Survey()), Path(), progress) as run:
        mount, source = run.mount_and_source
        given = gather(run.readers, run.flight, run.timeline, mount, run.survey, source)
        leg = max(given.timeline, key=lambda leg: leg.sync.samples)
        head = (
            f"survey of {', '.join(clean(str(reader.path)) for reader in run.readers)}\n"
            f"{utc_text(run.readers[0].start_ns)} to {utc_text(run.readers[-1].end_ns)}\n"
            "every option is at its default but for what this flight tells; see docs/survey.md\n"
        )
        code, place = _place(given)
        notes: Notes = {
            "mount": [_mount_note(source)],
            "sync": [_sync_note(leg)],
            "method": [_method_note(given, leg)],
            "crs": place,
            "height": _height_notes(leg),
        }
        return replace(Survey(), crs=code), notes, head


def _mount_note(source: str) -> str:
    if source == "log":
        return "this log holds a mount, which is used"
    return f"this log holds no mount: that of the project's own airframe is used ({source}); measure yours"


def _sync_note(leg: Leg) -> str:
    found = leg.sync
    note = f"; {found.note}" if found.note else ""
    return f"this log: by {found.method}, sigma {found.sigma_offset_ns * 1e-6:.2f} ms{note}"


def _place(given: Given) -> tuple[int | None, list[str]]:
    """Code of the UTM zone of the first fix, and what it is."""
    frame = given.frame
    place = f"first fix at {frame.latitude_deg:.5f}, {frame.longitude_deg:.5f}"
    try:
        code = geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg)
        name = geodesy.projected_crs(code).name
    except SwathError as error:
        return None, [place, str(error)]
    return code, [f"{place}: {name}"]


def _method_note(given: Given, leg: Leg) -> str:
    try:
        motion, *_ = base_motion(given, leg, given.flight.runs[leg.run])
    except LogError as error:
        return f"this log: no method adjusted: {str(error).removeprefix('adjusted: ')}"
    return f"this log: method adjusted can be used, its motion from the gyros of {motion.source}"


def _height_notes(leg: Leg) -> list[str]:
    """Which heights this log holds."""
    notes = []
    for height in ownsolution.HEIGHTS:
        try:
            ownsolution.position_fixes(leg.boot, height)
        except LogError as error:
            notes.append(f"this log: no height {height}: {error}")
    return notes
