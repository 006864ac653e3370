"""`swathd gate`: what sshd runs for a key of `swath pull`, whatever the client asked for."""

import argparse
import json
import os
from pathlib import Path
from typing import Final

HELP = "the forced command of the SSH key for `swath pull`"
_RRSYNC: Final = "/usr/bin/rrsync"
_CONFIG: Final = Path("/etc/swathd/swathd.yaml")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument(
        "--config", type=Path, default=_CONFIG, metavar="FILE", help=f"configuration (default {_CONFIG})"
    )


def run(options: argparse.Namespace) -> int:
    """Do what SSH_ORIGINAL_COMMAND asks for, if it is allowed."""
    from onboard import config, gate

    wish = gate.wish(os.environ.get("SSH_ORIGINAL_COMMAND", ""))
    if wish.verb == "health":
        from onboard.commands import health

        parser = argparse.ArgumentParser(prog="swathd health")
        health.add_arguments(parser)
        return health.run(parser.parse_args(["--config", str(options.config), *wish.words]))
    directory = Path(config.load(options.config).recorder.directory)
    if wish.verb == "rsync":
        _become_rsync(directory)
    if wish.verb == "ack":
        print(f"{gate.acknowledge(directory, wish.words)} acknowledged")
        return 0
    for line in gate.manifest(directory):
        print(json.dumps(line))
    return 0


def _become_rsync(directory: Path) -> None:
    """Go on as rrsync, which reads the client's command itself and keeps it inside the folder, read-only."""
    from flightlog.errors import SwathError

    try:
        os.execv(_RRSYNC, [_RRSYNC, "-ro", str(directory)])
    except OSError as error:
        raise SwathError(f"{_RRSYNC}: cannot be run ({error.strerror}); apt install rsync") from None
