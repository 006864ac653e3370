"""`swath detect`: hard targets on the ground, also under trees."""

import argparse
import sys
from pathlib import Path

HELP = "find solid objects on the ground, also under trees, and where nothing can be claimed"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OBJECTS.geojson", help="outlines, .geojson or .gpkg"
    )
    parser.add_argument(
        "--cloud", dest="copy", type=Path, metavar="OUT.laz",
        help="write the same points with height above ground and the number of their object",
    )  # fmt: skip
    parser.add_argument("--penetration", type=Path, metavar="FILE.tif", help="write the share of pulses that came down")
    parser.add_argument(
        "--max-height",
        type=float,
        default=3.0,
        metavar="M",
        help="height above ground up to which is looked [m]; default: 3",
    )
    parser.add_argument(
        "--min-score", type=float, default=12.0, metavar="S", help="least score of an object; default: 12"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find them, and print a table."""
    import math

    from flightlog.errors import UsageError
    from groundproc.analysis.detect import Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.vectors.features import DRIVERS

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, tuple(DRIVERS), arguments.force, [arguments.cloud])
    if arguments.copy is not None:
        claim_file(arguments.copy, (".laz", ".las"), arguments.force, [arguments.cloud])
    if arguments.penetration is not None:
        claim_file(arguments.penetration, (".tif", ".tiff"), arguments.force, [arguments.cloud])
    claim_json(arguments)
    if not 1.0 <= arguments.max_height <= 10.0:
        raise UsageError(f"--max-height {arguments.max_height:g} m: expected 1 to 10 m")
    if not math.isfinite(arguments.min_score):
        raise UsageError(f"--min-score {arguments.min_score:g}: expected a number, for example 12")
    with points_bar() as advance:
        made = work(
            Task(
                arguments.cloud, arguments.output, arguments.copy, arguments.penetration, arguments.max_height,
                arguments.min_score,
            ),
            advance,
        )  # fmt: skip
    write_json(arguments, made.figures())
    warn(made.warnings, sys.stderr)
    if made.bodies:
        print(
            f"{'object':<8}{'x':>14}{'y':>14}{'length [m]':>12}{'width [m]':>11}{'height [m]':>12}{'points':>8}{'score':>8}"
        )
    for number, each in enumerate(made.bodies[:20], 1):
        x, y = each.middle_m[:2]
        print(
            f"{number:<8}{x:>14.2f}{y:>14.2f}{each.length_m:>12.1f}{each.width_m:>11.1f}{each.height_m:>12.1f}{each.points:>8}"
            f"{each.score:>8.1f}"
        )
    print(
        f"{len(made.bodies)} objects in {arguments.output}; {made.penetration:.0%} of the pulses came down, "
        f"over {made.blind:.0%} of {made.hectares:.2f} ha nothing can be claimed"
    )
    return 0
