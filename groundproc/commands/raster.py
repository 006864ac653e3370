"""`swath raster`: a Cloud-Optimized GeoTIFF of clouds of any origin, or what follows from the heights of another raster."""

import argparse
import sys
from pathlib import Path

HELP = "make a raster of clouds: surface model, intensity, density, hillshade, any attribute"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_all_classes

    parser.add_argument(
        "clouds", nargs="+", type=Path, metavar="CLOUD",
        help="LAS, LAZ or COPC files of one CRS; or one GeoTIFF of heights, for hillshade, local-relief and sky-view",
    )  # fmt: skip
    parser.add_argument(
        "--what", default="dsm", metavar="NAME",
        help="dsm, intensity, density, sigma, strip-difference, hillshade, local-relief, sky-view, or any attribute of the points; "
        "default: dsm",
    )  # fmt: skip
    parser.add_argument(
        "--statistic", metavar="NAME", help="max, min, mean, median, sigma or count of the values in a cell; default: max of "
        "heights, mean of others",
    )  # fmt: skip
    parser.add_argument(
        "--cell", type=float, metavar="M", help="size of a cell [m]; default: 0.25, of strip-difference 0.5"
    )
    parser.add_argument(
        "--tiles", type=float, metavar="M", help="side of tiles [m]: -o is a folder then, with an index (.vrt)"
    )
    add_all_classes(
        parser, "noise and what moves (classes 7, 18 and 69) and, of surfaces, points that are alone count too"
    )
    parser.add_argument("--crs", metavar="EPSG", help="projected CRS of the clouds; default: as they state")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the raster, .tif; with --tiles a folder"
    )
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Make the raster, with a progress bar on a terminal."""
    from tqdm import tqdm

    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, RASTER, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.raster.work import SUFFIXES, Task, work

    expect(arguments.clouds, (*CLOUD, *RASTER), CLOUD_WORDS)
    if arguments.tiles is None:
        claim_file(arguments.output, SUFFIXES, arguments.force, arguments.clouds)
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        task = Task(
            arguments.clouds, arguments.output, arguments.what, arguments.statistic, arguments.cell, arguments.crs,
            arguments.all_classes, arguments.tiles, arguments.force,
        )  # fmt: skip
        made = work(task, bar.update)
    for line in made.warnings:
        print(f"swath: warning: {line}", file=sys.stderr)
    left = f"; {made.left_out:,} points of classes 7, 18 and 69 left out" if made.left_out else ""
    alone = f"; {made.alone:,} points that are alone left out" if made.alone else ""
    print(f"{made.columns} x {made.rows} cells of {made.cell_m:g} m in {arguments.output}{left}{alone}")
    return 0
