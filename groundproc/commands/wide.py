"""`swath wide`: the images of one instant as one wide image."""

import argparse
import sys
from pathlib import Path

HELP = "merge the images that the cameras of a rig took at one instant into one wide image"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.colour import add_images
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_all_classes

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="LAS, LAZ or COPC file of the place")
    add_images(parser)
    add_all_classes(parser)
    parser.add_argument(
        "--within",
        type=float,
        default=0.05,
        metavar="S",
        help="images of one instant are no further apart [s]; default: 0.05",
    )
    parser.add_argument(
        "--no-balance", action="store_true", help="take exposure and white balance of each image as they are"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FOLDER",
        help="wide_0001.tif and so on, poses.csv and rig.yaml of the camera that stands for the rig, wide.json",
    )  # fmt: skip
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Make them, with a progress bar on a terminal."""
    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_folder, write_json
    from groundproc.geodesy import projected_crs
    from groundproc.imagery.painting.block import POSES, RIG
    from groundproc.imagery.painting.widefolder import JSON, NAME, Task, wide

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    if not 0.0 <= arguments.within <= 60.0:
        raise UsageError(f"--within {arguments.within:g}: expected 0 to 60 s")
    there = [path.name for path in sorted(arguments.output.glob(f"{NAME}_*.tif"))]
    claim_folder(arguments.output, (JSON, POSES, RIG, *there), arguments.force)
    task = Task(
        arguments.cloud, arguments.images, arguments.output, arguments.photos, arguments.within,
        None if arguments.crs is None else projected_crs(arguments.crs), not arguments.no_balance, all_classes=arguments.all_classes,
    )  # fmt: skip
    with tqdm(unit="", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, done: int) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(done)

        made = wide(task, advance)
    write_json(arguments.output / JSON, made.figures())
    for line in made.left_out:
        print(f"swath: warning: {line}", file=sys.stderr)
    if made.alone:
        print(f"swath: warning: {made.alone} images were taken alone and are in no wide image", file=sys.stderr)
    print(
        f"{len(made.images)} wide images of {made.width_px} x {made.height_px} pixels ({made.field_deg:.0f} deg across) from cameras "
        f"{', '.join(made.cameras)} in {arguments.output}, {made.filled:.1%} of them seen"
    )
    return 0
