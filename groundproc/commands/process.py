"""`swath process`: a flight log in, a georeferenced cloud out."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from groundproc.steps.process import State
    from groundproc.steps.request import Request
    from groundproc.survey import Survey

HELP = "make a georeferenced cloud of a flight: cloud.laz, trajectory.csv, quality.json, pictures"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.options import add_settings
    from groundproc.steps import ORDER
    from groundproc.survey import SECTIONS

    parser.add_argument(
        "logs",
        nargs="+",
        type=Path,
        metavar="LOG",
        help="a flight log, or all parts of one flight; or a folder of products, to go on with it as it was made",
    )
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="folder of the products")
    parser.add_argument("--config", type=Path, metavar="FILE", help="survey.yaml; options here go before it")
    add_settings(parser, SECTIONS)
    parser.add_argument(
        "--trajectory",
        type=Path,
        metavar="DIR|CSV",
        help="a trajectory made before: a folder of `swath process`, whose mount, lasers and clocks are used too, or a trajectory.csv",
    )
    parser.add_argument("--until", choices=ORDER, metavar="STEP", help=f"stop after this step: {', '.join(ORDER)}")
    parser.add_argument(
        "--status",
        "--dry-run",
        action="store_true",
        help="say what is there and what is to be done, and why; do nothing",
    )
    parser.add_argument("--force", action="store_true", help="do every step again, and overwrite existing files")
    parser.add_argument("--json", action="store_true", help="print what quality.json holds")


def run(arguments: argparse.Namespace) -> int:
    """Process what is to be done, with a progress bar on a terminal."""
    from groundproc.progress import stages
    from groundproc.steps import ORDER
    from groundproc.steps.process import process
    from groundproc.uses import REGISTRY

    request, folder = _request(arguments)
    if arguments.status:
        return _status(request, folder, arguments.json)
    until = arguments.until or ORDER[-1]
    names = {"read": "clocks and autopilot", "adjust": "trajectory", "place": "points"}
    counted = {"images": "images adjusted", "colour": "colours", "ortho": "ortho mosaic", "ndvi": "vegetation index"}
    counted |= {name: f"{name} [points]" for name in REGISTRY}
    try:
        with stages(request.logs, names, counted) as progress:
            found = process(request, folder, progress, until=until, force=arguments.force)
    except KeyboardInterrupt:
        print(f"swath: interrupted; the same command goes on after the last finished step of {folder}", file=sys.stderr)
        raise
    if until != ORDER[-1]:
        _print_states(found, folder, arguments.json)
        return 0
    quality = json.loads((folder / "quality.json").read_text(encoding="utf-8"))
    _tell_uses(folder, arguments.json)
    return _tell(quality, folder, arguments.json)


def _tell_uses(folder: Path, as_json: bool) -> None:
    """What each use found, and what it warns of; with --json the warnings alone."""
    from groundproc.reporting import usesfound
    from groundproc.verdict import warnings_in

    for each in usesfound.read(folder):
        if not as_json:
            print(f"{each['use']}: {each['found']}; in {folder / usesfound.FOLDER}")
        for warning in warnings_in(each["figures"]):
            print(f"swath: warning: {each['use']}: {warning}", file=sys.stderr, flush=True)


def _tell(quality: dict[str, Any], folder: Path, as_json: bool) -> int:
    """Print what came of it: figures, every warning, and the verdict as the last line; give its exit code."""
    from groundproc.machine import screen
    from groundproc.verdict import Verdict, warnings_in

    verdict = Verdict.from_mapping(quality)
    if as_json:
        print(json.dumps(quality, indent=2), flush=True)
    else:
        screen.summary(_report(quality, folder))
        sys.stdout.flush()
    of_positions = [leg["positions"]["note"] for leg in quality["legs"] if leg["positions"]]
    for note in dict.fromkeys(quality["autopilot"]["notes"] + of_positions):
        if note:
            print(f"swath: note: {note}", file=sys.stderr, flush=True)
    for warning in warnings_in(quality):
        print(f"swath: warning: {warning}", file=sys.stderr, flush=True)
    # with --json the verdict is the object's first key, and the object stays the only thing on standard output
    if as_json:
        print(verdict.line(), file=sys.stderr)
    else:
        screen.verdict(verdict.line(), verdict.grade)
    return verdict.exit_code


def _request(arguments: argparse.Namespace) -> tuple[Request, Path]:
    """What is asked for, and the folder of the products: from a folder's ledger where that is what is named."""
    from flightlog.errors import UsageError
    from groundproc.steps.process import remembered
    from groundproc.steps.request import Request
    from groundproc.survey import Survey, TrajectorySettings

    first: Path = arguments.logs[0]
    _expect(arguments)
    if arguments.output is not None:
        return Request(arguments.logs, _survey(arguments, Survey()), arguments.trajectory), arguments.output
    if len(arguments.logs) > 1 or not first.is_dir():
        raise UsageError("-o DIR is missing: the folder of the products; expected swath process LOG... -o DIR")
    before = remembered(first)
    if before is None:
        raise UsageError(f"{first}: no products of `swath process` in this folder; expected LOG... -o DIR")
    chosen = before.survey
    if (
        arguments.trajectory is not None
    ):  # what a trajectory was estimated with before is of no use for one from elsewhere
        plain = {name: value for name, value in vars(TrajectorySettings()).items() if name != "lasers"}
        chosen = replace(chosen, **plain)
    return replace(before, survey=_survey(arguments, chosen), poses=arguments.trajectory or before.poses), first


