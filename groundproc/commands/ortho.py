"""`swath ortho`: an ortho mosaic of images on the surface of a cloud."""

import argparse
import sys
from pathlib import Path

HELP = "make an ortho mosaic of images, true to place on the surface of a cloud; which image made each pixel as a second raster"


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
        "--bands",
        metavar="NAME[,...]",
        help="of pictures of several kinds those with these bands; default: the colours",
    )
    parser.add_argument(
        "--no-balance", action="store_true", help="take exposure and white balance of each image as they are"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the mosaic, .tif; FILE_images.tif beside it"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Make it, with a progress bar on a terminal."""
    from tqdm import tqdm

    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json
    from groundproc.geodesy import projected_crs
    from groundproc.imagery.painting.ortho import SUFFIXES, Task, ortho

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    bands = tuple(word.strip() for word in arguments.bands.split(",")) if arguments.bands else ()
    task = Task(
        arguments.cloud, arguments.images, arguments.output, arguments.gsd, arguments.photos, bands,
        None if arguments.crs is None else projected_crs(arguments.crs), not arguments.no_balance, all_classes=arguments.all_classes,
    )  # fmt: skip
    for path in (arguments.output, task.sources):
        claim_file(path, SUFFIXES, arguments.force, [arguments.cloud])
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    with tqdm(unit="", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, done: int) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(done)

        made = ortho(task, advance)
    for line in made.left_out:
        print(f"swath: warning: {line}", file=sys.stderr)
    if arguments.json is not None:
        write_json(arguments.json, made.figures())
    share = made.filled / (made.columns * made.rows)
    print(
        f"{made.columns} x {made.rows} pixels of {task.gsd_m:g} m from {len(made.images)} images in {task.output}, "
        f"{share:.1%} of them seen; which image made each is in {task.sources}"
    )
    return 0
