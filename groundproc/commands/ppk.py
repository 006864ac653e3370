"""`swath ppk`: a rover's raw observations solved against a base station, by RTKLIB."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

HELP = "solve raw GNSS observations against a base station (RTKLIB): centimetres instead of metres"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "rover", type=Path, metavar="ROVER", help="raw observations aboard: u-blox .ubx, or RINEX 2 or 3 (.gz too)"
    )
    parser.add_argument("--base", type=Path, required=True, metavar="FILE", help="those of the base station, likewise")
    parser.add_argument(
        "--nav", type=Path, nargs="+", default=[], metavar="FILE", help="RINEX navigation; default: what a .ubx holds"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT.pos", help="the solution, as RTKLIB writes them"
    )
    add_force(parser)
    parser.add_argument(
        "--base-position",
        metavar="LAT,LON,HEIGHT",
        help="of the base's antenna: degrees, and metres above the ellipsoid; default: the header of its RINEX file",
    )
    parser.add_argument(
        "--base-average", action="store_true", help="the mean of the base's own code positions instead; off by metres"
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="options as YAML; --show-config lists them")
    parser.add_argument("--show-config", action=_ShowConfig, help="print every option with its default and exit")
    parser.add_argument("--direction", choices=("combined", "forward", "backward"), help="default: combined")
    parser.add_argument(
        "--ambiguities", choices=("continuous", "fix-and-hold", "instantaneous", "off"), help="default: continuous"
    )
    parser.add_argument("--frequencies", type=int, choices=(1, 2, 3), help="default: 1")
    parser.add_argument("--elevation-mask", type=float, metavar="DEG", help="default: 15")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")


class _ShowConfig(argparse.Action):
    """Prints the options; the other arguments are not needed for it."""

    def __init__(self, **named: Any) -> None:
        super().__init__(**(named | {"nargs": 0}))

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from flightlog import config
        from groundproc.flight.positions.ppkoptions import PpkOptions

        print(config.dump(PpkOptions()), end="")
        parser.exit()


def run(arguments: argparse.Namespace) -> int:
    """Solve, write, and say how good it is."""
    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.commands.inputs import expect, expect_text
    from groundproc.commands.outputs import claim_file
    from groundproc.flight.positions.ppk import process
    from groundproc.flight.positions.ppkoptions import Base, base_position

    if arguments.base_position is not None and arguments.base_average:
        raise UsageError("--base-position and --base-average: one of the two")
    where = Base(
        None if arguments.base_position is None else base_position(arguments.base_position), arguments.base_average
    )
    observations = ("observations", "gzip", "navigation")  # what is within, RTKLIB's front end says
    expect([arguments.rover, arguments.base], observations, "raw observations (u-blox .ubx, RINEX)")
    expect(arguments.nav, observations, "RINEX navigation files")
    expect_text(arguments.config, "options as YAML")
    claim_file(arguments.output, (".pos",), arguments.force, (arguments.rover, arguments.base, *arguments.nav))
    hidden = not sys.stderr.isatty()
    with tqdm(
        total=1.0, leave=False, disable=hidden, bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}", desc="RTKLIB"
    ) as bar:

        def advance(share: float) -> None:
            bar.update(share)

        done = process(
            arguments.rover, arguments.base, arguments.nav, arguments.output, where, _options(arguments), advance
        )
    print(json.dumps(done.summary, indent=2) if arguments.json else _text(arguments.output, done.summary))
    return 0


def _options(arguments: argparse.Namespace) -> Any:
    """The options of the file with those of the command line before them."""
    from flightlog import config
    from groundproc.flight.positions.ppkoptions import PpkOptions

    options = config.load(arguments.config, PpkOptions) if arguments.config else PpkOptions()
    named = {
        "direction": arguments.direction,
        "ambiguities": arguments.ambiguities,
        "frequencies": arguments.frequencies,
        "elevation_mask_deg": arguments.elevation_mask,
    }
    given = {name: value for name, value in named.items() if value is not None}
    tree = {name: getattr(options, name) for name in options.__dataclass_fields__} | given
    return config.from_mapping(tree, PpkOptions, "command line")


def _text(output: Path, summary: dict[str, Any]) -> str:
    """The summary for people."""
    kinds = ", ".join(
        f"{share:.1%} {name} (sigma {summary['sigma_m'][name]['horizontal']:.3f} m horizontal, "
        f"{summary['sigma_m'][name]['vertical']:.3f} m vertical)"
        for name, share in summary["quality"].items()
    )
    baseline, directions = summary["baseline_m"], summary["directions"]
    epochs = f"{summary['rover_epochs']:,} epochs in {summary['seconds']:.0f} s; {summary['lost_epochs']:,} without one"
    lengths = f"{baseline['median']:.0f} m ({baseline['shortest']:.0f} to {baseline['longest']:.0f} m)"
    lines = [
        f"{output}: {summary['positions']:,} positions of {epochs}",
        f"  {kinds}",
        f"  baseline {lengths}; base position: {summary['base']['source']}",
    ]
    if any(directions.values()):
        lines.append(
            f"  forward and backward: {directions['agreed']:,} fixes agree, {directions['contradicted']:,} contradict, "
            f"{directions['unsupported']:,} too short to be believed"
        )
    return "\n".join([*lines, *(f"  note: {note}" for note in summary["notes"])])
