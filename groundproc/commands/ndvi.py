"""`swath ndvi`: a vegetation index from images, as a raster and on the points of a cloud."""

import argparse
import sys
from pathlib import Path

HELP = "make NDVI or another index of images on the surface of a cloud, calibrated by panels, irradiance or the lidar"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.colour import add_images
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_all_classes

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="LAS, LAZ or COPC file of the place")
    add_images(parser)
    add_all_classes(parser)
    parser.add_argument("--gsd", type=float, default=0.05, metavar="M", help="size of a pixel [m]; default: 0.05")
    parser.add_argument(
        "--index", default="ndvi", metavar="NAME", help="ndvi, gndvi, ndre, ndwi or bndvi; default: ndvi"
    )
    parser.add_argument(
        "--panels",
        type=Path,
        metavar="FILE",
        help="CSV of surfaces of known reflectance: name,x,y,z,radius,red,green,blue,nir",
    )
    parser.add_argument(
        "--reference",
        metavar="NAME",
        help="panels, irradiance (XMP of the pictures) or lidar (attribute reflectance of the cloud); default: the first there is",
    )
    parser.add_argument(
        "--cloud",
        type=Path,
        dest="draped",
        metavar="FILE",
        help="write the cloud with the index of each point too, .laz",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the raster, .tif")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Make it, with a progress bar on a terminal."""
    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json
    from groundproc.geodesy import projected_crs
    from groundproc.imagery.painting.indices import INDICES, REFERENCES, Task, indices
    from groundproc.imagery.painting.ortho import SUFFIXES

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    expect([arguments.panels], ("control", "table", "text"), "a table of panels (CSV)")
    if arguments.index not in INDICES:
        raise UsageError(f"--index {arguments.index!r}: expected one of {', '.join(INDICES)}")
    if arguments.reference not in (None, *REFERENCES):
        raise UsageError(f"--reference {arguments.reference!r}: expected one of {', '.join(REFERENCES)}")
    if arguments.draped is not None and arguments.index != "ndvi":
        raise UsageError(f"--cloud: points carry ndvi only, and --index is {arguments.index}; leave one of them out")
    claim_file(arguments.output, SUFFIXES, arguments.force, [arguments.cloud])
    if arguments.draped is not None:
        claim_file(arguments.draped, (".laz", ".las"), arguments.force, [arguments.cloud])
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    task = Task(
        arguments.cloud, arguments.images, arguments.output, arguments.gsd, arguments.index, arguments.panels,
        arguments.draped, arguments.photos, None if arguments.crs is None else projected_crs(arguments.crs),
        arguments.reference, all_classes=arguments.all_classes,
    )  # fmt: skip
    with tqdm(unit="", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, done: int) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(done)

        made = indices(task, advance)
    for line in (*made.left_out, *made.warnings):
        print(f"swath: warning: {line}", file=sys.stderr)
    if arguments.json is not None:
        write_json(arguments.json, made.figures())
    by = made.by if made.calibrated else "not calibrated"
    print(
        f"{made.index} ({by}) of {made.columns} x {made.rows} pixels of {task.gsd_m:g} m in {task.output}: "
        f"{made.filled:,} have a value, median {made.median:.3f}"
    )
    return 0
