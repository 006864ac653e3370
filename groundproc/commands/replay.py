"""`swath replay`: a flight log played to UDP, for VeloView, drivers, ground stations, or swathd."""

import argparse
import sys
from pathlib import Path

HELP = "send the recorded packets of a log to UDP, in real or scaled time"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="a flight log, or all parts of one flight")
    parser.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="where to, a broadcast address too; default: 127.0.0.1"
    )
    parser.add_argument("--lidar-port", type=_port, default=2368, metavar="PORT", help="default: 2368")
    parser.add_argument("--position-port", type=_port, default=8308, metavar="PORT", help="default: 8308")
    parser.add_argument(
        "--mavlink", metavar="udp:ADDRESS:PORT", help="send the autopilot's bytes there; default: they are not sent"
    )
    parser.add_argument("--link", metavar="NAME", help="which autopilot's, ins or fc; default: ins")
    parser.add_argument("--speed", default="1", metavar="X", help="times real time, or max; default: 1")
    parser.add_argument("--loop", action="store_true", help="again and again, until interrupted")


def _port(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a port of 1 to 65535")
    return int(text)


def run(arguments: argparse.Namespace) -> int:
    """Play, with a progress bar on a terminal."""
    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect
    from groundproc.field.replay import Destination, Replayed, parse_mavlink, parse_speed, replay

    if arguments.link is not None and arguments.mavlink is None:
        raise UsageError(f"--link {arguments.link} given, but nothing uses it without --mavlink")
    to = Destination(
        arguments.host,
        arguments.lidar_port,
        arguments.position_port,
        None if arguments.mavlink is None else parse_mavlink(arguments.mavlink),
        arguments.link or "ins",
    )
    speed = parse_speed(arguments.speed)
    expect(arguments.logs, LOG, LOG_WORDS)

    def once() -> Replayed:
        with tqdm(unit="s", leave=False, disable=not sys.stderr.isatty()) as bar:
            return replay(arguments.logs, to, speed, lambda seconds: bar.update(round(seconds, 1)))

    while True:
        played = once()
        print(
            f"{played.data_packets:,} data packets, {played.position_packets:,} position packets, "
            f"{played.mavlink_chunks:,} pieces of MAVLink sent; at worst {played.worst_late_s * 1e3:.0f} ms late"
            + (f"; {played.pauses_cut} pauses of more than 10 s cut out" if played.pauses_cut else "")
        )
        if not arguments.loop:
            return 0
