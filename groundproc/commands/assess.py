"""`swath assess`: how good a cloud, or a set of coordinates, is against what is known from elsewhere."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groundproc.assessment.targets import Wanted

Progress = Callable[[str, int], None]
HELP = "compare a cloud with surveyed points, or two sets of coordinates with each other"
USAGE = "expected swath assess CLOUD --points CSV [--mode MODE], CLOUD --reference CLOUD, CLOUD --strips, or swath assess --pairs CSV"


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
    parser.add_argument(
        "--reference", type=Path, metavar="CLOUD", help="another cloud of the same place, taken as the truth"
    )
    parser.add_argument("--register", action="store_true", help="with --reference: lay the cloud on it first")
    parser.add_argument(
        "--strips",
        action="store_true",
        help="how well strips agree: thickness of planes within them, differences between",
    )
    parser.add_argument(
        "--before", type=Path, metavar="CLOUD", help="with --strips: the same cloud before it was adjusted, beside it"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="draw the differences: a map, and how they are spread"
    )
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Compare, and print a table."""
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json

    given = [name for name in ("points", "pairs", "reference", "strips") if getattr(arguments, name)]
    _agree(arguments, given)
    wanted = _wanted(arguments)
    expect([arguments.cloud, arguments.reference, arguments.before], CLOUD, CLOUD_WORDS)
    for path, suffix in ((arguments.json, ".json"), (arguments.picture, ".png")):
        if path is not None:
            claim_file(path, (suffix,), arguments.force)

    from tqdm import tqdm

    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, count: int) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(count)

        told, text = {"reference": _reference, "strips": _strips}.get(given[0], _points)(arguments, wanted, advance)
    if arguments.json is not None:
        write_json(arguments.json, told)
    print(text)
    return 0


def _agree(arguments: argparse.Namespace, given: list[str]) -> None:
    """See that what is given goes together.

    Raises
    ------
    UsageError
        It does not.
    """
    from flightlog.errors import UsageError

    if len(given) != 1 or bool(arguments.cloud) == (given == ["pairs"]):
        raise UsageError(USAGE)
    apart = {"mode": "points", "target": "points", "target_size": "points", "register": "reference", "before": "strips"}
    for name, needs in apart.items():
        if getattr(arguments, name) and given != [needs]:
            raise UsageError(f"--{name.replace('_', '-')}: belongs to --{needs}; {USAGE}")


def _points(arguments: argparse.Namespace, wanted: "Wanted", advance: Progress) -> tuple[dict[str, Any], str]:
    """Against surveyed points, or a table of pairs."""
    from groundproc.assessment import pictures, work

    if arguments.pairs:
        found = work.of_pairs(arguments.pairs)
    else:
        task = work.PointsTask(arguments.cloud, arguments.points, arguments.mode, wanted)
        found = work.of_cloud(task, lambda count: advance("points", count))
    if arguments.picture is not None:
        against = arguments.pairs or f"{arguments.cloud.name} against {arguments.points.name}"
        pictures.residuals(arguments.picture, found.ids, found.place_m, found.d_m, str(against))
    return found.told, found.text


def _reference(arguments: argparse.Namespace, wanted: "Wanted", advance: Progress) -> tuple[dict[str, Any], str]:
    """Against another cloud."""
    from groundproc.analysis import reference
    from groundproc.assessment import pictures

    found = reference.compare(reference.Task(arguments.cloud, arguments.reference, arguments.register), advance)
    if arguments.picture is not None:
        title = f"{arguments.cloud.name} less {arguments.reference.name}"
        pictures.distances(arguments.picture, [("", found.place_m, found.distance_m)], title)
    return found.told, reference.text(found.told)


def _strips(arguments: argparse.Namespace, wanted: "Wanted", advance: Progress) -> tuple[dict[str, Any], str]:
    """Strips against each other."""
    from groundproc.assessment import pictures
    from groundproc.strips import precision

    voxel_m, before = None, None
    if arguments.before is not None:
        before = precision.of_cloud(arguments.before, None, advance)
        voxel_m = before.told["voxel_m"]
    found = precision.of_cloud(arguments.cloud, voxel_m, advance)
    if arguments.picture is not None:
        both = [("before", before)] * (before is not None) + [("after" if before is not None else "", found)]
        shown = [(name, each.differences.place_m, each.differences.along_m) for name, each in both if each is not None]
        pictures.distances(arguments.picture, shown, f"{arguments.cloud.name}: later strip less earlier one")
    if before is None:
        return found.told, precision.text(found.told)
    return found.told | {"before": before.told}, precision.text(found.told, before.told)


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
