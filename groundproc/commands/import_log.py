"""`swath import`: recordings of other programs into a flight log."""

import argparse
import sys
from pathlib import Path

HELP = "make a flight log of pcap captures and an autopilot's logs, or of a line scanner with IMU and positions"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument(
        "--pcap", nargs="+", action="extend", default=[], type=Path, metavar="FILE",
        help="captures of the lidar (pcap, pcapng), in any order",
    )  # fmt: skip
    parser.add_argument(
        "--mavlink", nargs="+", action="extend", default=[], type=Path, metavar="FILE",
        help="recordings of the autopilot that measures: .tlog, or dataflash .bin",
    )  # fmt: skip
    parser.add_argument(
        "--scans", type=Path, metavar="FILE",
        help="lines of a line scanner, CSV (time_ns, angle_deg, range_m, intensity; a row a shot) or NPZ of such arrays; with --imu "
        "and --positions, in place of --pcap",
    )  # fmt: skip
    parser.add_argument(
        "--imu", type=Path, metavar="CSV",
        help="samples of the kit's IMU: time_ns (UTC), gyro_{x,y,z}_rad_s, accel_{x,y,z}_m_s2; right, forward, up",
    )  # fmt: skip
    parser.add_argument(
        "--positions", type=Path, metavar="FILE",
        help="positions of the kit's GNSS antenna (RTKLIB .pos, SBET, NMEA, or a table with utc_ns)",
    )  # fmt: skip
    parser.add_argument("--mount", type=Path, metavar="YAML", help="how the lidar was mounted; goes into the log")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="LOG.mcap", help="the log to write")
    parser.add_argument("--force", action="store_true", help="replace the output where it exists")
    parser.add_argument("--lidar-port", type=int, default=2368, metavar="N", help="UDP port of the data packets")
    parser.add_argument("--position-port", type=int, default=8308, metavar="N", help="UDP port of the position packets")


def run(arguments: argparse.Namespace) -> int:
    """Import and say what was found."""
    from flightlog.errors import UsageError

    kit = (arguments.scans, arguments.imu, arguments.positions)
    if any(kit) == bool(arguments.pcap) or (any(kit) and not all(kit)):
        raise UsageError("import: give --pcap, or all of --scans, --imu and --positions")
    return _kit(arguments) if all(kit) else _captures(arguments)


def _attachments(arguments: argparse.Namespace) -> dict[str, bytes]:
    """What goes into the log as it is."""
    from flightlog.mount import load_mount

    if arguments.mount is None:
        return {}
    load_mount(arguments.mount)
    return {"mount.yaml": arguments.mount.read_bytes()}


def _kit(arguments: argparse.Namespace) -> int:
    """Import a line scanner's kit."""
    from flightlog.errors import UsageError
    from groundproc.flight.importers.kit import import_kit

    if arguments.mavlink:
        raise UsageError("import: --mavlink goes with --pcap; the kit of --scans has an IMU of its own")
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
    """Import captures of the network."""
    from tqdm import tqdm

    from flightlog.words import clean
    from groundproc.flight.importers.flight import import_flight
    from groundproc.flight.importers.sources import Ports

    with tqdm(unit="B", unit_scale=True, desc="import", disable=not sys.stderr.isatty()) as bar:
        result = import_flight(
            arguments.pcap,
            arguments.mavlink,
            arguments.output,
            ports=Ports(arguments.lidar_port, arguments.position_port),
            attachments=_attachments(arguments),
            force=arguments.force,
            progress=bar.update,
        )
    for note in result.notes:
        print(f"swath: note: {clean(note)}", file=sys.stderr)
    print(
        f"{arguments.output}: {result.lidar_packets} lidar and {result.position_packets} position packets, "
        f"{result.mavlink_frames} MAVLink frames"
    )
    return 0
