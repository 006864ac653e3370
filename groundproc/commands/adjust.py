"""`swath adjust`: clouds of any origin and their trajectory in, both with the trajectory's errors taken out."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

HELP = "adjust the strips of a cloud of any origin: LAS files and a trajectory in, better ones out"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_all_classes

    parser.add_argument("clouds", nargs="*", type=Path, metavar="LAS", help="LAS or LAZ files with gps_time")
    parser.add_argument(
        "-t",
        "--trajectory",
        type=Path,
        metavar="FILE",
        help="trajectory.csv, SBET, RTKLIB .pos or NMEA of the same flight",
    )
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="folder of the results")
    add_force(parser)
    parser.add_argument("--crs", "--epsg", metavar="EPSG", help="projected CRS of the clouds; default: as they state")
    parser.add_argument(
        "--crs-anyway", action="store_true", help="take the CRS where it is not made for the place of the flight"
    )
    parser.add_argument("--week", type=int, metavar="N", help="GPS week, where the files have only seconds of it")
    parser.add_argument(
        "--geoid", type=float, default=0.0, metavar="N",
        help="taken off the trajectory's heights, where those of the cloud are above the geoid [m]",
    )  # fmt: skip
    parser.add_argument("--control", type=Path, metavar="CSV", help="points on the surface: columns x, y, z, sigma")
    add_all_classes(parser)
    parser.add_argument("--config", type=Path, metavar="FILE", help="options as YAML; --show-config lists them")
    parser.add_argument("--show-config", action="store_true", help="print every option with its default and exit")
    parser.add_argument("--json", action="store_true", help="print what adjustment.json holds")


def run(arguments: argparse.Namespace) -> int:
    """Adjust, and say what it was good for."""
    from dataclasses import replace

    from tqdm import tqdm

    from flightlog import config
    from flightlog.errors import UsageError
    from groundproc.commands.inputs import SOLUTION_WORDS, SOLUTIONS, expect, expect_text
    from groundproc.commands.outputs import claim_folder
    from groundproc.geodesy import projected_crs
    from groundproc.strips.options import StripOptions

    if arguments.show_config:
        print(config.sample(StripOptions), end="")
        return 0
    for given, name in ((arguments.clouds, "LAS"), (arguments.trajectory, "-t"), (arguments.output, "-o")):
        if not given:
            raise UsageError(f"{name} is missing; expected swath adjust LAS... -t TRAJECTORY -o DIR")
    expect(arguments.clouds, ("cloud",), "LAS or LAZ files")
    expect([arguments.trajectory], SOLUTIONS, SOLUTION_WORDS)
    expect([arguments.control], ("control", "table"), "a table of control points (CSV: x, y, z, sigma)")
    expect_text(arguments.config, "options as YAML")
    options = config.load(arguments.config, StripOptions) if arguments.config else StripOptions()
    options = replace(options, all_classes=options.all_classes or arguments.all_classes)

    from groundproc.strips import report, work

    names = [path.with_suffix(".laz").name for path in arguments.clouds]
    if all(path.resolve() != (arguments.output / path.with_suffix(".laz").name).resolve() for path in arguments.clouds):
        claim_folder(arguments.output, (*names, *report.FILES), arguments.force)
    crs = None if arguments.crs is None else projected_crs(arguments.crs)
    task = work.Task(
        arguments.clouds, arguments.trajectory, arguments.output, crs, arguments.week, arguments.geoid, arguments.control, options,
        arguments.crs_anyway,
    )  # fmt: skip
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, count: int) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(count)

        told = work.run(task, advance)
    print(json.dumps(told, indent=2) if arguments.json else _text(told, arguments.output))
    return 0


def _text(told: dict[str, Any], folder: Path) -> str:
    """A few lines for the terminal."""
    before, after = told["differences"]["before"], told["differences"]["after"]
    lines = [f"{told['points']['read']:,} points, {told['strips']['count']} strips by {told['strips']['cut_by']}"]
    for kind, name in (("height", "in height"), ("plan", "in plan"), ("normal", "along normals")):
        old, new = before[kind], after[kind]
        if old["count"] and new["count"]:
            lines.append(
                f"strips differ {name} by sigmaMAD {old['sigma_mad_m']:.4f} m, median {old['median_m']:+.4f} m before; "
                f"{new['sigma_mad_m']:.4f} m, {new['median_m']:+.4f} m after ({new['count']:,} patches)"
            )
    for name, found in told["mount"].items():
        values = ", ".join(
            f"{side} {value:+.4f} (sigma {sigma:.4f})" if state == "estimated" else f"{side} held (sigma {sigma:.4f})"
            for side, value, sigma, state in zip(
                ("right", "forward", "up"), found["right_forward_up"], found["sigma"], found["state"], strict=True
            )
        )
        lines.append(f"{name}: {values}")
    if told["points"]["outside_trajectory"]:
        lines.append(
            f"{told['points']['outside_trajectory']:,} points lie outside of the trajectory and are as they were"
        )
    if told["points"]["no_surface"]:
        lines.append(
            f"{told['points']['no_surface']:,} points of noise and of what moves were moved along, but told nothing"
        )
    if told["note"]:
        lines.append(f"note: {told['note']}")
    lines.append(f"look at {folder / 'differences.png'} and {folder / 'corrections.png'}")
    return "\n".join(lines)
