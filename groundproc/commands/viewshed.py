"""`swath viewshed`: what is seen from a place."""

import argparse
import sys
from pathlib import Path

HELP = "show what is seen from a place or along a path: over a surface, or through leaves"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "source",
        type=Path,
        metavar="DSM|CLOUD",
        help="a raster of heights (.tif), or LAS, LAZ or COPC: the highest point of each cell, without those that are alone",
    )
    parser.add_argument("--at", metavar="E,N", help="place of the observer, in the CRS of the source")
    parser.add_argument(
        "--path", type=Path, metavar="FILE", help="GeoPackage or GeoJSON with lines to look from instead"
    )
    parser.add_argument("--step", type=float, default=10.0, metavar="M", help="between places of a path; default: 10")
    parser.add_argument("--height", type=float, required=True, metavar="M", help="observer over the surface")
    parser.add_argument("--target-height", type=float, default=0.0, metavar="M", help="targets over it; default: 0")
    parser.add_argument(
        "--mode", default="exact", metavar="exact|fast|voxels",
        help="every line followed, ring by ring, or transmittance through a cloud; default: exact",
    )  # fmt: skip
    parser.add_argument("--reverse", action="store_true", help="what sees the place: observers stand on the cells")
    parser.add_argument("--curvature", action="store_true", help="a round earth and refraction; default: flat")
    parser.add_argument("--cell", type=float, metavar="M", help="cells or voxels of a cloud; default: 0.5")
    parser.add_argument(
        "-t", "--trajectory", type=Path, metavar="FILE", help="of the cloud, for voxels: its true beams"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the raster, .tif")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Look, and say how much is seen."""
    from tqdm import tqdm

    from groundproc.analysis.sights import SUFFIXES
    from groundproc.analysis.sights import run as look
    from groundproc.analysis.sighttask import Task
    from groundproc.commands.inputs import CLOUD, RASTER, SOLUTION_WORDS, SOLUTIONS, expect
    from groundproc.commands.outputs import claim_file, write_json
    from groundproc.commands.values import numbers

    at = None if arguments.at is None else numbers(arguments.at, "--at", 2, "E,N")
    expect([arguments.source], (*CLOUD, *RASTER), "a raster of heights (GeoTIFF) or a cloud (LAS, LAZ or COPC)")
    expect([arguments.trajectory], SOLUTIONS, SOLUTION_WORDS)
    claim_file(arguments.output, SUFFIXES, arguments.force, [arguments.source])
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    task = Task(
        arguments.source, arguments.output, None if at is None else (at[0], at[1]), arguments.path, arguments.step, arguments.height,
        arguments.target_height, arguments.mode, arguments.reverse, arguments.curvature, arguments.cell, arguments.trajectory,
    )  # fmt: skip
    with tqdm(unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        told = look(task, bar.update)
    for line in told["warnings"]:
        print(f"swath: warning: {line}", file=sys.stderr)
    if arguments.json is not None:
        write_json(arguments.json, told)
    seen = (
        f"mean transmittance {told['mean_transmittance']:.3f}"
        if "mean_transmittance" in told
        else f"{told['visible_cells']:,} cells seen"
        + ("" if told["visible_m2"] is None else f", {told['visible_m2']:,.0f} m2")
    )
    print(f"{seen} of {told['cells']:,} cells, {told['unknown_cells']:,} unknown; {arguments.output}")
    return 0
