"""`swath export`: a cloud in another format."""

import argparse
import sys
from pathlib import Path

HELP = "write a cloud in another format: COPC, LAZ, LAS, PLY, E57, CSV"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="a name that ends in .copc.laz, .laz, .las, .ply, .e57 or .csv",
    )
    parser.add_argument("--force", action="store_true", help="overwrite the output")


def run(arguments: argparse.Namespace) -> int:
    """Write it, with a progress bar on a terminal."""
    from tqdm import tqdm

    from flightlog.errors import SourceError
    from groundproc.cloud import exports, reader
    from groundproc.files import written_aside

    output = arguments.output
    exports.format_of(output)
    if output.exists() and not arguments.force:
        raise SourceError(f"{output}: is there already; --force overwrites it")
    cloud = reader.look(arguments.cloud)
    bar = tqdm(total=cloud.points, unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty())
    with bar, written_aside(output) as aside:
        exports.write(cloud, output, aside, bar.update)
    print(f"{cloud.points:,} points in {output}")
    return 0
