"""`swath ground`: bare ground of a cloud, heights above it, terrain and canopy models, buildings."""

import argparse
import sys
from pathlib import Path

HELP = "class the ground of a cloud: height above ground, terrain and canopy models, buildings, vegetation"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT.laz",
        help="the same points with classes and height above ground",
    )
    parser.add_argument("--dtm", type=Path, metavar="FILE.tif", help="write the terrain model")
    parser.add_argument("--confidence", type=Path, metavar="FILE.tif", help="write the sigma of each of its cells")
    parser.add_argument("--chm", type=Path, metavar="FILE.tif", help="write the canopy height model, free of spikes")
    parser.add_argument("--buildings", type=Path, metavar="FILE", help="write outlines of buildings: .geojson or .gpkg")
    parser.add_argument(
        "--water",
        type=Path,
        metavar="FILE",
        help="polygons of water, .geojson or .gpkg: the terrain is level within them",
    )
    parser.add_argument(
        "--terrain",
        default="auto",
        metavar="NAME",
        help="auto, flat, hilly, steep or urban; default: auto, which goes by the cloud",
    )
    parser.add_argument("--cell", type=float, metavar="M", help="size of a cell [m]; default: 0.5, of sparse clouds 1")
    parser.add_argument(
        "--window",
        type=float,
        metavar="M",
        help="half the width of the largest building [m]; default: 20, and wider halls by their walls",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find the ground, and say how well."""
    from groundproc.analysis.ground import Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.vectors.features import DRIVERS

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    inputs = [arguments.cloud] + ([] if arguments.water is None else [arguments.water])
    claim_file(arguments.output, (".laz", ".las"), arguments.force, inputs)
    for path in (arguments.dtm, arguments.confidence, arguments.chm):
        if path is not None:
            claim_file(path, (".tif", ".tiff"), arguments.force, inputs)
    if arguments.buildings is not None:
        claim_file(arguments.buildings, tuple(DRIVERS), arguments.force, inputs)
    claim_json(arguments)
    with points_bar() as advance:
        made = work(
            Task(
                arguments.cloud, arguments.output, arguments.dtm, arguments.confidence, arguments.chm, arguments.buildings,
                arguments.water, arguments.terrain, arguments.cell, arguments.window,
            ),
            advance,
        )  # fmt: skip
    figures = made.figures()
    write_json(arguments, figures)
    warn(made.warnings, sys.stderr)
    for name, count in figures["classes"].items():
        if count:
            print(f"{name:<20}{count:>14,}")
    rmse = made.holdout.rmse_m
    if rmse is not None:
        print(f"ground left out is met within {rmse:.3f} m RMS, cells of {made.settings.cell_m:g} m")
    print(f"{figures['points']:,} points in {arguments.output}")
    return 0
