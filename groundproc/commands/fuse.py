"""`swath fuse`: clouds of several scanners in one."""

import argparse
import sys
from pathlib import Path

HELP = "merge clouds of other scanners or photogrammetry, each registered onto the first"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "clouds", nargs="+", type=Path, metavar="CLOUD", help="LAS, LAZ or COPC, two or more; the first stays"
    )
    parser.add_argument("--registered", action="store_true", help="they lie on each other already")
    parser.add_argument(
        "--search",
        action="store_true",
        help="place and heading of the others are not known: look for them on the first",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the cloud, .laz")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Merge, and say how well they fit."""
    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.analysis.fuse import fuse, told
    from groundproc.cloud import reader
    from groundproc.cloud.metres import unstated
    from groundproc.commands.figures import warn
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json

    if not 2 <= len(arguments.clouds) <= 255:
        given = "one cloud" if len(arguments.clouds) == 1 else f"{len(arguments.clouds)} clouds"
        raise UsageError(f"{given} given, expected 2 to 255")
    if arguments.search and arguments.registered:
        raise UsageError("--search and --registered: both given, expected one of them")
    expect(arguments.clouds, CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, (".laz",), arguments.force, arguments.clouds)
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        laid = fuse(arguments.clouds, arguments.output, arguments.registered, bar.update, searched=arguments.search)
    if arguments.json is not None:
        write_json(arguments.json, {"clouds": told(laid)})
    warn(unstated(*map(reader.look, arguments.clouds)), sys.stderr)
    for number, each in enumerate(laid):
        found = each.registration
        how = (
            "as it is"
            if found is None
            else f"moved; residual {found.residual_m * 1e3:.1f} mm, {found.fit:.0%} lie on the first"
        )
        print(f"{number}: {each.path}, {each.points:,} points, {how}")
    return 0
