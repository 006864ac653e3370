"""Runs the steps that have something to do, in order, and keeps the ledger."""

import contextlib
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from flightlog import config
from flightlog.clock import utc_text
from flightlog.errors import UsageError
from groundproc.estimation.method import Progress
from groundproc.files import made_folder
from groundproc.steps import ORDER
from groundproc.steps.ledger import (
    INSIDE,
    Entry,
    Ledger,
    fingerprint,
    locked,
    open_ledger,
    staged_by_anyone,
    staging,
    sweep,
)
from groundproc.steps.run import Run
from groundproc.steps.software import version
from groundproc.steps.step import Key, Request, Step, absolute, steps
from groundproc.survey import FILES, Survey


@dataclass(frozen=True, slots=True)
class State:
    """How a step stands.

    Attributes
    ----------
    step : str
    about : str
    state : str
        "done", "stale" or "missing".
    reasons : tuple of str
        Why it is not done.
    outputs : tuple of str
    finished : str
        UTC; empty where it never was.
    seconds : float
    """

    step: str
    about: str
    state: str
    reasons: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    finished: str = ""
    seconds: float = 0.0


def process(
    request: Request, folder: Path, progress: Progress, *, until: str = ORDER[-1], force: bool = False
) -> list[State]:
    """Bring the products of a flight up to date.

    Parameters
    ----------
    request : Request
    folder : Path
        Made where it is not there.
    progress : Progress
    until : str
        Last step to do.
    force : bool
        Do all of them, and write over what is not ours.

    Returns
    -------
    list of State
        How all steps stand now.

    Raises
    ------
    UsageError
        The folder holds something else, or a wish that cannot be met.
    SwathError
        A step fails; what it began leaves nothing, and a folder that held nothing before is left so.
    """
    for step in steps():
        step.check(request)
    with made_folder(folder), locked(folder):
        ledger = admitted(request, folder, force)
        was_empty = not ledger.entries
        try:
            with Run(request, folder, progress) as run:
                for step in steps()[: ORDER.index(until) + 1]:
                    if force or reasons(step, request, ledger):
                        _execute(step, run, ledger, force)
        except Exception:
            if was_empty:
                ledger.forget_all()
            raise
        finally:
            if not ledger.entries:
                shutil.rmtree(folder / INSIDE, ignore_errors=True)
        return states(request, ledger)


def _execute(step: Step, run: Run, ledger: Ledger, force: bool) -> None:
    """Do one step and enter it."""
    staged = staging(ledger.folder, step.name)
    began = time.monotonic()
    try:
        staged.mkdir(parents=True)
        key = key_of(step, run.request, ledger)
        step.work(run, staged)
        paths = sorted(path for path in staged.rglob("*") if path.is_file())
        outputs = {path.relative_to(staged).as_posix(): fingerprint(path) for path in paths}
        if not force:
            _refuse_foreign(ledger, outputs)
        entry = Entry(key, outputs, utc_text(time.time_ns()), time.monotonic() - began)
        with undisturbed():
            ledger.commit(step.name, entry, staged)
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def _refuse_foreign(ledger: Ledger, outputs: dict[str, Any]) -> None:
    """Refuse to write over files that no step made."""
    owned = ledger.owned()
    for name in outputs:
        if name not in owned and (ledger.folder / name).exists():
            raise UsageError(f"{ledger.folder / name}: is there and was not made by this; --force replaces it")


# What is to be done ---------------------------------------------------------------------------------------------------


def key_of(step: Step, request: Request, ledger: Ledger) -> Key:
    """What decides about the outcome of a step whose forerunners are done."""
    files = step.files(request)
    # of a file the content counts, and not where it lies
    settings = {name: "a file" if name in files else value for name, value in step.settings(request).items()}
    return {
        "software": version(),
        "logs": sorted(ledger.fingerprint(log).digest for log in request.logs) if step.reads_logs else [],
        "settings": settings,
        "files": {name: ledger.fingerprint(path).digest for name, path in files.items()},
        "after": {name: ledger.entries[name].digest() for name in step.after},
    }


def reasons(step: Step, request: Request, ledger: Ledger) -> list[str]:
    """Why a step is to be done; empty where it need not be."""
    entry = ledger.entries.get(step.name)
    if entry is None:
        return ["not made yet"]
    waits = [name for name in step.after if name not in ledger.entries]
    if waits:
        return [f"{name} is to be made first" for name in waits]
    key, before = key_of(step, request, ledger), entry.key
    found = [f"{name} {what}" for name, what in ledger.changed(step.name).items()]
    if key["software"] != before.get("software"):
        found.append(f"made by swath {before.get('software')}, this is {key['software']}")
    if key["logs"] != before.get("logs"):
        found.append("made of other logs")
    found += _differences(before.get("settings"), key["settings"])
    found += [f"{name}: other content" for name in _changed_names(before.get("files"), key["files"])]
    found += [f"{name} was made anew" for name in _changed_names(before.get("after"), key["after"])]
    return found


