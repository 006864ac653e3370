"""`swath live`: the flight as it happens; pose, cloud and page while the packets come."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

    from flightlog.mount import Mount
    from groundproc.live.inbox import Inbox
    from groundproc.live.server import PageServer
    from groundproc.live.session import Session, Source, Summary

HELP = "trajectory and cloud while the flight goes on, from the network or a growing log, with a page for the browser"

DEFAULT_PORT = 8080


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.options import add_settings
    from groundproc.commands.outputs import add_force
    from groundproc.survey import ClockSettings, MountSettings, PlacingSettings

    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of what stays")
    add_force(parser)
    parser.add_argument("--mavlink", metavar="FROM",
                        help="udp:ADDRESS:PORT to listen on, tcp:HOST:PORT to connect to, or a serial device; "
                        "default: udp:0.0.0.0:14550")  # fmt: skip
    parser.add_argument("--baud", type=int, metavar="N", help="of a serial device; default: 57600")
    parser.add_argument("--address", help="where to listen for the lidar; default: 0.0.0.0")
    parser.add_argument("--lidar-port", type=_port, metavar="PORT", help="default: 2368")
    parser.add_argument("--position-port", type=_port, metavar="PORT", help="default: 8308")
    parser.add_argument("--follow", type=Path, metavar="LOG", help="a flight log that grows, in place of the network")
    parser.add_argument("--link", choices=("ins", "fc"), help="which autopilot's, with --follow; default: ins")
    add_settings(parser, [MountSettings], only=("mount",))
    parser.add_argument("--height", choices=("msl", "relative"), default="msl", help="of the positions; default: msl")
    add_settings(parser, [ClockSettings], only=("gyro_delay_ms",))
    add_settings(parser, [PlacingSettings], only=("fov_deg",))
    parser.add_argument("--voxel", type=_metres, default=0.15, metavar="M", help="of the thinned cloud; default: 0.15")
    parser.add_argument("--points", type=int, default=2_000_000, metavar="N",
                        help="at most so many points, then the voxels grow; default: 2000000")  # fmt: skip
    parser.add_argument("--port", type=int, metavar="PORT",
                        help=f"of the page on this machine, 0 for none; default: {DEFAULT_PORT} where it is free")  # fmt: skip
    parser.add_argument("--duration", type=float, metavar="S", help="end after so many seconds; default: when told to")
    parser.add_argument("--idle", type=float, metavar="S", help="end when the lidar has been silent for so long")
    parser.add_argument("--json", action="store_true", help="the status as a line of JSON every second")


def _port(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a port of 1 to 65535")
    return int(text)


def _metres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.01 <= value <= 10.0:
        raise argparse.ArgumentTypeError(f"{text!r}: expected 0.01 to 10 m")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Work until SIGINT or SIGTERM, and leave everything whole."""
    from flightlog.errors import UsageError
    from flightlog.stopflag import StopFlag
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect, expect_text
    from groundproc.commands.outputs import claim_folder
    from groundproc.files import made_folder
    from groundproc.live.inbox import Inbox
    from groundproc.live.products import LiveTrajectory
    from groundproc.live.session import Session
    from groundproc.live.voxelcloud import VoxelCloud
    from groundproc.live.warmup import warm_up
    from groundproc.progress import compiling

    for name, least in (("points", 10_000), ("port", 0), ("duration", 0), ("idle", 0)):
        value = getattr(arguments, name)
        if value is not None and not value >= least:
            raise UsageError(f"--{name} {value}: expected {least} or more")
    _refuse_unused(arguments)
    expect([arguments.follow], (*LOG, "empty"), LOG_WORDS)  # one that is yet to be written into may be empty
    expect_text(arguments.mount, "a mount file (YAML)")
    claim_folder(arguments.output, ("trajectory_live.csv", "cloud_live.laz"), arguments.force)
    over = StopFlag()

    def end(number: int, frame: FrameType | None) -> None:
        over.set()

    options = _options(arguments)
    inbox = Inbox(waits=arguments.follow is not None)
    folder: Path = arguments.output
    with made_folder(folder):
        source = _source(arguments, inbox)
        try:
            with LiveTrajectory(folder / "trajectory_live.csv") as trajectory:
                session = Session(options, inbox, source, VoxelCloud(arguments.voxel, arguments.points), trajectory)
                page = _page(session, arguments.port)
                before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
                timer = threading.Timer(arguments.duration or 0.0, over.set)
                timer.daemon = True
                try:
                    with compiling(_say_once()):
                        warm_up()
                    source.start()
                    print(
                        "listening" if arguments.follow is None else f"following {arguments.follow}",
                        file=sys.stderr,
                        flush=True,
                    )
                    if arguments.duration:
                        timer.start()
                    summary = session.run(over.is_set, _teller(arguments.json), arguments.idle)
                finally:
                    timer.cancel()
                    if page is not None:
                        page.close()
                    source.close()
                    points = session.save_cloud(folder / "cloud_live.laz")
                    for number, handler in before.items():
                        signal.signal(number, handler)
        finally:
            source.close()
    print(
        _report(summary, points, folder, arguments.follow is not None),
        file=sys.stderr if arguments.json else sys.stdout,
    )
    return 0


