"""`swath orthophoto`: an attribute of clouds seen from above."""

import argparse
import sys
from pathlib import Path

HELP = "make an orthophoto of reflectance or another attribute of clouds, by moving planes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("clouds", nargs="+", type=Path, metavar="CLOUD", help="LAS, LAZ or COPC files of one CRS")
    parser.add_argument(
        "--attribute", default="reflectance", metavar="NAME", help="any attribute of the points; default: reflectance"
    )
    parser.add_argument("--cell", type=float, default=0.25, metavar="M", help="size of a cell [m]; default: 0.25")
    parser.add_argument("--crs", metavar="EPSG", help="projected CRS of the clouds; default: as they state")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the raster, .tif")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Make it, with a progress bar on a terminal."""
    from dataclasses import asdict

    from tqdm import tqdm

    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json
    from groundproc.radiometry.orthophoto import SUFFIXES, orthophoto

    expect(arguments.clouds, CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, SUFFIXES, arguments.force, arguments.clouds)
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        made = orthophoto(
            arguments.clouds, arguments.output, arguments.attribute, arguments.cell, arguments.crs, bar.update
        )
    for line in made.warnings:
        print(f"swath: warning: {line}", file=sys.stderr)
    if arguments.json is not None:
        write_json(arguments.json, asdict(made))
    print(
        f"{made.columns} x {made.rows} cells of {made.cell_m:g} m in {arguments.output}, {made.filled:,} of them with a value, "
        f"from {made.used:,} of {made.points:,} points"
    )
    return 0
