"""`swath banks`: edges of banks, lines of waters, and between two epochs their retreat."""

import argparse
import sys
from pathlib import Path

HELP = "draw the edges of banks and the lines of waters, and between two clouds their retreat and the volume lost"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.analysis.banks.work import LEAST_DROP_M, LEAST_SLOPE_DEG, MOST_RETREAT_M, STRETCH_M
    from groundproc.analysis.terrain.settings import PRESETS
    from groundproc.commands.inputs import add_epochs
    from groundproc.commands.outputs import add_force

    add_epochs(parser, "retreat and volume")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="BANKS.geojson", help="lines, .geojson or .gpkg"
    )
    parser.add_argument(
        "--least-drop", type=float, default=LEAST_DROP_M, metavar="M",
        help=f"height of the lowest bank [m]; default: {LEAST_DROP_M:g}",
    )  # fmt: skip
    parser.add_argument(
        "--least-slope", type=float, default=LEAST_SLOPE_DEG, metavar="DEG",
        help=f"slope of the gentlest [deg]; default: {LEAST_SLOPE_DEG:g}",
    )  # fmt: skip
    parser.add_argument(
        "--water-level", type=float, metavar="M", help="height of the water [m]; default: found, if there is any"
    )
    parser.add_argument("--terrain", choices=list(PRESETS), default="auto", help="what the land is like; default: auto")
    parser.add_argument(
        "--stretch", type=float, default=STRETCH_M, metavar="M",
        help=f"with --before: length of a stretch, for which retreat and volume are given [m]; default: {STRETCH_M:g}",
    )  # fmt: skip
    parser.add_argument(
        "--most-retreat", type=float, default=MOST_RETREAT_M, metavar="M",
        help=f"with --before: how far an edge may have gone [m]; default: {MOST_RETREAT_M:g}",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find them, and say what there is."""
    from groundproc.analysis.banks.work import Task, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import epochs
    from groundproc.commands.outputs import claim_file
    from groundproc.vectors.features import DRIVERS

    inputs = epochs(arguments)
    claim_file(arguments.output, tuple(DRIVERS), arguments.force, inputs)
    claim_json(arguments)
    task = Task(
        arguments.cloud, arguments.output, arguments.before, arguments.registered, arguments.least_drop, arguments.least_slope,
        arguments.stretch, arguments.most_retreat, arguments.water_level, arguments.terrain,
    )  # fmt: skip
    with points_bar() as advance:
        made = work(task, advance)
    figures = made.figures()
    write_json(arguments, figures)
    warn(made.warnings, sys.stderr)
    if made.stretches:
        print(
            f"{'bank':<6}{'from [m]':>9}{'upper edge [m]':>18}{'lower edge [m]':>18}{'lost, gained [m3]':>20}{'sigma':>7}"
        )
    for each in made.stretches:
        by = [f"{r:+.2f} ± {s:.2f}" if r == r else "-" for r, s in zip(each.retreat_m, each.sigma_m, strict=True)]
        volume = f"{each.lost_m3:.1f}, {each.gained_m3:.1f}"
        print(f"{each.axis:<6}{each.first:>9}{by[0]:>18}{by[1]:>18}{volume:>20}{each.net_sigma_m3:>7.2f}")
    print(
        f"{figures['banks']} banks: {figures['upper_m']:.0f} m of upper edge, {figures['lower_m']:.0f} m of lower edge, "
        f"{figures['water_m']:.0f} m of water line; {arguments.output}"
    )
    return 0
