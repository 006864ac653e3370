"""The ledger of an output folder, `.swath/ledger.json`: what was made of what.

It holds for each finished step what decided about it (`step.Key`) and what came of it, with size and hash. It is replaced as a whole after
every step. Outputs get their names only after the ledger knows them, so that whatever moment a process dies at, the next one can tell what
is ours.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

from flightlog.errors import SourceError, UsageError
from groundproc.files import written_aside
from groundproc.machine import system

INSIDE: Final = ".swath"
"""Folder within the output folder for what is no product."""
NAME: Final = "ledger.json"
FORMAT: Final = 1


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """Content of a file, and what the file system said of it when it was read.

    Attributes
    ----------
    size : int
        [bytes]
    digest : str
        SHA-256 of the whole content, hexadecimal.
    seen : tuple of int
        Time of modification [ns], time of change [ns] and inode. Where these and the size are as they were, the content is taken to be
        so too and not read again; the time of change cannot be set back by a program.
    """

    size: int
    digest: str
    seen: tuple[int, int, int]

    def same(self, other: "Fingerprint | None") -> bool:
        """Whether the contents are equal."""
        return other is not None and (self.size, self.digest) == (other.size, other.digest)


@dataclass(frozen=True, slots=True)
class Entry:
    """A finished step.

    Attributes
    ----------
    key : dict
        See `step.Key`.
    outputs : dict of str to Fingerprint
        By name within the output folder.
    finished : str
        UTC.
    seconds : float
        Time that it took.
    """

    key: dict[str, Any]
    outputs: dict[str, Fingerprint]
    finished: str
    seconds: float


@dataclass(slots=True)
class Ledger:
    """What was made of what in one output folder.

    Attributes
    ----------
    folder : Path
    logs : list of str
        Absolute paths of the logs of the last run.
    poses : str or None
        Trajectory from elsewhere.
    survey : dict
        The effective survey of the last run.
    files : dict of str to Fingerprint
        Every file read, by absolute path.
    entries : dict of str to Entry
        By step, or part of one; finished.
    pending : dict of str to Entry
        By step, or part of one; finished, its outputs perhaps not all in their place yet.
    """

    folder: Path
    logs: list[str] = field(default_factory=list)
    poses: str | None = None
    survey: dict[str, Any] = field(default_factory=dict)
    files: dict[str, Fingerprint] = field(default_factory=dict)
    entries: dict[str, Entry] = field(default_factory=dict)
    pending: dict[str, Entry] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        """Where it is kept."""
        return self.folder / INSIDE / NAME

    def owned(self) -> dict[str, Fingerprint]:
        """All outputs by name."""
        return {name: mark for entry in self.entries.values() for name, mark in entry.outputs.items()}

    def digest(self, units: Iterable[str]) -> str:
        """One hash for all outputs of some finished steps."""
        outputs = {name: mark.digest for unit in units for name, mark in self.entries[unit].outputs.items()}
        text = "".join(f"{name} {digest}\n" for name, digest in sorted(outputs.items()))
        return hashlib.sha256(text.encode()).hexdigest()

    def save(self) -> None:
        """Replace the file as a whole, on the disk before this returns."""
        tree = {
            "format": FORMAT,
            "logs": self.logs,
            "trajectory": self.poses,
            "survey": self.survey,
            "files": {name: _plain(mark) for name, mark in self.files.items()},
            "steps": {name: _plain_entry(entry) for name, entry in self.entries.items()},
            "pending": {name: _plain_entry(entry) for name, entry in self.pending.items()},
        }
        self.path.parent.mkdir(exist_ok=True)
        with written_aside(self.path) as aside, aside.open("w", encoding="utf-8") as file:
            file.write(json.dumps(tree, indent=1) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def fingerprint(self, path: Path) -> Fingerprint:
        """Content of a file that is read; from the ledger where nothing says that it changed."""
        name = str(path.resolve())
        self.files[name] = fingerprint(path, self.files.get(name))
        return self.files[name]

    def changed(self, unit: str) -> dict[str, str]:
        """Outputs of a step that are not as they were made, by name: "is missing" or "was changed since"."""
        found = {}
        for name, mark in self.entries[unit].outputs.items():
            path = self.folder / name
            if not path.is_file():
                found[name] = "is missing"
                continue
            now = fingerprint(path, mark)
            if not now.same(mark):
                found[name] = "was changed since"
            else:
                self.entries[unit].outputs[name] = now
        return found

    def commit(self, unit: str, entry: Entry, staged: Path) -> None:
        """Enter a finished step, and give its outputs, which lie in a folder of their own, their names.

        What the step made before and does not make any more goes.
        """
        self.pending[unit] = entry
        self.save()
        self.settle(unit, staged)

    def settle(self, unit: str, staged: Path) -> None:
        """Move what is pending into its place."""
        entry = self.pending.pop(unit)
        whole = True
        for name, mark in entry.outputs.items():
            source, target = staged / name, self.folder / name
            if source.is_file():
                target.parent.mkdir(parents=True, exist_ok=True)
                source.replace(target)
            whole &= target.is_file() and target.stat().st_size == mark.size
        before = self.entries.pop(unit, None)
        if whole:
            # renaming has changed what the file system says of them
            outputs = {name: replace(mark, seen=seen(self.folder / name)) for name, mark in entry.outputs.items()}
            self.entries[unit] = replace(entry, outputs=outputs)
        for name in set(before.outputs if before else ()) - set(entry.outputs):
            (self.folder / name).unlink(missing_ok=True)
        self.save()

    def drop(self, unit: str) -> None:
        """Remove what was made and is not asked for any more, but for files that somebody has changed."""
        changed = self.changed(unit)
        for name in self.entries.pop(unit).outputs:
            if name not in changed:
                (self.folder / name).unlink(missing_ok=True)
        self.save()

    def forget_all(self) -> None:
        """Remove every output that is still as it was made, and the ledger."""
        for unit in self.entries:
            changed = self.changed(unit)
            for name in self.entries[unit].outputs:
                if name not in changed:
                    (self.folder / name).unlink(missing_ok=True)
        shutil.rmtree(self.folder / INSIDE, ignore_errors=True)


def seen(path: Path) -> tuple[int, int, int]:
    """What the file system says of a file; see `Fingerprint`."""
    stat = path.stat()
    return stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino


def fingerprint(path: Path, known: Fingerprint | None = None) -> Fingerprint:
    """Size and hash of a file; those known where the file system says that nothing changed.

    Raises
    ------
    SourceError
        It cannot be read.
    """
    try:
        size, now = path.stat().st_size, seen(path)
        if known is not None and (known.size, known.seen) == (size, now):
            return known
        with path.open("rb") as file:
            return Fingerprint(size, hashlib.file_digest(file, "sha256").hexdigest(), now)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror or error})") from None


def open_ledger(folder: Path) -> Ledger | None:
    """The ledger of a folder; None where it has none.

    Raises
    ------
    UsageError
        It is there and is not one.
    """
    path = folder / INSIDE / NAME
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: cannot be read ({error}); --force begins anew") from None
    try:
        return _ledger(folder, json.loads(text))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError(f"{path}: is no ledger that can be read ({error}); --force begins anew") from None


def _ledger(folder: Path, tree: Any) -> Ledger:
    if tree["format"] != FORMAT:
        raise ValueError(f"format {tree['format']!r} found, expected {FORMAT}")
    return Ledger(
        folder,
        [str(log) for log in tree["logs"]],
        None if tree["trajectory"] is None else str(tree["trajectory"]),
        dict(tree["survey"]),
        {str(name): _mark(value) for name, value in tree["files"].items()},
        {str(name): _entry(value) for name, value in tree["steps"].items()},
        {str(name): _entry(value) for name, value in tree["pending"].items()},
    )


def sweep(folder: Path) -> None:
    """Remove what processes left half-written that are gone: files and folders `.NAME.PID.part`."""
    for place in (folder, folder / INSIDE):
        for path in place.glob(".*.part"):
            number = path.name.removesuffix(".part").rpartition(".")[2]
            if not number.isdecimal() or (int(number) != os.getpid() and system.alive(int(number))):
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def folder_of(part: str) -> str:
    """Folder of a part within that of its step."""
    return part or "whole"


def staging(folder: Path, step: str) -> Path:
    """The folder that a step of this process writes into."""
    return folder / INSIDE / f".{step}.{os.getpid()}.part"


def staged_by_anyone(folder: Path, step: str) -> Iterator[Path]:
    """Folders that a step wrote into, of this process or of one that died."""
    return (folder / INSIDE).glob(f".{step}.*.part")


def _plain(mark: Fingerprint) -> dict[str, Any]:
    return {"bytes": mark.size, "sha256": mark.digest, "seen": list(mark.seen)}


def _mark(tree: Mapping[str, Any]) -> Fingerprint:
    first, second, third = (int(value) for value in tree["seen"])
    return Fingerprint(int(tree["bytes"]), str(tree["sha256"]), (first, second, third))


def _plain_entry(entry: Entry) -> dict[str, Any]:
    outputs = {name: _plain(mark) for name, mark in entry.outputs.items()}
    return {"key": entry.key, "outputs": outputs, "finished": entry.finished, "seconds": round(entry.seconds, 3)}


def _entry(tree: Mapping[str, Any]) -> Entry:
    outputs = {_inside(name): _mark(value) for name, value in tree["outputs"].items()}
    return Entry(dict(tree["key"]), outputs, str(tree["finished"]), float(tree["seconds"]))


def _inside(name: str) -> str:
    """The name of an output, which must lie within the folder: a ledger from elsewhere may not point out of it."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.parts:
        raise ValueError(f"output {name!r} lies outside of the folder")
    return name


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes out of a folder; the system lets go when this one ends, however it ends.

    Raises
    ------
    UsageError
        Another process works there.
    """
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(system.locked(folder))
        except BlockingIOError:
            raise UsageError(f"{folder}: another process is at work there") from None
        yield
