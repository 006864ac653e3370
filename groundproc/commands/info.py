"""`swath info`: what a flight log holds and how good it is."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from groundproc.verdict import Verdict

HELP = "say what logs and other recordings hold and how good they are; exit code 0 good, 3 doubtful, 1 bad"


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
    """Read each log once and print its figures and its verdict; one that cannot be read does not keep the others from being told."""
    from flightlog.errors import SwathError
    from groundproc.flight.summary.text import as_text
    from groundproc.machine import screen

    told: list[dict[str, Any]] = []
    codes: list[int] = []
    for path in arguments.logs:
        try:
            summary, verdict = _summary(path)
        except SwathError as error:
            if len(arguments.logs) == 1:
                raise
            print(f"swath: {error}", file=sys.stderr)
            codes.append(error.exit_code)
            continue
        lines = [] if verdict is None else [verdict.line()]
        told.append(summary if verdict is None else verdict.to_mapping() | summary)
        codes.append(0 if verdict is None else verdict.exit_code)
        if arguments.json:
            print(*lines, sep="\n", end="\n" if lines else "", file=sys.stderr)
        else:
            print(("\n" if len(told) > 1 else "") + as_text(summary))
            if verdict is not None:
                print(flush=True)
                screen.verdict(verdict.line(), verdict.grade)
    if arguments.json:
        print(json.dumps(told[0] if len(arguments.logs) == 1 else told, indent=2))
    return max(codes, key=_WORSE.index)


_WORSE: Final = (0, 3, 1, 2)
"""Exit codes, the worst last."""


def _summary(path: Path) -> "tuple[dict[str, Any], Verdict | None]":
    """The figures of a flight log with its verdict, or of a recording of another program, which is not judged."""
    from tqdm import tqdm

    from flightlog.logfile import LogReader
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect
    from groundproc.flight.summary.log import summarise
    from groundproc.flight.summary.recording import recording_kind, summarise_recording
    from groundproc.verdict.log import judge_log

    bag = ("folder",) if (path / "metadata.yaml").is_file() else ()
    expect([path], (*LOG, *_RECORDINGS, *bag), LOG_WORDS)
    hidden = not sys.stderr.isatty()
    kind = recording_kind(path)
    size = path.stat().st_size
    with tqdm(total=size, unit="B", unit_scale=True, leave=False, disable=hidden) as bar:

        def advance(size: int) -> None:
            bar.update(size)

        if kind is not None:
            return summarise_recording(path, kind, advance), None
        with LogReader(path) as reader:
            summary = summarise(reader, advance)
    return summary, judge_log(summary)


_RECORDINGS: Final = ("capture", "tlog", "dataflash", "bag", "gzip")
"""Kinds of `groundproc.flight.kinds` that recordings of other programs are of."""
