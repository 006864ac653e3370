"""`swath info`: what a flight log holds and how good it is."""

import argparse
import json
import sys
from pathlib import Path

HELP = "say what a flight log holds and how good it is; exit code 0 good, 3 doubtful, 1 bad"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("log", type=Path, metavar="LOG", help="a flight log (.mcap), whole or cut off")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def run(arguments: argparse.Namespace) -> int:
    """Read the log once and print its figures."""
    from tqdm import tqdm

    from flightlog.logfile import LogReader
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect
    from groundproc.flight.summary.log import summarise
    from groundproc.flight.summary.text import as_text
    from groundproc.verdict import judge_log

    expect([arguments.log], LOG, LOG_WORDS)
    with LogReader(arguments.log) as reader:
        hidden = not sys.stderr.isatty()
        with tqdm(total=reader.size, unit="B", unit_scale=True, leave=False, disable=hidden) as bar:

            def advance(size: int) -> None:
                bar.update(size)

            summary = summarise(reader, advance)
    verdict = judge_log(summary)
    if arguments.json:
        print(json.dumps(verdict.to_mapping() | summary, indent=2))
        print(verdict.line(), file=sys.stderr)
    else:
        print(f"{as_text(summary)}\n\n{verdict.line()}")
    return verdict.exit_code
