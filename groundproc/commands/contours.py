"""`swath contours`: lines of equal height of a terrain or surface model, as GeoPackage, GeoJSON or DXF."""

import argparse
import sys
from pathlib import Path

HELP = "draw contours of a raster of heights, to GeoPackage, GeoJSON or DXF"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("raster", type=Path, metavar="DTM", help="a GeoTIFF of heights")
    parser.add_argument(
        "--interval",
        type=float,
        default=0.5,
        metavar="M",
        help="between the lines [m, or the unit of its heights]; default: 0.5",
    )
    parser.add_argument(
        "--shortest", type=float, default=2.0, metavar="M", help="shorter lines are left out [m]; default: 2"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="a name that ends in .gpkg, .geojson or .dxf"
    )
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Draw them."""
    from flightlog.errors import CoverageError
    from groundproc.cloud.metres import flat, metres_in
    from groundproc.commands.inputs import RASTER, RASTER_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.files import written_aside
    from groundproc.raster import geotiff
    from groundproc.vectors import contours, files

    output: Path = arguments.output
    expect([arguments.raster], RASTER, RASTER_WORDS)
    claim_file(output, files.ENDINGS, arguments.force, [arguments.raster])
    with geotiff.opened(arguments.raster) as raster:
        flat(arguments.raster, raster.crs)
        unit = metres_in(raster.crs)
        lines = list(contours.contours(raster, arguments.interval, arguments.shortest / unit.across))
        if not lines:
            raise CoverageError(
                f"{arguments.raster}: no contour at whole multiples of {arguments.interval:g} {unit.height_word} that is "
                f"{arguments.shortest:g} m long"
            )
        if raster.crs is None:
            print(f"swath: warning: {arguments.raster} states no CRS, and so {output} states none", file=sys.stderr)
        with written_aside(output) as aside:
            files.write_contours(aside, output.suffix.lower(), lines, raster.crs, unit)
    print(f"{len(lines)} contours of {lines[0].height:g} to {lines[-1].height:g} {unit.height_word} in {output}")
    return 0
