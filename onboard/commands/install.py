"""`swathd install`: the service and all it needs of the system."""

import argparse
from pathlib import Path

HELP = "put the service in place and start it (root)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("--lidar-interface", metavar="NAME", help="network port of the lidar, to be set up for it")
    parser.add_argument("--no-start", action="store_true", help="start with the next boot, not now")
    parser.add_argument("--root", type=Path, default=Path("/"), metavar="DIR", help="system to install into")
    parser.add_argument("--program", type=Path, metavar="FILE", help="swathd in that system (default: this one)")


def run(options: argparse.Namespace) -> int:
    """Install; says what was done."""
    from onboard import install

    if install.packaged():
        print("\n".join(install.set_up_network(options.root.resolve(), options.lidar_interface)))
        return 0
    place = install.Place(options.root.resolve(), install.find_program(options.program))
    print("\n".join(install.install(place, options.lidar_interface, start=not options.no_start)))
    return 0
