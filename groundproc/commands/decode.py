"""`swath decode`: the lidar's points in its own frame; for a look without an INS, and for scans from a tripod."""

import argparse
from pathlib import Path

HELP = "write the lidar's points in its own frame, without any trajectory"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="a flight log, or all parts of one flight")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the cloud, .laz")
    add_force(parser)
    parser.add_argument(
        "--fov", default="255-105", metavar="A-B", help="azimuths kept, clockwise, in degrees, or all; default: 255-105"
    )
    parser.add_argument(
        "--min-range", type=float, default=0.0, metavar="M", help="nearer returns are dropped; default: none"
    )
    parser.add_argument("--max-range", type=float, default=131.07, metavar="M", help="farther returns are dropped")


def run(arguments: argparse.Namespace) -> int:
    """Decode, with a progress bar on a terminal."""
    from flightlog.errors import UsageError
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect, told_damage
    from groundproc.commands.outputs import claim_file
    from groundproc.commands.values import field_of_view
    from groundproc.products.sensor_cloud import write_sensor_cloud
    from groundproc.progress import stages
    from groundproc.sensors.shots import Gate
    from groundproc.verdict import DOUBTFUL, EXIT_CODES, GOOD

    if not 0.0 <= arguments.min_range <= arguments.max_range:
        raise UsageError(
            f"--min-range {arguments.min_range:g} --max-range {arguments.max_range:g}: expected 0 or more, and the first no larger"
        )
    expect(arguments.logs, LOG, LOG_WORDS)
    claim_file(arguments.output, (".laz",), arguments.force, arguments.logs)
    gate = Gate(*field_of_view(arguments.fov), arguments.min_range, arguments.max_range)
    with stages(arguments.logs, {"decode": "points"}) as progress:
        cloud = write_sensor_cloud(arguments.logs, arguments.output, gate, lambda done: progress("decode", done))
    print(f"{cloud.points:,} points in {arguments.output}, {cloud.time_scale}")
    return EXIT_CODES[DOUBTFUL if told_damage(arguments.logs) else GOOD]
