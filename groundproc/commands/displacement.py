"""`swath displacement`: how places moved between two epochs, as vectors in space."""

import argparse
import sys
from pathlib import Path

HELP = "measure how slides and banks moved between two epochs: vectors in space with sigma and significance"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.analysis.displacement import RADIUS_M
    from groundproc.commands.outputs import add_force

    parser.add_argument("a", type=Path, metavar="A", help="the earlier cloud: LAS, LAZ or COPC")
    parser.add_argument("b", type=Path, metavar="B", help="the later one")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="VECTORS.geojson", help="vectors, .geojson or .gpkg"
    )
    parser.add_argument(
        "--radius", type=float, default=RADIUS_M, metavar="M", help=f"of a patch [m]; default: {RADIUS_M:g}"
    )
    parser.add_argument("--spacing", type=float, metavar="M", help="between patches [m]; default: the radius")
    parser.add_argument("--registered", action="store_true", help="the clouds lie on each other already")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure, and say how much moved."""
    from groundproc.analysis.displacement import Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.vectors.features import DRIVERS

    expect([arguments.a, arguments.b], CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, tuple(DRIVERS), arguments.force, [arguments.a, arguments.b])
    claim_json(arguments)
    task = Task(
        arguments.a, arguments.b, arguments.output, arguments.radius, arguments.spacing, arguments.registered
    )  # fmt: skip
    with points_bar() as advance:
        made = work(task, advance)
    figures = made.figures()
    write_json(arguments, figures)
    warn(made.warnings, sys.stderr)
    largest = figures["largest_m"]
    by = "" if largest is None else f", by {largest:.3f} m at most"
    print(
        f"{figures['moved']} of {figures['patches']} patches moved{by}; {figures['patches_without_relief_or_points']} tell nothing; "
        f"{arguments.output}"
    )
    return 0
