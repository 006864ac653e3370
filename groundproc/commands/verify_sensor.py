"""`swath verify-sensor`: ranges, intensities and detection of a lidar against panels of known reflectance."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from groundproc.verification.measure import Row
    from groundproc.verification.work import Verified

HELP = "judge a lidar by reference panels: scatter of ranges, intensity, detection, mixed echoes, laser by laser"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="a log of the sensor on a tripod")
    parser.add_argument(
        "--panels",
        type=Path,
        required=True,
        metavar="P.yaml",
        help="where which panels stand, and the data sheet's promises",
    )
    parser.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="write the figures against the distance as a picture"
    )
    parser.add_argument("--lasers", action="store_true", help="print a line for each laser too")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure, print a table, and judge."""
    from groundproc.commands.figures import claim_json, warn, write_json
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect, expect_text, told_damage
    from groundproc.commands.outputs import claim_file
    from groundproc.progress import stages
    from groundproc.verdict import EXIT_CODES
    from groundproc.verification.work import Task, verify

    expect(arguments.logs, LOG, LOG_WORDS)
    expect_text(arguments.panels, "a list of panels (YAML)")
    if arguments.plot is not None:
        claim_file(arguments.plot, (".png",), arguments.force)
    claim_json(arguments)
    with stages(arguments.logs, {"verify": "shots"}) as progress:
        found = verify(Task(arguments.logs, arguments.panels, arguments.plot), lambda done: progress("verify", done))
    told_damage(arguments.logs)
    write_json(arguments, found.figures())
    warn(found.warnings, sys.stderr)
    _table(found, arguments.lasers)
    broken = found.judged.broken
    for each in broken[:20]:
        print(f"swath: {each.sentence}", file=sys.stderr)
    if len(broken) > 20:
        print(f"swath: and {len(broken) - 20} more", file=sys.stderr)
    if not found.judged.checks:
        print(
            "swath: no promise could be judged: expected a panel at --panels' place with echoes, of the brightness and distance that the "
            "sheet promises for",
            file=sys.stderr,
        )
    print(f"{found.sensor}: {len(found.judged.checks) - len(broken)} of {len(found.judged.checks)} promises kept")
    return EXIT_CODES[found.judged.grade]


def _table(found: Verified, lasers: bool) -> None:
    head = ("panel", "shots", "detected", "range [m]", "off [mm]", "sigma [mm]", "intensity", "mixed")
    print(f"{head[0]:<24}" + "".join(f"{name:>12}" for name in head[1:]))
    for each in found.measured:
        whole = each.whole
        mixed = f"{each.mixed}/{each.rim}"
        print(f"{each.panel.title:<24}{_cells(whole, each.distance_m)}{mixed:>12}")
        for row in each.lasers if lasers else ():
            print(f"{f'  laser {row.laser}':<24}{_cells(row, float('nan'))}")


def _cells(row: Row, distance_m: float) -> str:
    import math

    def number(value: float, digits: int) -> str:
        return "-" if not math.isfinite(value) else f"{value:.{digits}f}"

    cells = [
        str(row.shots), "-" if not row.shots else f"{row.detected:.1%}", number(distance_m, 3), number(1e3 * row.off_m, 1),
        number(1e3 * row.sigma_m, 1), number(row.intensity, 1),
    ]  # fmt: skip
    return "".join(f"{cell:>12}" for cell in cells)
