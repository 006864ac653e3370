"""`swath export`: a cloud in another format."""

import argparse
import sys
from pathlib import Path

HELP = "write a cloud in another format: COPC, LAZ, LAS, PLY, E57, CSV"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="a name that ends in .copc.laz, .laz, .las, .ply, .e57 or .csv",
    )
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write it, with a progress bar on a terminal."""
    from tqdm import tqdm

    from groundproc.cloud import exports, reader
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.files import written_aside

    output = arguments.output
    exports.format_of(output)
    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    claim_file(
        output, [f".{ending.rpartition('.')[2]}" for ending in exports.FORMATS], arguments.force, [arguments.cloud]
    )
    cloud = reader.look(arguments.cloud)
    bar = tqdm(total=cloud.points, unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty())
    with bar, written_aside(output) as aside:
        exports.write(cloud, output, aside, bar.update)
    print(f"{cloud.points:,} points in {output}")
    return 0
