"""`swathd uninstall`: undoes `swathd install`."""

import argparse
from pathlib import Path

HELP = "stop the service and take its files away; logs and configuration stay (root)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("--root", type=Path, default=Path("/"), metavar="DIR", help="system to take it from")


def run(options: argparse.Namespace) -> int:
    """Uninstall; says what was done."""
    from onboard import install

    print("\n".join(install.uninstall(options.root.resolve())))
    return 0
