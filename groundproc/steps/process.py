"""Runs the steps that have something to do, in order, and keeps the ledger."""

import contextlib
import shutil
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from flightlog import config
from flightlog.clock import utc_text
from flightlog.errors import ClockError, CoverageError, LogError, SourceError, SwathError, UsageError
from groundproc.estimation.method import Progress
from groundproc.files import made_folder
from groundproc.machine.system import give_back_memory
from groundproc.steps import ORDER
from groundproc.steps.ledger import (
    INSIDE,
    Entry,
    Fingerprint,
    Ledger,
    fingerprint,
    folder_of,
    locked,
    open_ledger,
    staged_by_anyone,
    staging,
    sweep,
)
from groundproc.steps.request import Request, absolute
from groundproc.steps.run import Run
from groundproc.steps.software import version
from groundproc.steps.step import BETWEEN, WHOLE, Key, Step, steps
from groundproc.survey import FILES, Survey


@dataclass(frozen=True, slots=True)
class State:
    """How a step, or a part of one, stands.

    Attributes
    ----------
    step : str
        Its name, with that of the part: "place: cloud.laz".
    about : str
    state : str
        "done", "stale" or "missing".
    reasons : tuple of str
        Why it is not done.
    outputs : tuple of str
    finished : str
        UTC; empty where it never was.
    seconds : float
        Time that it took, all parts that were made with it included.
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
            with Run(request, folder, progress, whole=until == ORDER[-1]) as run:
                for step in steps()[: ORDER.index(until) + 1]:
                    _bring_up_to_date(step, run, ledger, force)
        except Exception as error:  # raised again: whatever went wrong, a folder that held nothing is left so
            if was_empty:
                ledger.forget_all()
            if isinstance(error, LogError | ClockError | CoverageError) and run.torn():
                raise type(error)(f"{error} ({run.torn()})") from error
            if isinstance(error, OSError):
                raise SourceError(f"{error.filename or folder}: {error.strerror or error}") from error
            raise
        finally:
            if not ledger.entries:
                shutil.rmtree(folder / INSIDE, ignore_errors=True)
        return states(request, ledger)


def _bring_up_to_date(step: Step, run: Run, ledger: Ledger, force: bool) -> None:
    """Make the parts of a step that are not as they should be; what is not asked for any more goes."""
    parts = step.parts(run.request)
    due = [part for part in parts if force or reasons(step, part, run.request, ledger)]
    for some in [[part] for part in due] if step.singly else [due] * bool(due):
        execute(step, some, run, ledger, force)
    for unit in [unit for unit in ledger.entries if unit.partition(BETWEEN)[0] == step.name]:
        if unit not in step.units(run.request):
            ledger.drop(unit)


def execute(step: Step, parts: Sequence[str], run: Run, ledger: Ledger, force: bool) -> None:
    """Make parts of a step and enter them."""
    staged = staging(ledger.folder, step.name)
    folders = {part: staged / folder_of(part) for part in parts}
    began = time.monotonic()
    try:
        for place in folders.values():
            place.mkdir(parents=True)
        keys = {part: key_of(step, part, run.request, ledger) for part in parts}
        step.work(run, folders)
        outputs = {part: _fingerprints(place) for part, place in folders.items()}
        if not force:
            _refuse_foreign(ledger, [name for made in outputs.values() for name in made])
        finished, seconds = utc_text(time.time_ns()), time.monotonic() - began
        with undisturbed():
            for part, place in folders.items():
                ledger.commit(step.unit(part), Entry(keys[part], outputs[part], finished, seconds), place)
    except SwathError as error:
        raise type(error)(_in_place(str(error), folders, ledger.folder)) from error
    finally:
        shutil.rmtree(staged, ignore_errors=True)
        give_back_memory()


def _in_place(sentence: str, folders: Mapping[str, Path], target: Path) -> str:
    """A sentence about a file being made, with the name that the user knows it by."""
    for place in folders.values():
        sentence = sentence.replace(str(place), str(target))
    return sentence


def _fingerprints(folder: Path) -> dict[str, Fingerprint]:
    """All files of a folder by their names in it."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): fingerprint(path) for path in paths}


