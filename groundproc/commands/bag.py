"""`swath bag`: a flight as decoded topics for ROS 2 and Foxglove."""

import argparse
from pathlib import Path

HELP = "write a flight as decoded ROS 2 topics (MCAP), for Foxglove and ROS"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="a flight log, or all parts of one flight")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.mcap", help="the bag")
    parser.add_argument(
        "--trajectory", type=Path, metavar="DIR|CSV",
        help="what `swath process` made of the flight: its folder, or a trajectory.csv; default: the autopilot's own way",
    )  # fmt: skip
    parser.add_argument("--mount", metavar="YAML", help="how the lidar is mounted; default: as the log has it")
    parser.add_argument(
        "--fov", default="all", metavar="A-B", help="azimuths kept, clockwise, in degrees, or all; default: all"
    )
    parser.add_argument(
        "--min-range", type=float, default=0.0, metavar="M", help="nearer returns are dropped; default: none"
    )
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write it, with a progress bar on a terminal."""
    import contextlib
    import sys

    from flightlog.errors import UsageError
    from flightlog.logfile import LogReader
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect, expect_text, told_damage
    from groundproc.commands.outputs import claim_file
    from groundproc.commands.values import field_of_view
    from groundproc.flight.belonging import in_order_of_one_flight
    from groundproc.flight.mounting import find_mount
    from groundproc.progress import stages
    from groundproc.ros.bag import write_bag
    from groundproc.sensors.shots import Gate
    from groundproc.steps.trajectory import from_elsewhere
    from groundproc.survey import Survey
    from groundproc.verdict import DOUBTFUL, EXIT_CODES, GOOD

    if arguments.min_range < 0.0:
        raise UsageError(f"--min-range {arguments.min_range:g}: expected 0 or more")
    expect(arguments.logs, LOG, LOG_WORDS)
    expect_text(arguments.mount, "a mount file (YAML)")
    expect([arguments.trajectory], ("poses", "products", "folder"), "a folder of products or a trajectory.csv")
    inputs = [*arguments.logs, *([arguments.trajectory] if arguments.trajectory else [])]
    claim_file(arguments.output, (".mcap",), arguments.force, inputs)
    gate = Gate(*field_of_view(arguments.fov, "--fov"), arguments.min_range)
    with contextlib.ExitStack() as stack:
        readers = in_order_of_one_flight(
            [stack.enter_context(LogReader(path)) for path in arguments.logs], arguments.mount
        )
        mount, source = find_mount(arguments.mount, readers)
        survey = Survey(mount=arguments.mount) if arguments.mount else Survey()
        estimate = from_elsewhere(arguments.trajectory, survey, mount, source) if arguments.trajectory else None
        progress = stack.enter_context(stages(arguments.logs, {"read": "clocks and autopilot", "write": "topics"}))
        written = write_bag(readers, arguments.output, mount, gate, estimate, progress)
    for note in written.notes:
        print(f"swath: warning: {note}", file=sys.stderr)
    for topic, count in written.messages.items():
        print(f"{count:8,} {topic}")
    print(f"{arguments.output}: {sum(written.messages.values()):,} messages, times are {written.scale}")
    damaged = told_damage(arguments.logs)
    return EXIT_CODES[DOUBTFUL if damaged or written.notes else GOOD]
