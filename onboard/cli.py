"""The command line of `swathd`."""

import argparse
import faulthandler
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from flightlog import __version__
from flightlog.errors import SwathError
from onboard.commands import gate, install, lidar, parameters, uninstall

_CONFIG = Path("/etc/swathd/swathd.yaml")
_RUNTIME = Path("/run/swathd")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; gives the exit code."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.command(options))
    except SwathError as error:
        print(f"swathd: {error}", file=sys.stderr)
        return error.exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="swathd", description="Records the lidar and the autopilot to a flight log.")
    parser.add_argument("--version", action="version", version=f"swathd {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="record until told to stop")
    _add_config(run)
    run.set_defaults(command=_run)

    sample = commands.add_parser("config", help="print a configuration file with every option and its default")
    sample.set_defaults(command=_sample)

    health = commands.add_parser("health", help="say how it goes; exit code 0 good, 1 warning, 2 critical")
    _add_config(health)
    health.add_argument("--json", action="store_true", help="the whole status, with the verdict")
    health.set_defaults(command=_health)

    for command in (lidar, parameters, install, uninstall, gate):
        name = command.__name__.rpartition(".")[2]
        child = commands.add_parser(name, help=command.HELP, description=command.HELP)
        command.add_arguments(child)
        child.set_defaults(command=command.run)
    return parser


def _add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--config", type=Path, default=_CONFIG, metavar="FILE", help=f"configuration (default {_CONFIG})"
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


def _health(options: argparse.Namespace) -> int:
    import json

    from onboard import config, health

    # the configuration of the installed service goes with the service's own folder
    folder = str(_RUNTIME) if options.config == _CONFIG and _RUNTIME.is_dir() else None
    path = config.load(options.config).status_path(os.environ.get("RUNTIME_DIRECTORY", folder))
    try:
        text = path.read_text(encoding="utf-8")
        status = health.from_json(text, str(path))
    except (OSError, UnicodeDecodeError, SwathError) as error:
        # not knowing is as bad as it gets, and a monitor reads the exit code
        reason = f"{path}: {error.strerror}; swathd has not run" if isinstance(error, OSError) else str(error)
        print(f"{health.Level.CRITICAL.name}: {reason}")
        return int(health.Level.CRITICAL)
    boot_id = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    now_ns = time.monotonic_ns()
    verdict = health.judge(status, now_ns, boot_id)
    if options.json:
        tree = {
            "verdict": verdict.level.name,
            "findings": verdict.findings,
            "armed": health.armed(status, now_ns, boot_id),
            "status": json.loads(text),
        }
        print(json.dumps(tree, indent=1))
    else:
        print("\n".join(health.report(status, verdict)))
    return int(verdict.level)


if __name__ == "__main__":
    sys.exit(main())
