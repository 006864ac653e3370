"""One flight of a campaign, in a process of its own: what it may do wrong, its memory included, stays with it."""

import contextlib
import ctypes
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from flightlog import config
from flightlog.errors import SwathError
from groundproc.campaign import places
from groundproc.campaign.flights import Job
from groundproc.steps.software import version
from groundproc.survey import FILES, Survey
from groundproc.verdict import Verdict

DONE: Final = "quality.json"
"""Delivered last: where it is, the flight is whole."""
_KEY: Final = "batch.json"
_PROGRAM: Final = "import sys; from groundproc.cli import main; sys.exit(main(sys.argv[1:]))"
_PR_SET_PDEATHSIG: Final = 1
"""prctl(2): a signal for the child when its parent dies."""
_THREADS: Final = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS")
_MISSING: Final = "missing"
_GOOD_LINE: Final = Verdict(()).line()
"""It says no more than the outcome does."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a flight.

    Attributes
    ----------
    name, output : str
    exit_code : int
        Of `swath process`: 0 good, 3 doubtful, else bad or failed.
    verdict : str
        "good", "doubtful", "bad", or "failed": there are no products.
    seconds : float
    points : int
    said : tuple of str
        Its warnings and errors.
    skipped : bool
        It was up to date.
    """

    name: str
    output: str
    exit_code: int
    verdict: str
    seconds: float
    points: int = 0
    said: tuple[str, ...] = ()
    skipped: bool = False


class Running:
    """The processes of flights that are under way, so that whoever waits for their threads can end them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._processes: set[subprocess.Popen[str]] = set()
        self._over = False

    @contextlib.contextmanager
    def holds(self, process: "subprocess.Popen[str]") -> Iterator[None]:
        """For the time of a flight; one that begins after the end is ended at once."""
        with self._lock:
            self._processes.add(process)
            if self._over:
                process.terminate()
        try:
            yield
        finally:
            with self._lock:
                self._processes.discard(process)

    def end(self) -> None:
        """Terminate them: each removes what is half-written. Done more than once, it does no harm."""
        with self._lock:
            self._over = True
            for process in self._processes:
                process.terminate()


def run_flight(job: Job, threads: int | None = None, running: Running | None = None) -> Outcome:
    """Process a flight; whatever goes wrong is in the outcome.

    Parameters
    ----------
    job : Job
    threads : int, optional
        Cores that it may use. Default: all.
    running : Running, optional
        Where its process is entered.
    """
    began = time.monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="swath-batch-") as scratch:
            code, quality, said, skipped = _run(job, Path(scratch), threads, running or Running())
    except SwathError as error:
        code, quality, said, skipped = error.exit_code, {}, (f"swath: {error}",), False
    except OSError as error:  # of the scratch folder: a full disk
        code, quality, said, skipped = (
            1,
            {},
            (f"swath: {error.filename or tempfile.gettempdir()}: {error.strerror}",),
            False,
        )
    verdict = Verdict.from_mapping(quality).grade if quality else None
    points = int(quality.get("points", {}).get("written", 0))
    took_s = time.monotonic() - began
    return Outcome(job.name, job.output, code, verdict or "failed", took_s, points, said, skipped)


def _run(
    job: Job, scratch: Path, threads: int | None, running: Running
) -> tuple[int, dict[str, Any], tuple[str, ...], bool]:
    """Exit code, quality.json, what was said, and whether nothing was to be done."""
    remote = places.is_remote(job.output)
    key = _key(job) if remote else ""
    if remote and not job.force and (found := _finished(job, key)) is not None:
        return found[0], found[1], (), True
    for part in ("logs", "files", "products"):
        (scratch / part).mkdir()
    logs = [places.fetch(log, _numbered(scratch / "logs", number)) for number, log in enumerate(job.logs)]
    survey = scratch / "survey.yaml"
    survey.write_text(_fetched_settings(job.settings, scratch / "files"), encoding="utf-8")
    folder = scratch / "products" if remote else Path(job.output)
    words = ["process", *map(str, logs), "-o", str(folder), "--config", str(survey), "--json"]
    before = _state(folder / DONE)
    code, out, said = _child([*words, *(["--force"] if job.force else [])], threads, running)
    quality = _quality(out)
    if quality and remote:  # those of a bad flight too: its report says why
        (folder / _KEY).write_text(json.dumps({"key": key, "exit_code": code}) + "\n", encoding="utf-8")
        places.deliver(folder, job.output, DONE)
    # the last that is made, and made anew whenever anything is
    skipped = bool(quality) and before != _MISSING and _state(folder / DONE) == before
    return code, quality, tuple(line for line in said if line != _GOOD_LINE), skipped


def _numbered(folder: Path, number: int) -> Path:
    """A folder for one log: two may have one name."""
    path = folder / str(number)
    path.mkdir()
    return path


def _fetched_settings(settings: str, folder: Path) -> str:
    """The survey with its files of elsewhere as paths here."""
    survey = config.to_mapping(config.loads(settings, Survey, "survey"))
    for name in FILES:
        if isinstance(survey[name], str) and places.is_remote(survey[name]):
            survey[name] = str(places.fetch(survey[name], folder))
    return config.dump(survey)


def _child(words: list[str], threads: int | None, running: Running) -> tuple[int, str, tuple[str, ...]]:
    """Run `swath`; exit code, standard output, and the lines of standard error."""
    few = dict.fromkeys(_THREADS, str(threads)) if threads else {}
    with (
        subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, **few, "PYTHONIOENCODING": "utf-8"},
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        ) as process,
        _ended(process),
        running.holds(process),
    ):
        out, err = process.communicate()
    code = process.returncode
    said = tuple(line for line in err.splitlines() if line.strip())
    if code < 0:
        said = (*said, f"swath: the flight's process was ended by {signal.Signals(-code).name}")
    return code, out, said


@contextlib.contextmanager
def _ended(process: "subprocess.Popen[str]") -> Iterator[None]:
    """End the child, which cleans up, when this is left by an interrupt."""
    try:
        yield
    except BaseException:
        process.terminate()
        raise


def _die_with_parent() -> None:
    """In the child: a worker that is killed takes its flight with it, and another goes on after the last finished step."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _quality(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _key(job: Job) -> str:
    """What decides about the products of a flight whose folder is elsewhere: its files' states, settings and version."""
    files = [(log, places.state(log) if places.is_remote(log) else _state(Path(log))) for log in job.logs]
    settings = asdict(config.loads(job.settings, Survey, "survey"))
    text = json.dumps([version(), files, settings], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _state(path: Path) -> str:
    try:
        found = path.stat()
    except OSError:
        return _MISSING
    return f"{found.st_size} {found.st_mtime_ns}"


def _finished(job: Job, key: str) -> tuple[int, dict[str, Any]] | None:
    """Exit code and quality of products that are there already and are up to date."""
    mark, quality = (places.read_text(f"{job.output}/{name}") for name in (_KEY, DONE))
    if mark is None or quality is None:
        return None
    found = _quality(mark)
    return (int(found.get("exit_code", 0)), _quality(quality)) if found.get("key") == key else None
