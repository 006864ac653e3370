"""`swath calibrate`: the mount, the compass curve and the lasers from flights, for later ones."""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groundproc.estimation.calibration.mount import FlightResult, MountCalibration

HELP = "find boresight, lever arm, clock offset, compass curve and corrections of the lasers from flights: files for later flights"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.options import add_settings
    from groundproc.commands.outputs import add_force
    from groundproc.survey import MountSettings

    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="flight logs, each a flight of its own")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for mount.yaml, compass.yaml and calibration.json",
    )
    add_settings(parser, [MountSettings], only=("mount",))
    parser.add_argument(
        "--lasers",
        action="store_true",
        help="find range and elevation offsets of the 32 lasers as well: lasers.yaml, lasers.png",
    )
    add_force(parser)
    parser.add_argument("--json", action="store_true", help="print what calibration.json holds")


def run(arguments: argparse.Namespace) -> int:
    """Adjust every flight, join them, write, and say."""
    import json

    from flightlog.errors import UsageError
    from flightlog.logfile import LogReader
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect, expect_text, told_damage
    from groundproc.commands.outputs import claim_folder
    from groundproc.estimation.calibration.compass import write_compass
    from groundproc.estimation.calibration.mount import calibrate
    from groundproc.files import made_folder, written_aside
    from groundproc.flight.lidar import lidar_of
    from groundproc.flight.mounting import find_mount
    from groundproc.products.laser_plot import draw_lasers
    from groundproc.progress import stages
    from groundproc.sensors.lasers import write_lasers

    logs = arguments.logs
    if len(set(logs)) < len(logs):
        raise UsageError("a log is named twice; its flight would count twice")
    expect(logs, LOG, LOG_WORDS)
    expect_text(arguments.mount, "a mount file (YAML)")
    names = (
        "mount.yaml",
        "compass.yaml",
        "calibration.json",
        *(("lasers.yaml", "lasers.png") if arguments.lasers else ()),
    )
    claim_folder(arguments.output, names, arguments.force)
    with LogReader(logs[0]) as reader:
        nominal, _ = find_mount(arguments.mount, [reader])
        lasers = lidar_of([reader]).lasers
    flights: list[FlightResult] = []
    with stages(logs, {"read": "clocks and autopilots", "adjust": "flights"}) as progress:
        for path in logs:
            flights.append(_adjusted(path, nominal, arguments.lasers, progress))
    result = calibrate(flights)
    report = result.report(nominal)
    with made_folder(arguments.output):
        with written_aside(arguments.output / "mount.yaml") as aside:
            aside.write_text(_header(report) + result.mount(nominal).yaml(), encoding="utf-8")
        if result.compass_found:
            write_compass(arguments.output / "compass.yaml", result.compass, _compass_head(result))
        if result.lasers is not None:
            write_lasers(arguments.output / "lasers.yaml", result.lasers.file(len(lasers)), _lasers_head(result))
            with written_aside(arguments.output / "lasers.png") as aside:
                draw_lasers(result.lasers.figures(lasers)).savefig(aside, format="png")
        with written_aside(arguments.output / "calibration.json") as aside:
            aside.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(report, indent=2) if arguments.json else _text(report, arguments.output))
    return _judged(result, told_damage(logs))


def _judged(result: MountCalibration, torn: bool) -> int:
    """Say what speaks against it, and give the exit code: bad where the flights contradict each other."""
    from groundproc.verdict import BAD, DOUBTFUL, EXIT_CODES, GOOD

    warned = [flight for flight in result.flights if flight.warning]
    for flight in warned:
        print(f"swath: warning: {flight.name}: {flight.warning}", file=sys.stderr)
    if not result.agree:
        print(
            f"swath: the flights differ by more than their sigmas allow (chi-square {result.chi_square:.1f} with {result.freedom} degrees "
            "of freedom); was the mount touched between them?",
            file=sys.stderr,
        )
        return EXIT_CODES[BAD]
    return EXIT_CODES[DOUBTFUL if warned or torn else GOOD]


def _adjusted(path: Path, nominal: Any, with_lasers: bool, progress: Any) -> FlightResult:
    """One flight."""
    from flightlog.errors import LogError
    from flightlog.logfile import LogReader
    from groundproc.estimation.adjustment import adjusted
    from groundproc.estimation.calibration.mount import COMPASS, SHARED, flight_result
    from groundproc.estimation.direct import ins_estimate
    from groundproc.estimation.method import gather
    from groundproc.flight.flight import read_flight
    from groundproc.flight.pairing import legs
    from groundproc.sensors.lasers import ESTIMATE
    from groundproc.survey import Survey

    with LogReader(path) as reader:
        survey = Survey(method="adjusted", lasers=ESTIMATE if with_lasers else None)
        flight = read_flight([reader], "ins", lambda done: progress("read", done))
        timeline = legs(flight.runs, flight.boots, nominal.mat_ins_lidar(), survey.sync)
        given = gather([reader], flight, timeline, nominal, survey)
        start = ins_estimate(given, progress).trajectory
        leg = max(given.placed, key=lambda leg: leg.sync.samples)
        same = [other for other in given.placed if other.run == leg.run]
        run = adjusted.adjust_run(given, same, leg.run, start, progress, SHARED + COMPASS)
        if run.is_worse():
            raise LogError(
                f"{path}: cannot tell a mount: {run.note()}; expected ground or walls in the lidar's reach for most of the flight"
            )
        found = flight_result(path, run.windows, nominal, leg.sync.offset_ns * 1e-9, "; ".join(run.warnings()))
    if found is None:
        raise LogError(
            f"{path}: no gyro and accelerometer of the autopilot (RAW_IMU) in the log; without them no flight can tell a mount"
        )
    return found


