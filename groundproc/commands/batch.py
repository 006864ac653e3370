"""`swath batch`: many flights at once, here or on a cluster; one that fails does not stop the others."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from groundproc.campaign.flight import Outcome
    from groundproc.campaign.flights import Job

HELP = "process many flights, on this computer or a Dask cluster; files may lie in any place that fsspec knows"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument(
        "flights",
        type=Path,
        metavar="FLIGHTS.yaml",
        help="output, survey (for all flights) and flights: a list of name, logs and survey (for this one)",
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler, such as tcp://host:8786")
    parser.add_argument("--workers", metavar="N", help="flights at a time on this computer; default: 1")
    parser.add_argument("--force", action="store_true", help="do every step of every flight again")
    parser.add_argument("--dry-run", action="store_true", help="say what would be done, and do nothing")
    parser.add_argument("--json", action="store_true", help="print what became of each flight as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Do all flights; the worst of them decides about the exit code."""
    from flightlog.errors import UsageError
    from groundproc.campaign.flights import load_jobs
    from groundproc.campaign.schedule import outcomes
    from groundproc.commands.inputs import expect_text
    from groundproc.commands.values import count

    if arguments.scheduler and arguments.workers:
        raise UsageError("--workers counts flights on this computer; a cluster behind --scheduler has its own workers")
    expect_text(arguments.flights, "a list of flights (YAML)")
    jobs = load_jobs(arguments.flights, arguments.force)
    if arguments.dry_run:
        for job in jobs:
            _tell_missing(job)
        print(json.dumps([asdict(job) for job in jobs], indent=2) if arguments.json else _planned(jobs))
        return 0
    workers = count(arguments.workers, "--workers") if arguments.workers else 1
    found: dict[str, Outcome] = {}
    for outcome in outcomes(jobs, arguments.scheduler, workers):
        found[outcome.name] = outcome
        print(f"{len(found)}/{len(jobs)} {_line(outcome)}", file=sys.stderr, flush=True)
        for sentence in outcome.said:
            print(f"  {outcome.name}: {sentence}", file=sys.stderr, flush=True)
    ordered = [found[job.name] for job in jobs]
    if arguments.json:
        print(json.dumps([asdict(each) for each in ordered], indent=2))
    else:
        _show(ordered)
    return _exit_code(ordered)


def _planned(jobs: Sequence[Job]) -> str:
    return "\n".join(f"{job.name}: {', '.join(job.logs)} -> {job.output}" for job in jobs)


def _tell_missing(job: Job) -> None:
    """Say before the night what would fail in it; what lies elsewhere is not asked for."""
    from groundproc.campaign.places import is_remote
    from groundproc.commands.inputs import like

    for log in job.logs:
        if not is_remote(log) and not Path(log).exists():
            print(f"swath: warning: {job.name}: {log}: no such file{like(Path(log))}", file=sys.stderr)


def _line(outcome: Outcome) -> str:
    state = "up to date" if outcome.skipped else f"{outcome.seconds:.0f} s"
    return f"{outcome.name}: {outcome.verdict}, {outcome.points:,} points, {state}"


def _show(found: Sequence[Outcome]) -> None:
    """A line a flight, and the sum."""
    from groundproc.machine import screen

    screen.table(
        ["flight", "verdict", "points", "seconds", "products"],
        [[each.name, each.verdict, f"{each.points:,}", f"{each.seconds:.0f}", each.output] for each in found],
    )
    failed = sum(each.verdict == "failed" for each in found)
    flights = f"{len(found)} flight{'s' * (len(found) != 1)}"
    print(f"{flights}, {failed} failed, {sum(each.points for each in found):,} points")


def _exit_code(found: Sequence[Outcome]) -> int:
    """0 where all are good, 3 where one is doubtful, 1 where one is bad or failed."""
    codes = {each.exit_code for each in found}
    return 0 if codes <= {0} else 3 if codes <= {0, 3} else 1
