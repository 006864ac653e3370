"""`swath import`: recordings of other programs into a flight log."""

import argparse
import sys
from pathlib import Path

HELP = "make a flight log of pcap captures and of an autopilot's telemetry or dataflash log"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument(
        "--pcap", nargs="+", action="extend", required=True, type=Path, metavar="FILE",
        help="captures of the lidar (pcap, pcapng), in any order",
    )  # fmt: skip
    parser.add_argument(
        "--mavlink", nargs="+", action="extend", default=[], type=Path, metavar="FILE",
        help="recordings of the autopilot that measures: .tlog, or dataflash .bin",
    )  # fmt: skip
    parser.add_argument("--mount", type=Path, metavar="YAML", help="how the lidar was mounted; goes into the log")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="LOG.mcap", help="the log to write")
    parser.add_argument("--force", action="store_true", help="replace the output where it exists")
    parser.add_argument("--lidar-port", type=int, default=2368, metavar="N", help="UDP port of the data packets")
    parser.add_argument("--position-port", type=int, default=8308, metavar="N", help="UDP port of the position packets")


def run(arguments: argparse.Namespace) -> int:
    """Import and say what was found."""
    from tqdm import tqdm

    from flightlog.mount import load_mount
    from groundproc.flight.importers.flight import import_flight
    from groundproc.flight.importers.sources import Ports

    attachments = {}
    if arguments.mount is not None:
        load_mount(arguments.mount)
        attachments["mount.yaml"] = arguments.mount.read_bytes()
    with tqdm(unit="B", unit_scale=True, desc="import", disable=not sys.stderr.isatty()) as bar:
        result = import_flight(
            arguments.pcap,
            arguments.mavlink,
            arguments.output,
            ports=Ports(arguments.lidar_port, arguments.position_port),
            attachments=attachments,
            force=arguments.force,
            progress=bar.update,
        )
    for note in result.notes:
        print(f"swath: note: {note}", file=sys.stderr)
    print(
        f"{arguments.output}: {result.lidar_packets} lidar and {result.position_packets} position packets, "
        f"{result.mavlink_frames} MAVLink frames"
    )
    return 0
