"""`swath info`: what a flight log holds and how good it is."""

import argparse
import json
import sys
from pathlib import Path

HELP = "say what a flight log holds: rates, losses, clocks, gaps"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("log", type=Path, metavar="LOG", help="a flight log (.mcap), whole or cut off")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def run(arguments: argparse.Namespace) -> int:
    """Read the log once and print its figures."""
    from tqdm import tqdm

    from flightlog.logfile import LogReader
    from groundproc.flight.summary.log import summarise
    from groundproc.flight.summary.text import as_text

    with LogReader(arguments.log) as reader:
        hidden = not sys.stderr.isatty()
        with tqdm(total=reader.size, unit="B", unit_scale=True, leave=False, disable=hidden) as bar:

            def advance(size: int) -> None:
                bar.update(size)

            summary = summarise(reader, advance)
    print(json.dumps(summary, indent=2) if arguments.json else as_text(summary))
    return 0
