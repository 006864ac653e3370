"""`swath mesh`: the lidar's surface with photographs on it, as a mesh."""

import argparse
import sys
from pathlib import Path

HELP = "make a mesh of the surface that the lidar saw, with the images as its texture: .glb, or .obj with .mtl and pictures"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.colour import add_images
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_all_classes

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="LAS, LAZ or COPC file of the place")
    add_images(parser)
    add_all_classes(parser)
    parser.add_argument(
        "--cell", type=float, metavar="M", help="distance of vertices [m]; default: as the points allow"
    )
    parser.add_argument(
        "--texel", type=float, metavar="M", help="size of a texel [m]; default: a pixel of the images on the ground"
    )
    parser.add_argument(
        "--no-balance", action="store_true", help="take exposure and white balance of each image as they are"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the mesh, .glb or .obj")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Make it, with a progress bar on a terminal."""
    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json
    from groundproc.geodesy import projected_crs
    from groundproc.imagery.painting.mesh import SUFFIXES, Task, mesh

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    for name in ("cell", "texel"):
        value = getattr(arguments, name)
        if value is not None and not 0.001 <= value <= 100.0:
            raise UsageError(f"--{name} {value:g}: expected 0.001 to 100 m")
    claim_file(arguments.output, SUFFIXES, arguments.force, [arguments.cloud])
    if arguments.output.suffix.lower() == ".obj":
        claim_file(arguments.output.with_suffix(".mtl"), (".mtl",), arguments.force)
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    task = Task(
        arguments.cloud, arguments.images, arguments.output, arguments.photos, arguments.cell or 0.0, arguments.texel or 0.0,
        None if arguments.crs is None else projected_crs(arguments.crs), not arguments.no_balance, all_classes=arguments.all_classes,
    )  # fmt: skip
    with tqdm(unit="", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, done: int) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(done)

        made = mesh(task, advance)
    for line in made.left_out:
        print(f"swath: warning: {line}", file=sys.stderr)
    if arguments.json is not None:
        write_json(arguments.json, made.figures())
    print(
        f"{made.triangles:,} triangles of {made.cell_m:g} m, texture of {made.texel_m:g} m in {arguments.output}, {made.seen:.1%} of it "
        f"seen; coordinates are from {made.origin_m[0]:.0f}, {made.origin_m[1]:.0f}, {made.origin_m[2]:.0f}"
    )
    return 0
