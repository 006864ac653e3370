"""`swath smooth`: a cloud freed of the sensor's noise, as a product of its own."""

import argparse
import sys
from pathlib import Path

HELP = "free a cloud of the sensor's noise by moving least squares: a marked copy, for pictures and models"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT.laz",
        help="the same points, those on surfaces moved onto them; default: CLOUD_smooth.laz beside it",
    )
    parser.add_argument(
        "--sigma",
        type=float,
        metavar="M",
        help="noise along the normals of surfaces [m]; default: as the smoothest quarter of the cloud has it",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Smooth, and say what became of the points."""
    from groundproc.analysis.smoothing import Task, output_for, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    output = arguments.output or output_for(arguments.cloud)
    claim_file(output, (".laz", ".las"), arguments.force, [arguments.cloud])
    claim_json(arguments)
    with points_bar() as advance:
        made = work(Task(arguments.cloud, output, arguments.sigma), advance)
    figures = made.figures()
    write_json(arguments, figures)
    warn(made.warnings, sys.stderr)
    for words, count in figures["states"].items():
        print(f"{words:<24}{count:>14,} {count / made.points:>7.1%}")
    print(
        f"noise {made.scale.sigma_m * 1e3:.1f} mm{' as stated' if made.scale.stated else ''}; moved by {figures['moved_rms_m'] * 1e3:.1f} "
        f"mm RMS, their surfaces are known to {figures['left_sigma_m'] * 1e3:.1f} mm"
    )
    print(f"{made.points:,} points in {output}")
    return 0
