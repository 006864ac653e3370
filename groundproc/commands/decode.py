"""`swath decode`: the lidar's points in its own frame; for a look without an INS, and for scans from a tripod."""

import argparse
from pathlib import Path
from typing import Final

EVERYTHING: Final = {"min_range_m": 0.0, "max_range_m": 131.07}
"""A look at the lidar alone leaves nothing out by range."""
HELP = "write the lidar's points in its own frame, without any trajectory"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.options import add_settings
    from groundproc.commands.outputs import add_force
    from groundproc.survey import PlacingSettings

    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="a flight log, or all parts of one flight")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the cloud, .laz")
    add_force(parser)
    add_settings(parser, [PlacingSettings], defaults=EVERYTHING)


def run(arguments: argparse.Namespace) -> int:
    """Decode, with a progress bar on a terminal."""
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect, told_damage
    from groundproc.commands.options import chosen_settings
    from groundproc.commands.outputs import claim_file
    from groundproc.products.sensor_cloud import write_sensor_cloud
    from groundproc.progress import stages
    from groundproc.sensors.shots import Gate
    from groundproc.survey import PlacingSettings
    from groundproc.verdict import DOUBTFUL, EXIT_CODES, GOOD

    chosen = chosen_settings(arguments, PlacingSettings, EVERYTHING)
    expect(arguments.logs, LOG, LOG_WORDS)
    claim_file(arguments.output, (".laz",), arguments.force, arguments.logs)
    gate = Gate(*chosen.fov_deg, chosen.min_range_m, chosen.max_range_m)
    with stages(arguments.logs, {"decode": "points"}) as progress:
        cloud = write_sensor_cloud(arguments.logs, arguments.output, gate, lambda done: progress("decode", done))
    print(f"{cloud.points:,} points in {arguments.output}, {cloud.time_scale}")
    return EXIT_CODES[DOUBTFUL if told_damage(arguments.logs) else GOOD]
