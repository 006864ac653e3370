"""`swath trees`: a list of the trees of a cloud."""

import argparse
import sys
from pathlib import Path

HELP = "list the trees of a cloud: place, height, crown, stem where it is seen, dead ones"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="TREES.geojson", help="places, .geojson or .gpkg"
    )
    parser.add_argument(
        "--min-height", type=float, default=3.0, metavar="M", help="height of the lowest tree [m]; default: 3"
    )
    parser.add_argument("--bushes", action="store_true", help="list what is higher than 1 m too, as bushes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find them, and say how many."""
    import math

    from flightlog.errors import UsageError
    from groundproc.analysis.trees import BUSH_M, Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.vectors.features import DRIVERS

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, tuple(DRIVERS), arguments.force, [arguments.cloud])
    claim_json(arguments)
    if not (math.isfinite(arguments.min_height) and arguments.min_height >= BUSH_M):
        raise UsageError(f"--min-height {arguments.min_height:g} m: expected {BUSH_M:g} m or more, for example 3")
    with points_bar() as advance:
        least = BUSH_M if arguments.bushes else arguments.min_height
        made = work(Task(arguments.cloud, arguments.output, least), advance)
    figures = made.figures()
    write_json(arguments, figures)
    warn(made.warnings, sys.stderr)
    heights = "" if figures["median_height_m"] is None else f", median height {figures['median_height_m']:.1f} m"
    print(
        f"{figures['trees']} trees, {figures['dead']} dead, {figures['bushes']} bushes{heights}, "
        f"{figures['stems_seen']} stems seen, in {arguments.output}"
    )
    return 0