def _say_once() -> Callable[[bool], None]:
    """Says, once, that the start waits for the compiler."""
    said = False

    def say(begins: bool) -> None:
        nonlocal said
        if begins and not said:
            print("compiling (first use; swath warmup does it beforehand)", file=sys.stderr, flush=True)
        said = True

    return say


def _options(arguments: argparse.Namespace) -> Any:
    from flightlog.constants import NS_PER_MS
    from groundproc.commands.options import chosen_settings
    from groundproc.live.estimator import Options
    from groundproc.sensors.shots import Gate
    from groundproc.survey import ClockSettings, PlacingSettings

    chosen = chosen_settings(arguments, PlacingSettings)
    patience_ns = 400_000_000 if arguments.follow is None else 2_000_000_000
    delay_ns = round(chosen_settings(arguments, ClockSettings).gyro_delay_ms * NS_PER_MS)
    gate = Gate(*chosen.fov_deg, chosen.min_range_m, chosen.max_range_m)
    return Options(_mount(arguments), arguments.height, gate, patience_ns, delay_ns)


def _mount(arguments: argparse.Namespace) -> Mount:
    from flightlog.logfile import LogReader
    from groundproc.flight.mounting import find_mount

    if arguments.follow is None:
        return find_mount(arguments.mount, [])[0]
    with LogReader(arguments.follow) as reader:
        return find_mount(arguments.mount, [reader])[0]


def _source(arguments: argparse.Namespace, inbox: Inbox) -> Source:
    if arguments.follow is not None:
        from groundproc.live.following import Follower

        return Follower(inbox, arguments.follow, arguments.link or "ins")
    from groundproc.live.receivers import Receivers

    return Receivers(
        inbox,
        arguments.address or "0.0.0.0",
        arguments.lidar_port or 2368,
        arguments.position_port or 8308,
        arguments.mavlink or "udp:0.0.0.0:14550",
        arguments.baud or 57600,
    )


def _refuse_unused(arguments: argparse.Namespace) -> None:
    """Refuse options that the chosen source would not look at."""
    from flightlog.errors import UsageError

    if arguments.follow is None:
        unused, why = ["link"], "it chooses a link of the log of --follow"
    else:
        unused, why = (
            ["mavlink", "baud", "address", "lidar_port", "position_port"],
            "--follow reads a log, not the network",
        )
    for name in unused:
        if getattr(arguments, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} {getattr(arguments, name)} given, but nothing uses it: {why}")
    if arguments.baud is not None and (arguments.mavlink is None or arguments.mavlink.startswith(("udp:", "tcp:"))):
        raise UsageError(f"--baud {arguments.baud} given, but nothing uses it: --mavlink names no serial device")


def _page(session: Session, port: int | None) -> PageServer | None:
    """The page, where a port is to be had; a port that was asked for must be."""
    from flightlog.errors import SourceError
    from groundproc.live.server import PageServer

    if port == 0:
        return None
    try:
        page = PageServer(session, DEFAULT_PORT if port is None else port)
    except SourceError as error:
        if port is not None:
            raise
        print(f"{error}; no page then, --port names another", file=sys.stderr)
        return None
    print(f"look at http://127.0.0.1:{page.port}/", file=sys.stderr, flush=True)
    return page


def _teller(as_json: bool) -> Any:
    if as_json:
        return lambda status: print(json.dumps(status), flush=True)
    terminal = sys.stderr.isatty()

    def tell(status: dict[str, Any]) -> None:
        text = status_line(status)
        print(f"\r{text}\x1b[K" if terminal else text, end="" if terminal else "\n", file=sys.stderr, flush=True)

    return tell


def status_line(status: dict[str, Any]) -> str:
    """The status in one line."""
    parts = [status["state"]]
    pose, drops = status["pose"], status["drops"]
    if pose is not None:
        east, north, up = pose["local_m"]
        residual = "-" if pose["residual_m"] is None else f"{pose['residual_m'] * 100:.1f} cm"
        parts += [
            f"{pose['speed_m_s']:.1f} m/s",
            f"{east:+.1f} {north:+.1f} {up:+.1f} m",
            f"sigma {max(pose['sigma_m']):.1f} m",
            f"matched {pose['matched']}/{pose['seen']} to {residual}",
            f"{status['lag_s']:.2f} s behind",
        ]
    if status["sync"] is not None:
        parts.append(f"clocks by {status['sync']['method']} to {status['sync']['sigma_ms']:.1f} ms")
    parts.append(f"{status['cloud']['points']:,} points")
    lost = {name: number for name, number in drops.items() if number}
    parts += [f"lost: {', '.join(f'{name} {number}' for name, number in lost.items())}"] if lost else []
    parts += [status["trouble"]] if status["trouble"] else []
    return "; ".join(parts)


def _report(summary: Summary, points: int, folder: Path, follows: bool) -> str:
    if not summary.places:
        return f"no pose in {summary.seconds:.0f} s: {summary.status['state']}"
    late = "" if follows else f", at worst {summary.worst_lag_s:.2f} s behind"
    return (
        f"\n{summary.places / 10:.1f} s of flight in {folder / 'trajectory_live.csv'}{late}; "
        f"{points:,} points in {folder / 'cloud_live.laz'}"
    )
