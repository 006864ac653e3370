"""`swathd check`: tests everything that is needed before a flight; each failure comes with its remedy."""

import argparse
import json
from pathlib import Path

from flightlog.errors import SwathError
from onboard.commands.health import CONFIG
from onboard.health import Level

HELP = "try everything before a flight; exit code 0 good, 1 warning, 2 critical; swathd must not be running"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("--config", type=Path, default=CONFIG, metavar="FILE", help=f"configuration (default {CONFIG})")
    parser.add_argument("--json", action="store_true", help="one object for each thing tried")
    parser.add_argument("--seconds", type=float, default=6.0, help="how long to listen to the devices (default 6)")


def run(options: argparse.Namespace) -> int:
    """Try everything and print what came of it; gives the exit code."""
    import logging

    from onboard import config, preflight

    logging.getLogger().addHandler(logging.NullHandler())  # what there is to say is said below
    try:
        items = preflight.check(config.load(options.config), options.config, max(options.seconds, 3.0))
    except SwathError as error:
        items = [
            preflight.Item("config", Level.CRITICAL, str(error), "correct it; `swathd config` prints every option")
        ]
    worst = max(item.level for item in items)
    if options.json:
        tree = [
            {"name": item.name, "level": item.level.name, "found": item.found, "remedy": item.remedy} for item in items
        ]
        print(json.dumps({"verdict": worst.name, "items": tree}, indent=1))
        return int(worst)
    for item in items:
        print(f"{item.level.name:8} {item.name}: {item.found}")
        if item.remedy:
            print(f"{'':8} -> {item.remedy}")
    return int(worst)
