"""`swath import`: recordings of other programs into a flight log."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from groundproc.flight.importers.ports import Ports

HELP = "make a flight log of captures, an autopilot's logs and bags, or of a line scanner with IMU and positions"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "--pcap", nargs="+", action="extend", default=[], type=Path, metavar="FILE",
        help="captures of the network with the lidar, MAVLink or both (pcap, pcapng), in any order",
    )  # fmt: skip
    parser.add_argument(
        "--mavlink", nargs="+", action="extend", default=[], type=Path, metavar="FILE",
        help="recordings of the autopilot that measures: .tlog, or dataflash .bin",
    )  # fmt: skip
    parser.add_argument(
        "--bag", nargs="+", action="extend", default=[], type=Path, metavar="FILE",
        help="bags of ROS 1 (.bag) or ROS 2 (folder, .db3, .mcap) with packets of the lidar, on any topic",
    )  # fmt: skip
    parser.add_argument(
        "--scans", type=Path, metavar="FILE",
        help="lines of a line scanner, CSV (time_ns, angle_deg, range_m, intensity; a row a shot) or NPZ of such arrays; with --imu "
        "and --positions, in place of recordings",
    )  # fmt: skip
    parser.add_argument(
        "--imu", type=Path, metavar="CSV",
        help="samples of the kit's IMU: time_ns (UTC), gyro_{x,y,z}_rad_s, accel_{x,y,z}_m_s2; right, forward, up",
    )  # fmt: skip
    parser.add_argument(
        "--positions", type=Path, metavar="FILE",
        help="positions of the kit's GNSS antenna (RTKLIB .pos, SBET, NMEA, TUM, KITTI, or a table with utc_ns)",
    )  # fmt: skip
    parser.add_argument("--mount", type=Path, metavar="YAML", help="how the lidar was mounted; goes into the log")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="LOG.mcap", help="the log to write")
    add_force(parser)
    parser.add_argument("--lidar-port", type=int, metavar="N", help="UDP port of the data packets in captures (2368)")
    parser.add_argument(
        "--position-port", type=int, metavar="N", help="UDP port of the position packets in captures (8308)"
    )
    parser.add_argument(
        "--mavlink-port", type=int, nargs="+", action="extend", metavar="N",
        help="UDP ports of MAVLink in captures, at either end (14550, 14555 where no telemetry log is given)",
    )  # fmt: skip
    parser.add_argument(
        "--sender", default="", metavar="ADDRESS",
        help="the lidar's address in captures, or its topic in a bag (default: who sent most packets)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Import and say what was found."""
    from flightlog.errors import UsageError
    from groundproc.commands.outputs import claim_file

    kit = (arguments.scans, arguments.imu, arguments.positions)
    recordings = any((arguments.pcap, arguments.mavlink, arguments.bag))
    if any(kit) == recordings or (any(kit) and not all(kit)):
        if any(kit) and arguments.mavlink:
            raise UsageError("import: --mavlink goes with --pcap; the kit of --scans has an IMU of its own")
        raise UsageError(
            "import: give recordings with --pcap, --mavlink or --bag, or a kit with all of --scans, --imu and --positions"
        )
    _expect(arguments)
    inputs = (*arguments.pcap, *arguments.mavlink, *arguments.bag)
    claim_file(arguments.output, (".mcap",), arguments.force, inputs)
    return _kit(arguments) if all(kit) else _captures(arguments)


def _expect(arguments: argparse.Namespace) -> None:
    """Refuse what is known to be another kind of file than its option takes."""
    from groundproc.commands.inputs import SOLUTION_WORDS, SOLUTIONS, expect, expect_text

    expect(
        arguments.pcap,
        ("capture", "gzip", "archive", "empty", "text", "yaml"),
        "captures of the network (pcap, pcapng)",
    )
    mavlink = ("tlog", "dataflash", "mavlink", "gzip", "empty", "text", "table", "yaml")
    expect(arguments.mavlink, mavlink, "recordings of the autopilot (.tlog, dataflash .bin)")
    expect([arguments.scans], ("scans", "table", "archive", "gzip", "text"), "lines of a line scanner (CSV or NPZ)")
    expect([arguments.imu], ("imu", "table", "gzip", "text"), "samples of an IMU (CSV)")
    expect([arguments.positions], (*SOLUTIONS, "gzip", "table", "text"), SOLUTION_WORDS)
    expect_text(arguments.mount, "a mount file (YAML)")


def _attachments(arguments: argparse.Namespace) -> dict[str, bytes]:
    """What goes into the log as it is."""
    from flightlog.mount import load_mount

    if arguments.mount is None:
        return {}
    load_mount(arguments.mount)
    return {"mount.yaml": arguments.mount.read_bytes()}


def _kit(arguments: argparse.Namespace) -> int:
    """Import a line scanner's kit."""
    from groundproc.flight.importers.kit import import_kit

    found = import_kit(
        arguments.scans,
        arguments.imu,
        arguments.positions,
        arguments.output,
        attachments=_attachments(arguments),
        force=arguments.force,
    )
    print(f"{arguments.output}: {found.lines} lines, {found.imu_samples} IMU samples, {found.positions} positions")
    return 0


def _captures(arguments: argparse.Namespace) -> int:
    """Import recordings of the network, of ground stations, of autopilots and of ROS."""
    from tqdm import tqdm

    from flightlog.words import clean
    from groundproc.flight.importers.flight import Recordings, import_flight

    with tqdm(unit="B", unit_scale=True, desc="import", disable=not sys.stderr.isatty()) as bar:
        result = import_flight(
            Recordings(arguments.pcap, arguments.mavlink, arguments.bag),
            arguments.output,
            ports=_ports(arguments),
            attachments=_attachments(arguments),
            sender=arguments.sender,
            force=arguments.force,
            progress=bar.update,
        )
    for note in result.notes:
        print(f"swath: note: {clean(note)}", file=sys.stderr)
    dataflash = f", {result.dataflash_bytes} bytes of dataflash logs" if result.dataflash_bytes else ""
    print(
        f"{arguments.output}: {result.lidar_packets} lidar and {result.position_packets} position packets, "
        f"{result.mavlink_frames} MAVLink frames{dataflash}"
    )
    return 0


def _ports(arguments: argparse.Namespace) -> "Ports":
    """The ports, and which of them the user stated."""
    from flightlog.errors import UsageError
    from groundproc.flight.importers.ports import Ports

    options = {"lidar": arguments.lidar_port, "position": arguments.position_port, "mavlink": arguments.mavlink_port}
    given = {name: value for name, value in options.items() if value is not None}
    for name, value in given.items():
        for port in value if isinstance(value, list) else [value]:
            if not 0 < port < 1 << 16:
                raise UsageError(f"--{name}-port {port}: is no UDP port, expected 1 to 65535")
    if "mavlink" in given:
        given["mavlink"] = tuple(given["mavlink"])
    return Ports(**given, given=frozenset(given))
