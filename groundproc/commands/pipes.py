"""`swath pipes`: pipelines of a cloud as cylinders."""

import argparse
import sys
from pathlib import Path

HELP = "find the pipelines of a cloud: axis, diameter, cover, free spans, each with its sigma"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="PIPES.geojson", help="axes, .geojson or .gpkg"
    )
    parser.add_argument(
        "--min-length", type=float, default=6.0, metavar="M", help="length of the shortest pipe [m]; default: 6"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find them, and print a table."""
    import math

    from flightlog.errors import UsageError
    from groundproc.analysis.pipes import Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.vectors.features import DRIVERS

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, tuple(DRIVERS), arguments.force, [arguments.cloud])
    claim_json(arguments)
    if not (math.isfinite(arguments.min_length) and arguments.min_length >= 2.0):
        raise UsageError(f"--min-length {arguments.min_length:g} m: expected 2 m or more, for example 6")
    with points_bar() as advance:
        made = work(Task(arguments.cloud, arguments.output, arguments.min_length), advance)
    write_json(arguments, made.figures())
    warn(made.warnings, sys.stderr)
    if made.pipes:
        print(f"{'pipe':<6}{'length [m]':>12}{'diameter [m]':>20}{'cover [m]':>20}{'least':>9}{'free [m]':>10}")
    for number, pipe in enumerate(made.pipes):
        told = pipe.figures()
        diameter = f"{told['diameter_m']:.4f} ± {told['diameter_sigma_m']:.4f}"
        cover = f"{told['cover_m']:.2f} ± {told['cover_sigma_m']:.2f}"
        print(
            f"{number:<6}{told['length_m']:>12.2f}{diameter:>20}{cover:>20}{told['cover_least_m']:>9.2f}{told['free_m']:>10.1f}"
        )
    print(f"{len(made.pipes)} pipes in {arguments.output}")
    return 0