def _expect(arguments: argparse.Namespace) -> None:
    """Refuse what is known to be another kind of file than it should be."""
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect, expect_text

    goes_on = arguments.output is None and len(arguments.logs) == 1
    expect(arguments.logs, (*LOG, "products", "folder") if goes_on else LOG, LOG_WORDS)
    expect_text(arguments.config, "a survey file (YAML)")
    expect([arguments.trajectory], ("poses", "products", "folder"), "a folder of products or a trajectory.csv")


def _expect_named(survey: Survey) -> None:
    """The same for the files that a survey names."""
    from groundproc.commands.inputs import AREA, AREA_WORDS, SOLUTION_WORDS, SOLUTIONS, expect, expect_text
    from groundproc.sensors.lasers import ESTIMATE

    lasers = None if survey.lasers == ESTIMATE else survey.lasers
    mount = survey.mount if isinstance(survey.mount, str) else None
    expect_text(mount, "a mount file (YAML)")
    expect_text(survey.compass, "a file of `swath calibrate` or `swath compass` (YAML)")
    expect_text(lasers, "a file of `swath calibrate --lasers` (YAML)")
    for name, kinds, expected in (
        (survey.area, AREA, AREA_WORDS),
        (survey.positions, (*SOLUTIONS, "table", "text"), SOLUTION_WORDS),
        (survey.targets, ("bag", "json", "text"), "polygons (.geojson or .gpkg)"),
        (survey.control, ("control", "table", "text"), "a table of control points (CSV: x, y, z, sigma)"),
    ):
        if name is not None and Path(name).exists():  # one that is not there, its reader names
            expect([name], kinds, expected)


def _survey(arguments: argparse.Namespace, otherwise: Any) -> Any:
    """The survey file with the command line's options laid over it."""
    from flightlog import config
    from groundproc.commands.options import beside, given_settings
    from groundproc.sensors.lasers import ESTIMATE
    from groundproc.survey import FILES, SECTIONS, Survey

    tree = config.to_mapping(config.load(arguments.config, Survey) if arguments.config else otherwise)
    if arguments.config:
        beside(tree, arguments.config.parent, FILES, (ESTIMATE,))
    survey = config.from_mapping(tree | given_settings(arguments, SECTIONS), Survey, "command line")
    _expect_named(survey)
    return survey


def _status(request: Request, folder: Path, as_json: bool) -> int:
    """What is there, what is stale, and why; touches nothing."""
    from groundproc.steps.ledger import Ledger, open_ledger
    from groundproc.steps.process import states

    _print_states(states(request, open_ledger(folder) or Ledger(folder)), folder, as_json)
    return 0


