"""`swath warmup`: compiles what the default chain runs, so that the first flight does not wait for it."""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import tempfile
import time
from pathlib import Path

HELP = "compile everything once, so that the first flight need not wait; `make setup` does it too"

SECONDS = 7.0
"""Of the made-up flight: the least from which the odometry runs its beginning again."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""


def run(arguments: argparse.Namespace) -> int:
    """Fly made-up flights through the real stages; what is compiled already is only loaded."""
    from groundproc.imagery.painting import warmup as painting
    from groundproc.live.warmup import warm_up
    from groundproc.machine import kernelcache
    from groundproc.progress import compiling

    del arguments
    kernelcache.remove_old(time.time())
    begun_s, count = time.monotonic(), 0

    def show(begins: bool) -> None:
        nonlocal count
        if begins and not count:
            print("compiling for this computer: a minute or two, once", file=sys.stderr, flush=True)
        count += begins

    with compiling(show):
        for name, words in (("single", []), ("dual", ["--method", "filtered"])):
            with tempfile.TemporaryDirectory(prefix="swath-warmup-") as folder:
                _process(Path(folder), name == "dual", words)
        warm_up()
        with tempfile.TemporaryDirectory(prefix="swath-warmup-") as folder:
            painting.warm_up(Path(folder))
    took_s = time.monotonic() - begun_s
    done = f"{count} kernels compiled" if count else "everything was compiled before, and is looked through"
    print(f"{done} in {took_s:.0f} s; kept in {kernelcache.folder()}")
    return 0


def _process(folder: Path, dual: bool, words: list[str]) -> None:
    """Have `swath process` make its products of a made-up flight, quietly."""
    from flightlog.hdl32e import ReturnMode
    from groundproc.commands import process
    from groundproc.field.madeup import write_flight

    log = folder / "flight.mcap"
    write_flight(log, SECONDS, ReturnMode.DUAL if dual else ReturnMode.STRONGEST)
    parser = argparse.ArgumentParser()
    process.add_arguments(parser)
    with contextlib.redirect_stdout(io.StringIO()):
        process.run(parser.parse_args([str(log), "-o", str(folder / "out"), *words]))
