"""`swath passability`: where a vehicle can go, and the best route."""

import argparse
import sys
from pathlib import Path

HELP = "show where a vehicle can go: slope, steps, obstacles, unseen ground; and the best route"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the results")
    parser.add_argument("--from", dest="start", metavar="E,N", help="begin of a route, in the CRS of the cloud")
    parser.add_argument("--to", dest="end", metavar="E,N", help="end of it")
    for word, default, about in (
        ("--max-slope", 20.0, "steepest slope that the vehicle goes on [deg]"),
        ("--max-step", 0.2, "highest step up or down [m]"),
        ("--max-obstacle", 0.3, "highest thing that it goes over [m]"),
        ("--width", 2.0, "width of the vehicle [m]"),
        ("--height", 2.5, "height of the vehicle: what hangs higher is no obstacle [m]"),
    ):
        parser.add_argument(word, type=float, default=default, metavar="N", help=f"{about}; default: {default:g}")
    parser.add_argument("--cell", type=float, metavar="M", help="size of a cell [m]; default: 0.25 to 1 by the density")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Look, and say how much of it can be gone on."""
    from flightlog import config
    from flightlog.errors import UsageError
    from groundproc.analysis.passability import FILES, Task, Vehicle, work
    from groundproc.commands.figures import claim_json, points_bar, warn, write_json
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_folder
    from groundproc.commands.values import numbers

    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    claim_folder(arguments.output, FILES, arguments.force)
    claim_json(arguments)
    given = [(arguments.start, "--from"), (arguments.end, "--to")]
    if (arguments.start is None) != (arguments.end is None):
        raise UsageError("--from and --to: one of them given, expected both or none")
    ends = [numbers(text, word, 2, "E,N") for text, word in given if text is not None]
    vehicle = config.from_mapping(
        {
            "max_slope_deg": arguments.max_slope, "max_step_m": arguments.max_step, "max_obstacle_m": arguments.max_obstacle,
            "width_m": arguments.width, "height_m": arguments.height,
        },
        Vehicle, "command line",
    )  # fmt: skip
    task = Task(
        arguments.cloud, arguments.output, vehicle, arguments.cell,
        None if not ends else ((ends[0][0], ends[0][1]), (ends[1][0], ends[1][1])),
    )  # fmt: skip
    with points_bar() as advance:
        made = work(task, advance)
    write_json(arguments, made.figures())
    warn(made.warnings, sys.stderr)
    for name, area in made.area_m2.items():
        print(f"{name:<14}{area:>12,.1f} m2")
    if made.route is not None:
        route = made.route
        print(
            f"route of {route['length_m']:.1f} m, {route['rise_m']:.1f} m up and {route['fall_m']:.1f} m down, at most "
            f"{route['steepest_deg']:.1f} deg steep, steps to {route['highest_step_m']:.2f} m; {arguments.output / FILES[-1]}"
        )
    return 0
