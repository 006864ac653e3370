"""`swath colour`: a cloud in the colours of images."""

import argparse
import sys
from pathlib import Path

HELP = "colour a cloud from images: only points that an image sees, never through what stands before them"

SUFFIXES = (".laz", ".las")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_all_classes

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="LAS, LAZ or COPC file")
    add_images(parser)
    add_all_classes(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the coloured cloud, .laz")
    parser.add_argument(
        "--least-views",
        default="1",
        metavar="N",
        help="images that must see a point before it has a colour; default: 1",
    )
    parser.add_argument(
        "--no-balance", action="store_true", help="take exposure and white balance of each image as they are"
    )
    parser.add_argument(
        "--overlays",
        type=Path,
        metavar="FOLDER",
        help="write a picture of each camera there, with the points over it in colours of their height",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def add_images(parser: argparse.ArgumentParser) -> None:
    """Options by which images are found."""
    parser.add_argument(
        "--images", type=Path, required=True, metavar="DIR",
        help="folder of `swath images`, or of pictures with poses.csv and rig.yaml beside them",
    )  # fmt: skip
    parser.add_argument(
        "--photos",
        type=Path,
        metavar="DIR",
        help="folder of the pictures; default: DIR, or where `swath images` found them",
    )
    parser.add_argument("--crs", metavar="EPSG", help="projected CRS of the cloud; default: as it states")


def run(arguments: argparse.Namespace) -> int:
    """Colour, with a progress bar on a terminal."""
    from tqdm import tqdm

    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, claim_folder, write_json
    from groundproc.commands.values import count
    from groundproc.geodesy import projected_crs
    from groundproc.imagery.painting.colour import Task, colour, sentences

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, SUFFIXES, arguments.force, [arguments.cloud])
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    if arguments.overlays is not None:
        there = [path.name for path in sorted(arguments.overlays.glob("*.png"))]
        claim_folder(arguments.overlays, there, arguments.force)
    task = Task(
        arguments.cloud, arguments.images, arguments.output, arguments.photos,
        count(arguments.least_views, "--least-views"), None if arguments.crs is None else projected_crs(arguments.crs),
        not arguments.no_balance, arguments.overlays, all_classes=arguments.all_classes,
    )  # fmt: skip
    with tqdm(unit="", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, done: int) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(done)

        made = colour(task, advance)
    for line in made.left_out:
        print(f"swath: warning: {line}", file=sys.stderr)
    if arguments.json is not None:
        write_json(arguments.json, made.figures())
    print("\n".join([*sentences(made), f"{arguments.output}: written"]))
    return 0