def _header(report: dict[str, Any]) -> str:
    """What stands above the values of mount.yaml."""
    sigma = report["sigma_with_axes"]
    lines = [
        f"calibrated from {len(report['flights'])} flights: {', '.join(f['log'] for f in report['flights'])}",
        f"sigma about right, forward, up: {sigma[0]:.3f}, {sigma[1]:.3f}, {sigma[2]:.3f} deg",
        f"sigma of the lever arm: {sigma[3] * 1e3:.1f}, {sigma[4] * 1e3:.1f}, {sigma[5] * 1e3:.1f} mm; covariance in calibration.json",
    ]
    kept = [name for name, found in zip(report["parameters"], report["found"], strict=True) if not found]
    if kept:
        lines.append(f"not observed, left as they were: {', '.join(kept)}")
    flags = zip(report["parameters"], report["found"], report["significant"], strict=True)
    small = [name for name, found, significant in flags if found and not significant]
    if small:
        lines.append(f"not significant, within 3 sigma of what they were: {', '.join(small)}")
    return "".join(f"# {line}\n" for line in lines)


def _compass_head(result: MountCalibration) -> str:
    """What stands above the values of compass.yaml."""
    seen, unseen = result.compass_sigma_deg()
    rest = (
        "all headings flown" if result.headings.all() else f"up to {unseen:.1f} deg at the others, which are not flown"
    )
    return (
        f"# calibrated from {len(result.flights)} flights: {', '.join(flight.name for flight in result.flights)}\n"
        f"# {result.compass.seen:.0%} of all headings flown; sigma up to {seen:.1f} deg there, {rest}\n"
    )


def _lasers_head(result: MountCalibration) -> str:
    """What stands above the values of lasers.yaml."""
    assert result.lasers is not None
    seen = [int(result.lasers.of(kind)[2].sum()) for kind in ("range", "elevation")]
    (far, sigma_far), (up, sigma_up) = (result.lasers.mean(kind) for kind in ("range", "elevation"))
    lines = [
        f"calibrated from {len(result.flights)} flights: {', '.join(flight.name for flight in result.flights)}",
        "belongs to that one sensor; found together with mount.yaml, with which it is to be used",
        f"in firing order; found: {seen[0]} ranges, {seen[1]} elevations, the others left as they were",
        f"mean range offset of all {far * 1e3:.1f} mm, sigma {sigma_far * 1e3:.1f} mm",
        f"mean elevation offset {math.degrees(up):.4f} deg, sigma {math.degrees(sigma_up):.4f} deg",
    ]
    return "".join(f"# {line}\n" for line in lines)


def _text(report: dict[str, Any], folder: Path) -> str:
    """A table for the terminal."""
    lines = [f"{'':14}{'found':>10}{'sigma':>10}{'with axes':>12}"]
    rows = zip(
        report["parameters"],
        report["value"],
        report["sigma"],
        report["sigma_with_axes"],
        report["found"],
        report["significant"],
        strict=True,
    )
    for name, value, sigma, with_axes, found, significant in rows:
        note = "" if found else "   not observed: left as it was"
        if found and not significant:
            note = "   not significant: within 3 sigma of what it was"
        lines.append(f"{name:14}{value:10.4f}{sigma:10.4f}{with_axes:12.4f}{note}")
    for flight in report["flights"]:
        lines.append(
            f"{flight['log']}: {flight['seconds']:.0f} s, gyro delay {flight['delay_ms']:+.2f} ms, sigma "
            f"{flight['sigma_delay_ms']:.2f} ms, beyond the synchronisation"
        )
    if report["degrees_of_freedom"]:
        lines.append(
            f"agreement of the flights: chi-square {report['chi_square']:.1f}, {report['degrees_of_freedom']} expected"
        )
    lines += _compass_text(report["compass"])
    if "lasers" in report:
        lines += _lasers_text(report["lasers"])
    lines.append(f"written into {folder}: mount.yaml, {_names(report)}calibration.json")
    return "\n".join(lines)


def _names(report: dict[str, Any]) -> str:
    """Files beside the two that are always there."""
    return ("compass.yaml, " if report["compass"]["found"] else "") + (
        "lasers.yaml, lasers.png, " if "lasers" in report else ""
    )


def _compass_text(compass: dict[str, Any]) -> list[str]:
    """What the flights say of the compass."""
    share = len(compass["headings_seen_deg"]) * compass["sector_deg"] / 360.0
    sigma = compass["largest_sigma_deg"]
    if not compass["found"]:
        return [f"compass: not observed ({share:.0%} of all headings flown); no compass.yaml"]
    rest = "" if share == 1.0 else f", {sigma['elsewhere']:.1f} deg elsewhere"
    return [f"compass: {share:.0%} of all headings flown, sigma up to {sigma['seen']:.1f} deg there{rest}"]


def _lasers_text(lasers: dict[str, Any]) -> list[str]:
    """What the flights say of the lasers."""
    seen = [32 - sum(lasers[f"{kind}_held"]) for kind in ("range", "elevation")]
    sigma = [statistics.median(lasers[name]) for name in ("sigma_range_m", "sigma_elevation_deg")]
    return [
        f"lasers: {seen[0]} of 32 ranges found, median sigma {sigma[0] * 1e3:.2f} mm",
        f"        {seen[1]} of 32 elevations found, median sigma {sigma[1]:.4f} deg",
        f"        mean range {lasers['mean_range_m'] * 1e3:+.2f} mm, sigma {lasers['sigma_mean_range_m'] * 1e3:.2f} mm",
        f"        mean elevation {lasers['mean_elevation_deg']:+.4f} deg, sigma {lasers['sigma_mean_elevation_deg']:.4f} deg",
    ]
