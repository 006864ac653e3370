"""`swath info`: what a flight log holds and how good it is."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

HELP = "say what flight logs and other recordings hold: rates, losses, clocks, gaps"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument(
        "logs", nargs="+", type=Path, metavar="LOG",
        help="a flight log (.mcap), whole or cut off; or a recording of another program: capture, telemetry or dataflash log, bag",
    )  # fmt: skip
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object instead of text, a list of them for several logs"
    )


def run(arguments: argparse.Namespace) -> int:
    """Read each log once and print its figures; one that cannot be read does not keep the others from being told."""
    from flightlog.errors import SwathError
    from groundproc.flight.summary.text import as_text

    summaries: list[dict[str, Any]] = []
    code = 0
    for path in arguments.logs:
        try:
            summaries.append(_summary(path))
        except SwathError as error:
            if len(arguments.logs) == 1:
                raise
            print(f"swath: {error}", file=sys.stderr)
            code = error.exit_code
            continue
        if not arguments.json:
            print(("\n" if len(summaries) > 1 else "") + as_text(summaries[-1]))
    if arguments.json:
        print(json.dumps(summaries[0] if len(arguments.logs) == 1 else summaries, indent=2))
    return code


def _summary(path: Path) -> dict[str, Any]:
    """The figures of a flight log, or of a recording of another program."""
    from tqdm import tqdm

    from flightlog.logfile import LogReader
    from groundproc.flight.summary.log import summarise
    from groundproc.flight.summary.recording import recording_kind, summarise_recording

    hidden = not sys.stderr.isatty()
    kind = recording_kind(path)
    size = path.stat().st_size
    with tqdm(total=size, unit="B", unit_scale=True, leave=False, disable=hidden) as bar:

        def advance(size: int) -> None:
            bar.update(size)

        if kind is not None:
            return summarise_recording(path, kind, advance)
        with LogReader(path) as reader:
            return summarise(reader, advance)
