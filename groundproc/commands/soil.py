"""`swath soil`: disturbed soil, in one cloud or between two."""

import argparse
import sys
from pathlib import Path

HELP = "find disturbed soil: patches of ground that stand out by height and reflectance, in one cloud or between two"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.analysis.soil import LEAST_M, LEAST_SCORE, SIZE_M
    from groundproc.commands.inputs import add_epochs
    from groundproc.commands.outputs import add_force

    add_epochs(parser, "changes are looked for")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="SOIL.geojson", help="patches, .geojson or .gpkg"
    )
    parser.add_argument(
        "--size", type=float, default=SIZE_M, metavar="M", help=f"side of the smallest patch [m]; default: {SIZE_M:g}"
    )
    parser.add_argument(
        "--least-score", type=float, default=LEAST_SCORE, metavar="S",
        help=f"sigmas, of height and reflectance together, of what is claimed; default: {LEAST_SCORE:g}",
    )  # fmt: skip
    parser.add_argument(
        "--least-height", type=float, default=LEAST_M, metavar="M",
        help=f"height or depth of a patch, at least [m]; default: {LEAST_M:g}",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find them, and print a table."""
    from flightlog.errors import UsageError
    from groundproc.analysis.soil import Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import epochs
    from groundproc.commands.outputs import claim_file
    from groundproc.vectors.features import DRIVERS

    inputs = epochs(arguments)
    for option, value, unit in (("score", arguments.least_score, ""), ("height", arguments.least_height, " m")):
        if not 0.0 < value <= 1000.0:
            raise UsageError(f"--least-{option} {value:g}{unit}: expected more than 0 and up to 1000{unit}")
    claim_file(arguments.output, tuple(DRIVERS), arguments.force, inputs)
    claim_json(arguments)
    task = Task(
        arguments.cloud, arguments.output, arguments.before, arguments.size, arguments.least_score,
        arguments.least_height, arguments.registered,
    )  # fmt: skip
    with points_bar() as advance:
        made = work(task, advance)
    write_json(arguments, made.figures())
    warn(made.warnings, sys.stderr)
    if made.places:
        print(f"{'patch':<7}{'height [m]':>20}{'area [m2]':>11}{'volume [m3]':>13}{'reflectance':>13}{'score':>8}")
    for number, each in enumerate(made.places[:50]):
        patch = each.patch
        height = f"{patch.height_m:+.3f} ± {patch.height_sigma_m:.3f}"
        step = f"x {patch.step:.2f}" if patch.step == patch.step else "unknown"
        print(f"{number:<7}{height:>20}{each.area_m2:>11.2f}{each.volume_m3:>13.4f}{step:>13}{patch.score:>8.1f}")
    print(f"{len(made.places)} patches in {arguments.output}")
    return 0
