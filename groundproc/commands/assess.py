"""`swath assess`: how good a cloud, or a set of coordinates, is against what is known from elsewhere."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from groundproc.assessment.targets import Wanted

HELP = "hold a cloud against surveyed points, or two sets of coordinates against each other"
USAGE = "expected swath assess CLOUD --points CSV [--mode MODE], or swath assess --pairs CSV"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", nargs="?", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "--points", type=Path, metavar="CSV",
        help="surveyed points in the CRS of the cloud: columns id, x, y, z, and if known sigma, or sigma_x, sigma_y, sigma_z",
    )  # fmt: skip
    parser.add_argument(
        "--mode", choices=("point", "plane", "target"),
        help="compare with the nearest point, with the surface in height only, or with the centre of a target; default: a target where "
        "one is found, else the surface in height, and in plan a point of the cloud within 5 cm",
    )  # fmt: skip
    parser.add_argument(
        "--target", metavar="KINDS",
        help="targets that may be there: some of checkerboard, cross, disc and sphere, separated by commas, or none; default: all",
    )  # fmt: skip
    parser.add_argument(
        "--target-size",
        type=float,
        metavar="M",
        help="diameter of discs and spheres, length of crosses [m]; default: found",
    )
    parser.add_argument(
        "--pairs",
        type=Path,
        metavar="CSV",
        help="two sets of coordinates by id: columns id, then x, y, z of each, reference first",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="draw the differences: a map, and how they are spread"
    )
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Compare, and print a table."""
    from flightlog.errors import UsageError
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json

    given = bool(arguments.cloud), bool(arguments.points), bool(arguments.pairs)
    apart = arguments.mode or arguments.target or arguments.target_size
    if given not in ((True, True, False), (False, False, True)) or (arguments.pairs and apart):
        raise UsageError(USAGE)
    wanted = _wanted(arguments)
    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    for path, suffix in ((arguments.json, ".json"), (arguments.picture, ".png")):
        if path is not None:
            claim_file(path, (suffix,), arguments.force)

    from tqdm import tqdm

    from groundproc.assessment import pictures, work

    if arguments.pairs:
        found = work.of_pairs(arguments.pairs)
    else:
        task = work.PointsTask(arguments.cloud, arguments.points, arguments.mode, wanted)
        with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
            found = work.of_cloud(task, bar.update)
    if arguments.picture is not None:
        against = arguments.pairs or f"{arguments.cloud.name} against {arguments.points.name}"
        pictures.residuals(arguments.picture, found.ids, found.place_m, found.d_m, str(against))
    if arguments.json is not None:
        write_json(arguments.json, found.told)
    print(found.text)
    return 0


def _wanted(arguments: argparse.Namespace) -> "Wanted":
    """The targets that are looked for.

    Raises
    ------
    UsageError
        A kind or a size is none.
    """
    from flightlog.errors import UsageError
    from groundproc.assessment.target import KINDS
    from groundproc.assessment.targets import Wanted

    kinds: tuple[str, ...] = KINDS
    if arguments.target is not None:
        kinds = tuple(dict.fromkeys(word.strip() for word in arguments.target.split(",")))
        kinds = () if kinds == ("none",) else kinds
        wrong = next((kind for kind in kinds if kind not in KINDS), None)
        if wrong is not None:
            raise UsageError(f"--target {wrong}: expected some of {', '.join(KINDS)}, or none")
        if not kinds and arguments.mode == "target":
            raise UsageError(f"--target none with --mode target: expected some of {', '.join(KINDS)}")
    if arguments.target_size is not None and not 0.1 <= arguments.target_size <= 1.25:
        raise UsageError(f"--target-size {arguments.target_size:g}: expected 0.1 to 1.25 m")
    return Wanted(kinds, arguments.target_size)
