"""`swath windows`: what is seen through the windows of houses, kept and classed."""

import argparse
import sys
from pathlib import Path

HELP = "class what is seen through windows: points behind the panes of walls, and planes behind facades"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force
    from groundproc.commands.reflectance import add_place

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT.laz",
        help="the same points, those of windows in class 68",
    )
    parser.add_argument(
        "-t", "--trajectory", type=Path, metavar="FILE",
        help="trajectory.csv, SBET, RTKLIB .pos or NMEA of the flight; default: recovered from shots with several echoes, or none",
    )  # fmt: skip
    parser.add_argument("--walls", type=Path, metavar="FILE", help="write the walls, .geojson or .gpkg")
    parser.add_argument(
        "--lever", type=float, nargs=3, default=(0.0, 0.0, 0.0), metavar=("RIGHT", "FORWARD", "UP"),
        help="sensor in the body frame of the trajectory [m]; default: 0 0 0",
    )  # fmt: skip
    add_place(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find them, and say how many."""
    from groundproc.analysis.windows import Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, SOLUTION_WORDS, SOLUTIONS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.geodesy import projected_crs
    from groundproc.vectors.features import DRIVERS

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    expect([arguments.trajectory], SOLUTIONS, SOLUTION_WORDS)
    claim_file(arguments.output, (".laz", ".las"), arguments.force, [arguments.cloud])
    if arguments.walls is not None:
        claim_file(arguments.walls, tuple(DRIVERS), arguments.force, [arguments.cloud])
    claim_json(arguments)
    task = Task(
        arguments.cloud, arguments.output, arguments.walls, arguments.trajectory,
        None if arguments.crs is None else projected_crs(arguments.crs), arguments.week, arguments.geoid, tuple(arguments.lever),
    )  # fmt: skip
    with points_bar() as advance:
        made = work(task, advance)
    figures = made.figures()
    write_json(arguments, figures)
    warn(made.warnings, sys.stderr)
    print(
        f"{figures['walls']} walls, {figures['walls_seen_through']} of them seen through, {figures['planes_behind']} with a plane behind; "
        f"by {made.beams}"
    )
    print(f"{made.behind:,} points behind panes and {made.panes:,} on them in class 68 of {arguments.output}")
    return 0