def _differences(before: Any, now: dict[str, Any]) -> list[str]:
    """Settings that are not as they were, in words."""
    old = before if isinstance(before, dict) else {}
    return [f"{name} was {old.get(name)!r}, is {now.get(name)!r}" for name in _changed_names(old, now)]


def _changed_names(before: Any, now: dict[str, Any]) -> list[str]:
    old = before if isinstance(before, dict) else {}
    nothing = object()
    return sorted(name for name in old.keys() | now.keys() if old.get(name, nothing) != now.get(name, nothing))


def states(request: Request, ledger: Ledger) -> list[State]:
    """How all steps stand; what comes after a step that is to be done waits for it."""
    found: list[State] = []
    open_steps: set[str] = set()
    for step in steps():
        waits = [f"{name} comes first" for name in step.after if name in open_steps]
        why = waits or reasons(step, request, ledger)
        if why:
            open_steps.add(step.name)
        entry = ledger.entries.get(step.name)
        if entry is None:
            found.append(State(step.name, step.about, "missing", tuple(why)))
            continue
        outputs = tuple(name for name in entry.outputs if not name.startswith(INSIDE))
        state = "stale" if why else "done"
        found.append(State(step.name, step.about, state, tuple(why), outputs, entry.finished, entry.seconds))
    return found


# The folder -----------------------------------------------------------------------------------------------------------


def admitted(request: Request, folder: Path, force: bool) -> Ledger:
    """The ledger to go on with: that of the folder, settled and swept, or a new one.

    Raises
    ------
    UsageError
        The folder holds something else, products of other logs, or products that were changed since.
    """
    try:
        ledger = open_ledger(folder)
    except UsageError:
        if not force:
            raise
        ledger = None
    if ledger is None:
        sweep(folder)
        if not force:
            _refuse_others(request, folder)
        ledger = Ledger(folder)
    for step in list(ledger.pending):
        ledger.settle(step, next(staged_by_anyone(folder, step), staging(folder, step)))
    sweep(folder)
    if not force:
        _refuse_other_inputs(request, ledger)
        _refuse_changed(ledger)
    ledger.logs = [str(log.resolve()) for log in request.logs]
    ledger.poses = str(request.poses.resolve()) if request.poses else None
    ledger.survey = config.to_mapping(absolute(request.survey))
    for log in request.logs:
        ledger.fingerprint(log)
    ledger.save()
    return ledger


def _refuse_others(request: Request, folder: Path) -> None:
    """Refuse a folder with files that are neither ours nor what is to be read."""
    read = {path.resolve() for path in (*request.logs, *([request.poses] if request.poses else ()))}
    read |= {Path(value).resolve() for name in FILES if isinstance(value := getattr(request.survey, name), str)}
    others = sorted(
        path.name
        for path in folder.iterdir()
        if path.name != INSIDE and path.resolve() not in read and path.suffix != ".part" and path.name != "survey.yaml"
    )
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise UsageError(
            f"{folder}: holds {others[0]}{more}, which was not made by this; choose another folder, or --force to write into it"
        )


def _refuse_other_inputs(request: Request, ledger: Ledger) -> None:
    """Refuse a folder whose products are of other logs."""
    before = [ledger.files[log] for log in ledger.logs if log in ledger.files]
    if not ledger.entries or not before:
        return
    now = [ledger.fingerprint(log) for log in request.logs]
    if sorted(mark.digest for mark in before) != sorted(mark.digest for mark in now):
        raise UsageError(
            f"{ledger.folder}: holds the products of other logs ({', '.join(ledger.logs)}); "
            "choose another folder, or --force to replace them"
        )


def _refuse_changed(ledger: Ledger) -> None:
    """Refuse to write over products that somebody has changed."""
    for step in ledger.entries:
        for name, what in ledger.changed(step).items():
            if (ledger.folder / name).exists():
                raise UsageError(f"{ledger.folder / name}: {what} it was made here; --force replaces it")


def remembered(folder: Path) -> Request | None:
    """What the ledger of a folder says was asked for last; None where it has none."""
    ledger = open_ledger(folder)
    if ledger is None:
        return None
    survey = config.from_mapping(ledger.survey, Survey, str(ledger.path))
    return Request([Path(log) for log in ledger.logs], survey, Path(ledger.poses) if ledger.poses else None)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Hold SIGINT and SIGTERM back until what is inside is through."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def remember(number: int, frame: FrameType | None) -> None:
        came.append(number)

    before = {number: signal.signal(number, remember) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])
