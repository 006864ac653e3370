"""`swath calibrate`: the mount from flights, for later ones."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groundproc.adjustment.mount_calibration import FlightResult

HELP = "find boresight, lever arm, clock offset and compass curve from flights: a new mount.yaml with its covariance"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="flight logs, each a flight of its own")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder for mount.yaml and calibration.json"
    )
    parser.add_argument("--mount", type=Path, metavar="FILE", help="mount.yaml to begin from, in place of the logs'")
    parser.add_argument("--json", action="store_true", help="print what calibration.json holds")


def run(arguments: argparse.Namespace) -> int:
    """Adjust every flight, join them, write, and say."""
    import json

    from flightlog.errors import UsageError
    from flightlog.logfile import LogReader
    from groundproc.adjustment.mount_calibration import calibrate
    from groundproc.files import made_folder, written_aside
    from groundproc.mounting import find_mount
    from groundproc.progress import stages

    logs = arguments.logs
    if len(set(logs)) < len(logs):
        raise UsageError("a log is named twice; its flight would count twice")
    with LogReader(logs[0]) as reader:
        nominal, _ = find_mount(str(arguments.mount) if arguments.mount else None, [reader])
    flights: list[FlightResult] = []
    with stages(logs, {"read": "clocks and autopilots", "adjust": "flights"}) as progress:
        for path in logs:
            flights.append(_adjusted(path, nominal, progress))
    result = calibrate(flights)
    report = result.report(nominal)
    with made_folder(arguments.output):
        with written_aside(arguments.output / "mount.yaml") as aside:
            aside.write_text(_header(report) + result.mount(nominal).yaml(), encoding="utf-8")
        with written_aside(arguments.output / "calibration.json") as aside:
            aside.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(report, indent=2) if arguments.json else _text(report, arguments.output))
    if not result.agree:
        print(
            f"swath: the flights differ by more than their sigmas allow (chi-square {result.chi_square:.1f} with {result.freedom} degrees "
            "of freedom); was the mount touched between them?",
            file=sys.stderr,
        )
        return 1
    return 0


def _adjusted(path: Path, nominal: Any, progress: Any) -> FlightResult:
    """One flight."""
    from flightlog.errors import LogError
    from flightlog.logfile import LogReader
    from groundproc.adjustment import adjusted
    from groundproc.adjustment.mount_calibration import SHARED, flight_result
    from groundproc.flight import read_flight
    from groundproc.survey import Survey
    from groundproc.timeline import legs
    from groundproc.trajectory.method import gather
    from groundproc.trajectory.methods import ins_estimate

    with LogReader(path) as reader:
        survey = Survey(method="adjusted")
        flight = read_flight([reader], "ins", lambda done: progress("read", done))
        timeline = legs(flight.runs, flight.boots, nominal.mat_ins_lidar(), survey.sync)
        given = gather([reader], flight, timeline, nominal, survey)
        start = ins_estimate(given, progress).trajectory
        leg = max(given.placed, key=lambda leg: leg.sync.samples)
        same = [other for other in given.placed if other.run == leg.run]
        run = adjusted.adjust_run(given, same, leg.run, start, progress, exact=SHARED)
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
        strict=True,
    )
    for name, value, sigma, with_axes, found in rows:
        note = "" if found else "   not observed: left as it was"
        lines.append(f"{name:14}{value:10.4f}{sigma:10.4f}{with_axes:12.4f}{note}")
    for flight in report["flights"]:
        lines.append(
            f"{flight['log']}: {flight['seconds']:.0f} s, gyro delay {flight['delay_ms']:+.2f} ms, sigma "
            f"{flight['sigma_delay_ms']:.2f} ms, beyond the synchronisation{'; ' + flight['warning'] if flight['warning'] else ''}"
        )
    if report["degrees_of_freedom"]:
        lines.append(
            f"agreement of the flights: chi-square {report['chi_square']:.1f}, {report['degrees_of_freedom']} expected"
        )
    lines.append(f"written: {folder / 'mount.yaml'}, {folder / 'calibration.json'}")
    return "\n".join(lines)
