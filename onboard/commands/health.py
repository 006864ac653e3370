"""`swathd health`: the verdict on the status file. It is run over SSH, so it loads nothing that takes time."""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Final

from flightlog.errors import SwathError
from flightlog.words import clean
from onboard import health, healthreport
from onboard.health import Level
from onboard.status import from_json

HELP = "say how it goes; exit code 0 good, 1 warning, 2 critical"

CONFIG: Final = Path("/etc/swathd/swathd.yaml")
_RUNTIME: Final = Path("/run/swathd")
_WATCH_S: Final = 1.0
_CLEAR: Final = "\x1b[H\x1b[J"
"""Cursor home, erase what follows (ECMA-48)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("--config", type=Path, default=CONFIG, metavar="FILE", help=f"configuration (default {CONFIG})")
    parser.add_argument("--json", action="store_true", help="the whole status, with the verdict")
    parser.add_argument("--watch", action="store_true", help="again every second, until interrupted")


def run(options: argparse.Namespace) -> int:
    """Print the health; gives the exit code, with --watch that of the last look."""
    path = status_path(options.config)
    level, text = look(path, as_json=options.json)
    if not options.watch:
        print(text)
        return int(level)
    try:
        while True:
            print(text if options.json else _CLEAR + text, flush=True)
            time.sleep(_WATCH_S)
            level, text = look(path, as_json=options.json)
    except KeyboardInterrupt:
        return int(level)


def status_path(config_path: Path) -> Path:
    """Where the swathd of a configuration leaves its status."""
    from onboard import config

    # the configuration of the installed service goes with the service's own folder
    folder = str(_RUNTIME) if config_path == CONFIG and _RUNTIME.is_dir() else None
    return config.load(config_path).status_path(os.environ.get("RUNTIME_DIRECTORY", folder))


def is_alive(pid: int) -> bool:
    """Whether a process is there, whoever it belongs to."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def look(path: Path, *, as_json: bool) -> tuple[Level, str]:
    """The verdict on a status file, and the text that tells it."""
    try:
        content = path.read_text(encoding="utf-8")
        status = from_json(content, str(path))
    except (OSError, UnicodeDecodeError, SwathError) as error:
        # an unknown state counts as critical, and a monitor reads the exit code
        reason = f"{path}: {error.strerror}; swathd has not run" if isinstance(error, OSError) else str(error)
        if as_json:
            return Level.CRITICAL, json.dumps(
                health.told(health.Verdict(Level.CRITICAL, [reason]), None, None), indent=1
            )
        return Level.CRITICAL, clean(f"{Level.CRITICAL.name}: {reason}")
    boot_id = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    now_ns = time.monotonic_ns()
    verdict = health.judge(status, now_ns, boot_id)
    if status.boot_id == boot_id and not is_alive(status.pid):
        ended = f"swathd (process {status.pid}) has ended; what follows is its last status"
        verdict = health.Verdict(Level.CRITICAL, [ended, *verdict.findings])
    if not as_json:
        return verdict.level, "\n".join(map(clean, healthreport.report(status, verdict)))
    is_armed = health.armed(status, now_ns, boot_id)
    return verdict.level, json.dumps(health.told(verdict, is_armed, json.loads(content)), indent=1)
