"""`swath tin`: a terrain or surface model as triangles, for design programs and machine control."""

import argparse
import sys
from pathlib import Path

HELP = "make triangles of a raster of heights, within a tolerance: LandXML or DXF"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("raster", type=Path, metavar="DTM", help="a GeoTIFF of heights")
    parser.add_argument(
        "--tolerance", type=float, default=0.05, metavar="M",
        help="no known cell lies farther above or below the triangles [m, or the unit of its CRS]; default: 0.05",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="a name that ends in .xml or .dxf"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Triangulate, and say how close it is."""
    from tqdm import tqdm

    from groundproc.analysis.tin import tin
    from groundproc.cloud.metres import flat, metres_in
    from groundproc.commands.inputs import RASTER, RASTER_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json
    from groundproc.files import written_aside
    from groundproc.raster import geotiff
    from groundproc.vectors.dxf import write_faces
    from groundproc.vectors.landxml import write_surface

    output: Path = arguments.output
    expect([arguments.raster], RASTER, RASTER_WORDS)
    claim_file(output, (".xml", ".dxf"), arguments.force, [arguments.raster])
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    bar = tqdm(total=100, unit="%", leave=False, disable=not sys.stderr.isatty())
    with geotiff.opened(arguments.raster) as raster, bar:
        flat(arguments.raster, raster.crs)
        made = tin(raster, arguments.tolerance, lambda share: bar.update(100.0 * share - bar.n))
        crs = raster.crs
    if crs is None:
        print(f"swath: warning: {arguments.raster} states no CRS, and so {output} states none", file=sys.stderr)
    with written_aside(output) as aside:
        if output.suffix.lower() == ".dxf":
            write_faces(aside, made.places, made.triangles, "TIN", metres_in(crs).across)
        else:
            write_surface(aside, made.places, made.triangles, arguments.raster.stem, crs)
    if arguments.json is not None:
        told = {
            "points": len(made.places), "triangles": len(made.triangles), "cells": made.cells,
            "tolerance": arguments.tolerance, "greatest_difference": made.greatest, "rms_difference": made.rms,
        }  # fmt: skip
        write_json(arguments.json, told)
    print(
        f"{len(made.triangles):,} triangles through {len(made.places):,} of {made.cells:,} cells; heights differ by {made.greatest:.3f} at "
        f"most, {made.rms:.3f} rms; {output}"
    )
    return 0
