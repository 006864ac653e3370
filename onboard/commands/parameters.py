"""`swathd parameters`: the autopilot's parameters against firmware_config."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from onboard.parameter_link import ParameterLink
    from onboard.parameters import Parameter

HELP = "show an autopilot's parameters against those wanted, or set them; swathd must not be running on its device"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("action", choices=("show", "apply"), help="compare only, or set and verify")
    parser.add_argument(
        "--device", required=True, metavar="DEVICE", help="serial device, or udp:ADDRESS:PORT to listen on"
    )
    parser.add_argument("--baud", type=int, default=57600, help="of a serial device (default 57600)")
    parser.add_argument("--board", choices=("ins", "fc"), default="ins", help="which board it is (default ins)")
    parser.add_argument(
        "--file", type=Path, action="append", metavar="FILE",
        help="parameters wanted; may be given again, the later file wins (default: of firmware_config, by board and firmware)",
    )  # fmt: skip
    parser.add_argument(
        "--all", action="store_true", help="with show: print every parameter as NAME,VALUE and compare nothing"
    )
    parser.add_argument("--yes", action="store_true", help="apply without asking")


def run(options: argparse.Namespace) -> int:
    """Compare, and apply if asked to; 0 when all is as wanted, else 1."""
    from onboard.config import LinkConfig
    from onboard.parameter_link import ParameterLink

    files = _files(options.file)
    with ParameterLink(LinkConfig(options.device, options.baud)) as link:
        link.find_autopilot()
        if options.all and options.action == "show":
            for name, value in link.read_all().items():
                print(f"{name},{value:.9g}")
            if link.counts.bad_names:
                print(
                    f"swathd: {link.counts.bad_names} parameters with names that are none were left out",
                    file=sys.stderr,
                )
            return 0
        return _compare(options, link, files)


def _compare(options: argparse.Namespace, link: "ParameterLink", files: "dict[str, Parameter] | None") -> int:
    from onboard.commands.agree import agreed
    from onboard.parameters import GENERATION_MARKS, compare, generation, shipped

    wanted = shipped(options.board, generation(link.read(GENERATION_MARKS))) if files is None else files
    differences = compare(wanted, link.read(wanted))
    print("\n".join(map(str, differences)) or f"all {len(wanted)} parameters are as wanted")
    settable = [difference for difference in differences if difference.found is not None]
    if not settable or options.action == "show":
        return int(bool(differences))
    link.refuse_if_armed()
    if not agreed(f"set {len(settable)} parameters", options.yes):
        return 1
    link.apply(settable, lambda difference: print(f"{difference.name} is {difference.wanted:.7g} now"))
    print(f"{len(settable)} parameters set and read back; some hold only after a restart of the autopilot")
    return int(len(settable) < len(differences))


def _files(paths: "list[Path] | None") -> "dict[str, Parameter] | None":
    from onboard.parameters import load

    if paths is None:
        return None
    wanted: dict[str, Parameter] = {}
    for path in paths:
        wanted |= load(path)
    return wanted
