"""`swath change`: what appeared and what vanished between two epochs."""

import argparse
import sys
from pathlib import Path

HELP = "compare two epochs of a place: register them, and find what appeared or vanished, down to 1 dm3"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_all_classes

    parser.add_argument("a", type=Path, metavar="A", help="the earlier cloud: LAS, LAZ or COPC")
    parser.add_argument("b", type=Path, metavar="B", help="the later one")
    parser.add_argument("--trajectory-a", type=Path, metavar="FILE", help="of A's flight: what its beams went through")
    parser.add_argument("--trajectory-b", type=Path, metavar="FILE", help="of B's flight")
    parser.add_argument(
        "--voxel", type=float, metavar="M", help="edge; default: three spacings of points, 0.1 m at least"
    )
    parser.add_argument("--sway", type=float, metavar="M", help="how far leaves move; default: 0.25, or two voxels")
    parser.add_argument("--registered", action="store_true", help="the clouds lie on each other already")
    parser.add_argument("--week", type=int, metavar="N", help="GPS week, where the files have only seconds of it")
    parser.add_argument("--geoid", type=float, default=0.0, metavar="N", help="taken off the trajectories' heights [m]")
    add_all_classes(parser)
    surfaces = parser.add_argument_group(
        "surfaces", "how far the ground moved along its normals (M3C2), and what was lost and gained"
    )
    surfaces.add_argument("--surface", action="store_true", help="write surface.laz and surface.geojson too")
    surfaces.add_argument("--radius", type=float, metavar="M", help="of the cylinders; default: of 30 points")
    surfaces.add_argument(
        "--reach", type=float, default=2.0, metavar="M", help="how far a surface may have moved; default: 2"
    )
    surfaces.add_argument("--spacing", type=float, metavar="M", help="between core points; default: two radii")
    surfaces.add_argument("--ground", action="store_true", help="points of class 2 only")
    surfaces.add_argument(
        "--registration-sigma",
        type=float,
        default=0.0,
        metavar="M",
        help="with --registered: how well they lie on each other",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the results")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Compare, and say what was found."""
    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.analysis.change import FILES, Task
    from groundproc.analysis.change import run as compare
    from groundproc.analysis.deformation import surface
    from groundproc.commands.figures import warn
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, SOLUTION_WORDS, SOLUTIONS, expect
    from groundproc.commands.outputs import claim_file, claim_folder, write_json

    for word in ("voxel", "sway", "radius", "reach", "spacing"):
        value = getattr(arguments, word)
        if value is not None and not 0.0 < value <= 100.0:
            raise UsageError(f"--{word} {value:g}: expected more than 0 and up to 100 m")
    if not 0.0 <= arguments.registration_sigma <= 100.0:
        raise UsageError(f"--registration-sigma {arguments.registration_sigma:g}: expected 0 to 100 m")
    expect([arguments.a, arguments.b], CLOUD, CLOUD_WORDS)
    expect([arguments.trajectory_a, arguments.trajectory_b], SOLUTIONS, SOLUTION_WORDS)
    measured = None
    if arguments.surface:
        measured = surface.Task(
            arguments.radius, arguments.reach, arguments.spacing, arguments.ground, arguments.registration_sigma
        )
    claim_folder(arguments.output, FILES + (surface.FILES if arguments.surface else ()), arguments.force)
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    task = Task(
        arguments.a, arguments.b, arguments.output, arguments.trajectory_a, arguments.trajectory_b, arguments.voxel, arguments.sway,
        arguments.registered, arguments.week, arguments.geoid, measured, arguments.all_classes,
    )  # fmt: skip
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, count: int) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(count)

        told = compare(task, advance)
    if arguments.json is not None:
        write_json(arguments.json, told)
    warn(told["warnings"], sys.stderr)
    found = told["registration"]
    print(
        f"registration: residual {found['residual_m'] * 1e3:.1f} mm, sigma {max(found['sigma_m']) * 1e3:.1f} mm, "
        f"{found['overlap']:.0%} overlap\n"
        f"{told['appeared']} appeared ({told['appeared_m3']:.3f} m3), {told['vanished']} vanished ({told['vanished_m3']:.3f} m3), "
        f"voxels of {told['voxel_m']:.2f} m; {arguments.output}"
    )
    if measured is not None:
        ground = told["surface"]
        print(
            f"surface: {ground['lost_m3']:.3f} +- {ground['lost_sigma_m3']:.3f} m3 lost, {ground['gained_m3']:.3f} +- "
            f"{ground['gained_sigma_m3']:.3f} m3 gained in {ground['areas']} areas; {ground['lod95_m'] * 1e3:.1f} mm are told from none "
            "at 95 %"
        )
    return 0
