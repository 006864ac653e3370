"""`swath warmup`: compiles what the default chain runs, so that the first flight does not wait for it."""

from __future__ import annotations

import argparse
import contextlib
import io
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.synchronize import Event
from pathlib import Path

HELP = "compile everything once, so that the first flight need not wait; `make setup` does it too"

SECONDS = 7.0
"""Of the made-up flight: the least from which the odometry runs its beginning again."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""


def run(arguments: argparse.Namespace) -> int:
    """Fly made-up flights through the real stages, in two processes; what is compiled already is only loaded."""
    from groundproc.machine import kernelcache

    del arguments
    kernelcache.remove_old(time.time())
    begun_s = time.monotonic()
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    # numba compiles one kernel at a time in a process
    processes = min(len(HALVES), os.cpu_count() or 1) if kernelcache.takes_turns() else 1
    with ProcessPoolExecutor(processes, context, initializer=_share, initargs=(begun,)) as pool:
        count = sum(pool.map(_compile, HALVES))
    took_s = time.monotonic() - begun_s
    done = f"{count} kernels compiled" if count else "everything was compiled before, and is looked through"
    print(f"{done} in {took_s:.0f} s; kept in {kernelcache.folder()}")
    return 0


_begun: Event
"""Set where a kernel is compiled: one of the processes says so."""


def _share(begun: Event) -> None:
    global _begun  # how a pool hands things to its processes
    _begun = begun


def _compile(half: Callable[[], None]) -> int:
    """Run through one half; how many kernels were compiled."""
    from groundproc.progress import compiling

    count = 0

    def show(begins: bool) -> None:
        nonlocal count
        if begins and not _begun.is_set():
            _begun.set()
            print("compiling for this computer: a minute or two, once", file=sys.stderr, flush=True)
        count += begins

    with compiling(show):
        half()
    return count


def _filtered_and_images() -> None:
    """The smoother, points in dual return mode and products; then a block of photographs, and what they are laid on."""
    from groundproc.imagery.bundle import warmup as bundle
    from groundproc.imagery.painting import warmup as painting

    _process(True, ["--method", "filtered"])
    bundle.warm_up()
    with tempfile.TemporaryDirectory(prefix="swath-warmup-") as folder:
        painting.warm_up(Path(folder))


def _live_and_adjusted() -> None:
    """The odometry; then the default chain, which finds the smoother of the other half in the cache when it comes to it."""
    from groundproc.live.warmup import warm_up

    warm_up()
    _process(False, [])


HALVES = (_filtered_and_images, _live_and_adjusted)
"""Of about one length, and in an order in which hardly a kernel is compiled by both."""


def _process(dual: bool, words: list[str]) -> None:
    """Have `swath process` make its products of a made-up flight, quietly."""
    from flightlog.hdl32e import ReturnMode
    from groundproc.commands import process
    from groundproc.field.madeup import write_flight

    parser = argparse.ArgumentParser()
    process.add_arguments(parser)
    with tempfile.TemporaryDirectory(prefix="swath-warmup-") as name:
        log = Path(name) / "flight.mcap"
        write_flight(log, SECONDS, ReturnMode.DUAL if dual else ReturnMode.STRONGEST)
        with contextlib.redirect_stdout(io.StringIO()):
            process.run(parser.parse_args([str(log), "-o", str(Path(name) / "out"), *words]))
