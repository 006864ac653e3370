"""The command line of `swathd`."""

import argparse
import faulthandler
import sys
from collections.abc import Sequence
from pathlib import Path

from flightlog.errors import SwathError, UsageError
from flightlog.words import clean
from onboard.commands import check, gate, health, install, lidar, parameters, uninstall


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; gives the exit code."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.command(options))
    except SwathError as error:
        print(f"swathd: {clean(str(error))}", file=sys.stderr)
        return error.exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="swathd", description="Records the lidar and the autopilot to a flight log.")
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    parser.set_defaults(command=lambda _: _help(parser))
    commands = parser.add_subparsers(metavar="COMMAND")

    run = commands.add_parser("run", help="record until told to stop")
    _add_config(run)
    run.set_defaults(command=_run)

    sample = commands.add_parser("config", help="print a configuration file with every option and its default")
    sample.set_defaults(command=_sample)

    for command in (health, check, lidar, parameters, install, uninstall, gate):
        name = command.__name__.rpartition(".")[2]
        child = commands.add_parser(name, help=command.HELP, description=command.HELP)
        command.add_arguments(child)
        child.set_defaults(command=command.run)
    return parser


def _help(parser: argparse.ArgumentParser) -> int:
    """What `swathd` alone says."""
    parser.print_help(sys.stderr)
    return UsageError.exit_code


class _Version(argparse.Action):
    """Looked up only when asked for: that takes as long as all the rest of a short command."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from flightlog import __version__

        print(f"swathd {__version__}")
        parser.exit()


def _add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--config", type=Path, default=health.CONFIG, metavar="FILE", help=f"configuration (default {health.CONFIG})"
    )


def _run(options: argparse.Namespace) -> int:
    from onboard import config, daemon, journal

    faulthandler.enable()  # killed by the watchdog, it says where each thread was
    journal.start()
    daemon.run(config.load(options.config), options.config)
    return 0


def _sample(options: argparse.Namespace) -> int:
    from flightlog.config import sample
    from onboard.config import SwathdConfig

    del options
    print(sample(SwathdConfig), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
