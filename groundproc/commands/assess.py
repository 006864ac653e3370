"""`swath assess`: how good a cloud, or a set of coordinates, is against what is known from elsewhere."""

import argparse
import sys
from pathlib import Path

HELP = "hold a cloud against surveyed points, or two sets of coordinates against each other"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", nargs="?", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "--points", type=Path, metavar="CSV", help="surveyed points in the CRS of the cloud: columns id, x, y, z"
    )
    parser.add_argument(
        "--mode", choices=("point", "plane"),
        help="compare with the nearest point, or with the surface in height only; default: the surface in height, and in plan a "
        "point of the cloud within 5 cm",
    )  # fmt: skip
    parser.add_argument(
        "--pairs",
        type=Path,
        metavar="CSV",
        help="two sets of coordinates by id: columns id, then x, y, z of each, reference first",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Compare, and print a table."""
    import json

    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.assessment import work
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.files import written_aside

    given = bool(arguments.cloud), bool(arguments.points), bool(arguments.pairs)
    if given not in ((True, True, False), (False, False, True)) or (arguments.pairs and arguments.mode):
        raise UsageError("expected swath assess CLOUD --points CSV [--mode MODE], or swath assess --pairs CSV")
    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    if arguments.pairs:
        told, text = work.of_pairs(arguments.pairs)
    else:
        with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
            told, text = work.of_cloud(arguments.cloud, arguments.points, arguments.mode, bar.update)
    if arguments.json is not None:
        with written_aside(arguments.json) as aside:
            aside.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    print(text)
    return 0
