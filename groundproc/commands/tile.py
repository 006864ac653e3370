"""`swath tile`: clouds as files of squares of the map, with an index and an overview."""

import argparse
import sys
from pathlib import Path

HELP = "cut clouds of one CRS into tiles (COPC or LAZ) with an index (.vpc) for QGIS and PDAL and an overview"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.cloud.tiling import FORMATS
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "clouds",
        nargs="+",
        type=Path,
        metavar="CLOUD",
        help="LAS, LAZ or COPC of one CRS, or folders of `swath process`",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the tiles and of cloud.vpc"
    )
    parser.add_argument(
        "--size",
        type=float,
        default=250.0,
        metavar="M",
        help="side of a tile [m]; edges lie on whole multiples of it; default: 250",
    )
    parser.add_argument("--format", choices=tuple(FORMATS), default="copc", help="of the tiles; default: copc")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write the tiles, and say how many."""
    from tqdm import tqdm

    from groundproc.cloud import reader
    from groundproc.cloud.sameness import agreed_crs, agreed_times
    from groundproc.cloud.tilefiles import tile_clouds
    from groundproc.cloud.tiling import INDEX
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, cloud_in, expect

    paths = [cloud_in(each) for each in arguments.clouds]
    expect(paths, CLOUD, CLOUD_WORDS)
    clouds = [reader.look(path) for path in paths]
    if agreed_crs(clouds) is None:
        print(
            f"swath: warning: {paths[0]} states no CRS, and so tiles and index state none: QGIS shows them at 0, 0",
            file=sys.stderr,
        )
    agreed_times(clouds)
    total = 2 * sum(cloud.points for cloud in clouds)
    with tqdm(total=total, unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        tiles = tile_clouds(clouds, arguments.output, arguments.size, arguments.format, arguments.force, bar.update)
    points = sum(tile.points for tile in tiles)
    print(f"{points:,} points in {len(tiles)} tiles of {arguments.size:g} m; {arguments.output / INDEX} opens them all")
    return 0
