"""`swath pull`: the flight logs of an aircraft, brought here, verified and acknowledged."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from groundproc.field.pull import Vehicle

HELP = "bring the flight logs of an aircraft here, verified"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument(
        "host", metavar="USER@HOST", help="the aircraft's computer; the user that install made is swath"
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path(), metavar="DIR", help="folder for the logs (default: this one)"
    )
    parser.add_argument("--port", type=int, metavar="N", help="of its SSH server")
    parser.add_argument("--identity", type=Path, metavar="FILE", help="the key")
    parser.add_argument("--ssh-config", type=Path, metavar="FILE", help="configuration for ssh")
    parser.add_argument(
        "--anyway", action="store_true", help="go on where it is not known whether the aircraft is armed"
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="list what is there and what would be brought; do nothing"
    )


def run(arguments: argparse.Namespace) -> int:
    """Pull; 0 when every closed segment is here and right, else 1."""
    import shutil

    from flightlog.errors import SourceError
    from groundproc.field.pull import Vehicle, pull
    from groundproc.machine import system

    missing = [name for name in ("ssh", "rsync") if shutil.which(name) is None]
    if missing or not system.LIMITED:
        why = f"{' and '.join(missing)} not found" if missing else "this system cannot give them limits"
        raise SourceError(
            f"pull: needs ssh and rsync on a Linux or macOS system, and {why}; install them (Debian: openssh-client, rsync), "
            "on Windows within WSL"
        )
    vehicle = Vehicle(arguments.host, arguments.port, arguments.identity, arguments.ssh_config)
    if arguments.dry_run:
        return _list(vehicle, arguments.output)

    def say(sentence: str) -> None:
        print(sentence, file=sys.stderr)

    arguments.output.mkdir(parents=True, exist_ok=True)
    # rsync shows its progress on standard output: into a file it would be noise, and held to the limit for files
    quiet = not (sys.stdout.isatty() and sys.stderr.isatty())
    outcome = pull(vehicle, arguments.output, say, anyway=arguments.anyway, quiet=quiet)
    for segment in outcome.brought:
        print(arguments.output / segment.name)
    for trouble in outcome.troubles:
        say(f"swath: {trouble}")
    size_mb = sum(segment.size for segment in outcome.brought) / 1e6
    say(
        f"{len(outcome.brought)} brought ({size_mb:.1f} MB), {len(outcome.here)} here already, "
        f"{outcome.acknowledged} newly acknowledged, {len(outcome.troubles)} failed"
    )
    return int(bool(outcome.troubles))


def _list(vehicle: "Vehicle", folder: Path) -> int:
    """What is on the aircraft, and whether it is here already; asks for its manifest, and for nothing else."""
    from groundproc.field.pull import segments
    from groundproc.machine import screen

    there = segments(vehicle)
    here = {
        each.name
        for each in there
        if (folder / each.name).is_file() and (folder / each.name).stat().st_size == each.size
    }
    screen.table(
        ["log", "MB", "state"],
        [[each.name, f"{each.size / 1e6:.1f}", "here" if each.name in here else "to bring"] for each in there],
    )
    wanted = [each for each in there if each.name not in here]
    print(f"{len(wanted)} to bring ({sum(each.size for each in wanted) / 1e6:.1f} MB), {len(here)} here already")
    return 0