def _refuse_foreign(ledger: Ledger, outputs: Sequence[str]) -> None:
    """Refuse to write over files that no step made."""
    owned = ledger.owned()
    for name in outputs:
        if name not in owned and (ledger.folder / name).exists():
            raise UsageError(
                f"{ledger.folder / name}: exists already and was not made by this; give another folder, or --force to write over it"
            )


# What is to be done ---------------------------------------------------------------------------------------------------


def key_of(step: Step, part: str, request: Request, ledger: Ledger) -> Key:
    """What decides about the outcome of a part of a step whose forerunners are done."""
    files = step.files(request)
    # of a file the content counts, and not where it lies
    settings = {name: "a file" if name in files else value for name, value in step.settings(request).items()}
    return {
        "software": version(),
        "logs": sorted(ledger.fingerprint(log).digest for log in request.logs) if step.reads_logs else [],
        "settings": settings | {"": step.parts(request)[part]},
        "files": {name: ledger.fingerprint(path).digest for name, path in files.items()},
        "after": {name: ledger.digest(units) for name, units in step.forerunners(request).items()},
    }


def reasons(step: Step, part: str, request: Request, ledger: Ledger) -> list[str]:
    """Why a part of a step is to be made; empty where it need not be."""
    unit = step.unit(part)
    entry = ledger.entries.get(unit)
    if entry is None:
        return ["not made yet"]
    waits = [unit for units in step.forerunners(request).values() for unit in units if unit not in ledger.entries]
    if waits:
        return [f"{unit} is to be made first" for unit in waits]
    key, before = key_of(step, part, request, ledger), entry.key
    found = [f"{name} {what}" for name, what in ledger.changed(unit).items()]
    if key["software"] != before.get("software"):
        found.append(f"made by swath {before.get('software')}, this is {key['software']}")
    if key["logs"] != before.get("logs"):
        found.append("made of other logs")
    found += _differences(before.get("settings"), key["settings"])
    found += [f"{name}: other content" for name in _changed_names(before.get("files"), key["files"])]
    found += [f"{name} was made anew" for name in _changed_names(before.get("after"), key["after"])]
    return found


def _differences(before: Any, now: dict[str, Any]) -> list[str]:
    """Settings that are not as they were, in words; the part's own are those without a name."""
    old = before if isinstance(before, dict) else {}
    return [f"{name or 'options'} was {old.get(name)!r}, is {now.get(name)!r}" for name in _changed_names(old, now)]


def _changed_names(before: Any, now: dict[str, Any]) -> list[str]:
    old = before if isinstance(before, dict) else {}
    nothing = object()
    return sorted(name for name in old.keys() | now.keys() if old.get(name, nothing) != now.get(name, nothing))


def states(request: Request, ledger: Ledger) -> list[State]:
    """How all steps stand, part by part; what comes after something that is to be made waits for it."""
    found: list[State] = []
    to_do: set[str] = set()
    for step in steps():
        before = step.forerunners(request)
        waits = [f"{name} comes first" for name in step.after if to_do.intersection(before[name])]
        for part in step.parts(request):
            why = waits or reasons(step, part, request, ledger)
            if why:
                to_do.add(step.unit(part))
            found.append(_state(step, part, why, ledger))
    return found


def _state(step: Step, part: str, why: Sequence[str], ledger: Ledger) -> State:
    unit = step.unit(part)
    about = step.about if part == WHOLE else ""
    entry = ledger.entries.get(unit)
    if entry is None:
        return State(unit, about, "missing", tuple(why))
    outputs = tuple(name for name in entry.outputs if not name.startswith(INSIDE))
    return State(unit, about, "stale" if why else "done", tuple(why), outputs, entry.finished, entry.seconds)


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
    for unit in list(ledger.pending):
        name, _, part = unit.partition(BETWEEN)
        staged = next(staged_by_anyone(folder, name), staging(folder, name))
        ledger.settle(unit, staged / folder_of(part))
    sweep(folder)
    if not force:
        _refuse_other_inputs(request, ledger)
        refuse_changed(ledger, ledger.entries)
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


def refuse_changed(ledger: Ledger, units: Iterable[str]) -> None:
    """Refuse to write over products of some steps that somebody has changed."""
    for unit in units:
        if unit not in ledger.entries:
            continue
        for name, what in ledger.changed(unit).items():
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
