"""`swath recover`: a whole log out of a cut or damaged one."""

import argparse
import functools
from pathlib import Path

HELP = "make a whole log of a cut or damaged one and say exactly what was lost; exit code 3 if anything was"

LOSSY = 3
"""Exit code: the log was recovered, but not all of it. 0: nothing is lost; 1: there was nothing to recover."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("log", type=Path, metavar="LOG", help="a flight log; it is not changed")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT",
        help="the log to write; default: LOG.recovered.mcap beside it, and none where LOG is whole",
    )
    add_force(parser)
    parser.add_argument(
        "--compression", choices=("zstd", "lz4", "none"), default="zstd", help="of the new log; default: zstd"
    )


def run(arguments: argparse.Namespace) -> int:
    """Recover, with a progress bar on a terminal."""
    from flightlog.salvage import examine, salvage
    from groundproc.commands.inputs import LOG, LOG_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.files import written_aside
    from groundproc.progress import stages

    log: Path = arguments.log
    expect([log], LOG, LOG_WORDS)
    target: Path = arguments.output or log.with_name(f"{log.stem}.recovered.mcap")
    with stages([log], {"recover": "recovering"}) as progress:
        if arguments.output is None and examine(log).whole:
            print(f"{log}: is whole; nothing to do")
            return 0
        claim_file(target, (".mcap",), arguments.force, [log])
        with written_aside(target) as aside:
            told = functools.partial(progress, "recover")
            found = salvage(log, aside, compression=arguments.compression, progress=told)
    print(f"{log}: " + "\n".join(found.sentences()))
    print(f"{target}: written")
    return LOSSY if found.lossy else 0
