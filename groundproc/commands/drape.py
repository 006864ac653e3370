"""`swath drape`: rasters of other sensors over a cloud."""

import argparse
import sys
from pathlib import Path

HELP = "drape a thermal, multi- or hyperspectral raster over a cloud, and tell materials by their spectra"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument("raster", type=Path, metavar="RASTER", help="a georeferenced raster of any number of bands")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT.laz", help="the same points with the values"
    )
    parser.add_argument(
        "--as", dest="names", metavar="NAMES",
        help="what the bands become, between commas: temperature, ndvi, reflectance, red, green, blue, nir, red_edge",
    )  # fmt: skip
    parser.add_argument(
        "--spectra",
        type=Path,
        metavar="FILE.csv",
        help="spectra of materials: each point gets the one at the least angle",
    )
    parser.add_argument(
        "--max-angle", type=float, default=6.0, metavar="DEG", help="farther from all of them is none; default: 6"
    )
    parser.add_argument(
        "--top",
        type=float,
        default=0.5,
        metavar="M",
        help="how far below the top of its cell a point is still seen; default: 0.5",
    )
    parser.add_argument("--all", action="store_true", help="give every point a value, whatever lies above it")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Drape, and say over how much."""
    import math

    from flightlog.errors import UsageError
    from groundproc.analysis.drape import Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, RASTER, expect
    from groundproc.commands.outputs import claim_file

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    expect([arguments.raster], RASTER, "a georeferenced raster (GeoTIFF)")
    expect([arguments.spectra], ("table", "text"), "a table of spectra (CSV)")
    claim_file(arguments.output, (".laz", ".las"), arguments.force, [arguments.cloud])
    claim_json(arguments)
    for word, value, high in (("--max-angle", arguments.max_angle, 90.0), ("--top", arguments.top, 100.0)):
        if not (math.isfinite(value) and 0.0 < value <= high):
            raise UsageError(f"{word} {value:g}: expected more than 0 and {high:g} at most")
    names = [] if arguments.names is None else [name.strip() for name in arguments.names.split(",")]
    task = Task(
        arguments.cloud, arguments.raster, arguments.output, names, arguments.spectra, arguments.max_angle,
        None if arguments.all else arguments.top,
    )  # fmt: skip
    with points_bar() as advance:
        made = work(task, advance)
    figures = made.figures()
    write_json(arguments, figures)
    warn(made.warnings, sys.stderr)
    for name, count in made.materials.items():
        print(f"{name:<24}{count:>14,}")
    if made.materials:
        print(f"{'none of them':<24}{made.unlike:>14,}")
    print(
        f"{made.draped:,} of {made.points:,} points have a value in {arguments.output}; {made.below:,} lie below the top, "
        f"{made.outside:,} outside of the raster or on cells without a value"
    )
    return 0
