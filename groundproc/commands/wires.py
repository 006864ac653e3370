"""`swath wires`: power lines of a cloud, with poles, masts, stays and fences, and how far everything is from a wire."""

import argparse
import sys
from pathlib import Path

HELP = "find the wires of a cloud, and poles, masts, stays, fences: spans, sag, clearance"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="WIRES.geojson", help="lines, .geojson or .gpkg"
    )
    parser.add_argument(
        "--clearance",
        type=Path,
        metavar="OUT.laz",
        help="write the same points with their distance to the nearest wire, and classes",
    )
    parser.add_argument(
        "--min-height",
        type=float,
        default=3.0,
        metavar="M",
        help="height above ground that wires hang at, at least [m]; default: 3",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find them, and print a table."""
    import math

    from flightlog.errors import UsageError
    from groundproc.analysis.wires import Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.machine import screen
    from groundproc.vectors.features import DRIVERS

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, tuple(DRIVERS), arguments.force, [arguments.cloud])
    if arguments.clearance is not None:
        claim_file(arguments.clearance, (".laz", ".las"), arguments.force, [arguments.cloud])
    claim_json(arguments)
    if not (math.isfinite(arguments.min_height) and arguments.min_height >= 1.0):
        raise UsageError(f"--min-height {arguments.min_height:g} m: expected 1 m or more, for example 3")
    with points_bar() as advance:
        made = work(Task(arguments.cloud, arguments.output, arguments.clearance, arguments.min_height), advance)
    figures = made.figures()
    write_json(arguments, figures)
    warn(made.warnings, sys.stderr)
    if made.wires:
        rows = []
        for each in figures["wires"]:
            values = [each[name] for name in ("length_m", "sag_m", "clearance_ground_m", "clearance_vegetation_m")]
            told = ["-" if value is None else f"{value:.2f}" for value in values]
            rows.append([f"{each['kind']} {each['number']}", *told])
        screen.table(["wire", "length [m]", "sag [m]", "to ground [m]", "to growth [m]"], rows)
    print(
        f"{len(made.wires)} wires, {figures['poles']} poles, {figures['masts']} masts, {figures['stays']} stays, "
        f"{figures['fences']} fences in {arguments.output}"
    )
    return 0
