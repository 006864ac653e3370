"""`swath init`: a commented survey.yaml for a flight, to be edited."""

import argparse
import sys
from pathlib import Path

HELP = "write a commented survey.yaml with what a log tells: mount, clocks, method, CRS"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="a flight log, or all parts of one flight")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: to the terminal")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read the log but for its points, and write."""
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect, told_damage
    from groundproc.commands.outputs import claim_file
    from groundproc.files import written_aside
    from groundproc.progress import stages
    from groundproc.steps.facts import facts
    from groundproc.survey import sample

    path: Path | None = arguments.output
    if path is not None:
        claim_file(path, (".yaml", ".yml"), arguments.force, arguments.logs)
    expect(arguments.logs, LOG, LOG_WORDS)
    with stages(arguments.logs, {"read": "clocks and autopilot"}) as progress:
        survey, notes, head = facts(arguments.logs, progress)
    told_damage(arguments.logs)
    text = sample(survey, notes, head)
    if path is None:
        print(text, end="")
        return 0
    with written_aside(path) as aside:
        aside.write_text(text, encoding="utf-8")
    print(f"wrote {path}; look through it, then: swath process LOG --config {path} -o DIR", file=sys.stderr)
    return 0