def _print_states(found: Sequence[State], folder: Path, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"folder": str(folder), "steps": [asdict(state) for state in found]}, indent=2))
        return
    rows = [(state.step.partition(": "), state) for state in found]
    width = max(len(part or step) + 2 * bool(part) for (step, _, part), _ in rows) + 2
    shown = ""
    for (step, _, part), state in rows:
        if part and step != shown:
            print(step)
        shown = step
        when = f"{state.finished}, {state.seconds:.1f} s" if state.finished else ""
        print(f"{'  ' + part if part else step:<{width}}{state.state:<9}{'; '.join(state.reasons) or when}")
        if state.outputs and state.outputs != (part,):
            print(f"{'':<{width + 9}}{', '.join(state.outputs)}")


def _report(quality: dict[str, Any], folder: Path) -> list[tuple[str, str]]:
    """A few lines for the terminal, each with what it is about."""
    from groundproc.reporting.delays import delays

    sync, points, track = quality["sync"], quality["points"], quality["trajectory"]
    crs, height = quality["crs"], quality["height"]
    east, north, up = track["median_sigma_m"]
    roll, pitch, heading = track["median_sigma_attitude_deg"]
    lines = [
        ("points", f"{points['written']:,} points in EPSG:{crs['epsg']} ({crs['name']}), heights {height['meaning']}"),
        *(("", line) for line in _left_out(points.get("left_out", {}))),
        (
            "trajectory",
            f"trajectory by {track['method']}: {track['covered_s']:.1f} s from {track['start']}, "
            f"sigma {east:.2f} / {north:.2f} / {up:.2f} m (east, north, up), "
            f"{roll:.2f} / {pitch:.2f} / {heading:.2f} deg (roll, pitch, heading)"
            + (f"; {track['note']}" if track["note"] else ""),
        ),
        (
            "clocks",
            f"sync by {sync['method']}: autopilot = lidar {sync['offset_s']:+.6f} s, sigma {sync['sigma_s'] * 1e3:.2f} ms"
            + (f"; {sync['note']}" if sync["note"] else ""),
        ),
    ]
    lines += [("clocks", said) for said in (delays(quality),) if said]
    mended = dict.fromkeys(f"UTC: {said}" for leg in quality["legs"] for said in leg["utc"]["mended"])
    lines += [("", line) for line in mended]
    lines += [("control", line) for line in _control_lines(quality.get(track["method"], {}).get("control"))]
    lines += [("mount", _mount_line(quality["mount"]))]
    return lines + [("products", line) for line in _where(folder)]


def _left_out(counts: dict[str, int]) -> list[str]:
    """What the survey did not want, where it chose."""
    return [f"left out: {', '.join(f'{count:,} by {name}' for name, count in counts.items())}"] if counts else []


def _where(folder: Path) -> list[str]:
    """What to look at first, of what was chosen."""
    names = ("report.html", "cloud_height.png", "cloud_intensity.png")
    shown = [folder / name for name in names if (folder / name).exists()][:2]
    parts = [f"look at {' and '.join(map(str, shown))}"] if shown else []
    if (figures := folder / "quality.json").exists():
        parts.append(f"all figures are in {figures}")
    return ["; ".join(parts)] if parts else []


def _mount_line(mount: dict[str, Any]) -> str:
    """Which mount was used, and how well it is known where it was estimated."""
    source, sigma = mount["source"], mount["sigma"]
    if not source.startswith("estimated"):
        return f"mount from {source}"
    lidar = mount["lidar"]
    line = (
        f"mount {source}: yaw {lidar['yaw_deg']:.3f}, pitch {lidar['pitch_deg']:.3f}, roll {lidar['roll_deg']:.3f} deg"
    )
    return line + (f", sigma {max(sigma['turn_deg']):.3f} deg at most" if sigma else "")


def _control_lines(control: dict[str, Any] | None) -> list[str]:
    """How the cloud meets its control points."""
    if not control:
        return []
    lines = []
    for use, name in (("used", "control points"), ("check", "check points, not used")):
        found = control[use]
        if found["count"]:
            lines.append(
                f"{found['count']} {name}: surface off by {found['before_rms_m']:.3f} m rms before, {found['after_rms_m']:.3f} m after "
                f"(expected {found['sigma_m']:.3f})"
            )
    return lines + ([f"control: {control['note']}"] if control["note"] else [])
