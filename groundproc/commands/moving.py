"""`swath moving`: what moved while the cloud was measured, with time, place and speed."""

import argparse
import sys
from pathlib import Path

HELP = "list what moved during a flight: time, place and speed of people, cars and others, with sigmas"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.analysis.moving import EVERY_S
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "cloud", type=Path, metavar="CLOUD|DIR", help="a cloud with times and class 69, or a folder of swath process"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="MOVING.geojson", help="places, .geojson or .gpkg"
    )
    parser.add_argument("--ways", type=Path, metavar="FILE", help="write a line for each thing too")
    parser.add_argument(
        "--every", type=float, default=EVERY_S, metavar="S", help=f"between places of a thing [s]; default: {EVERY_S:g}"
    )
    parser.add_argument("--week", type=int, metavar="N", help="GPS week, where the file has only seconds of it")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find them, and print a table."""
    from groundproc.analysis.moving import Task, cloud_in, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.vectors.features import DRIVERS

    cloud = cloud_in(arguments.cloud)
    expect([cloud], CLOUD, CLOUD_WORDS)
    for path in (arguments.output, arguments.ways):
        if path is not None:
            claim_file(path, tuple(DRIVERS), arguments.force, [cloud])
    claim_json(arguments)
    with points_bar() as advance:
        made = work(Task(cloud, arguments.output, arguments.ways, arguments.every, arguments.week), advance)
    write_json(arguments, made.figures())
    warn(made.warnings, sys.stderr)
    if made.tracks:
        print(f"{'thing':<7}{'seen for [s]':>13}{'speed [m/s]':>17}{'length, width, height [m]':>28}{'points':>10}")
    for number, each in enumerate(made.tracks, 1):
        seen = each.time_s[-1] - each.time_s[0]
        speed = f"{each.mean_m_s:.2f} ± {each.mean_sigma_m_s:.2f}"
        size = ", ".join(f"{value:.1f}" for value in each.size_m)
        print(f"{number:<7}{seen:>13.1f}{speed:>17}{size:>28}{each.points:>10,}")
    print(f"{len(made.tracks)} moved, of {made.points:,} points of class 69; {arguments.output}")
    return 0
