"""`swath transform`: a cloud in another CRS with national heights, in a site's own coordinates, or in distances on the ground."""

import argparse
import sys
from pathlib import Path

HELP = "put a cloud into another CRS and height system, a site's own coordinates, or distances as on the ground"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument("--crs", metavar="EPSG", help="another CRS, with + and that of its heights: 25833+7837")
    parser.add_argument(
        "--site",
        type=Path,
        metavar="CSV",
        help="a site's own coordinates: id, x, y, z in the cloud's CRS, x, y, z of the site",
    )
    parser.add_argument(
        "--ground", action="store_true", help="distances as on the ground, about the middle of the cloud"
    )
    parser.add_argument("--from", dest="source", metavar="EPSG", help="CRS of the cloud, in place of what it states")
    parser.add_argument(
        "--epoch", type=float, metavar="YEAR", help="at which the coordinates hold, between frames that move: 2025.4"
    )
    parser.add_argument("--grids", type=Path, metavar="DIR", help="folder with PROJ's grid files")
    parser.add_argument("--feet", action="store_true", help="take a CRS in feet")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="a name that ends in .laz or .las"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was done to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Transform, and say how."""
    from flightlog.errors import UsageError
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json

    if sum(map(bool, (arguments.crs, arguments.site, arguments.ground))) != 1:
        raise UsageError("expected one of --crs EPSG, --site CSV and --ground")
    if arguments.epoch is not None and not 1980.0 <= arguments.epoch <= 2100.0:
        raise UsageError(f"--epoch {arguments.epoch:g}: expected a year from 1980 to 2100, such as 2025.4")
    if arguments.grids is not None and not arguments.grids.is_dir():
        raise UsageError(f"--grids {arguments.grids}: is no folder")
    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, (".laz", ".las"), arguments.force, [arguments.cloud])
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)

    from tqdm import tqdm

    from groundproc.analysis import transform

    task = transform.Task(
        arguments.cloud, arguments.output, arguments.crs, arguments.site, arguments.ground, arguments.source, arguments.epoch,
        arguments.grids, arguments.feet,
    )  # fmt: skip
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        told = transform.transform(task, bar.update)
    if arguments.json is not None:
        write_json(arguments.json, told)
    print(transform.text(told))
    return 0
