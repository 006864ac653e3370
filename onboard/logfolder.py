"""The folder of the flight logs: names, the manifest of what is finished, the space that is left."""

import contextlib
import hashlib
import json
import logging
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Final

from flightlog.errors import LogError

_log = logging.getLogger(__name__)

MANIFEST: Final = "manifest.jsonl"
ACKNOWLEDGED: Final = "acknowledged.jsonl"
READ_ONLY: Final = 0o444
_NAME: Final = re.compile(r"(\d{5,})-(\d{3,})\.mcap")
"""Boot and segment; both have as many digits as it takes."""
_RESERVE: Final = ".reserve"
_RESERVE_BYTES: Final = 4 << 20
_READ_BYTES: Final = 1 << 20


# Names ----------------------------------------------------------------------------------------------------------------


def next_segment_path(directory: Path, boot_id: str) -> Path:
    """Path of the next segment: boot counter and a number within the boot, because dates cannot be trusted aboard.

    The counter outlives the logs in `boot.json` of the folder.

    Raises
    ------
    LogError
        The folder cannot be made or written to.
    """
    state = directory / "boot.json"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        names = {path.name for path in directory.iterdir()} | set(read_manifest(directory))
        taken = [numbers for name in names if (numbers := _numbers(name)) is not None]
        last_id, last = _last_boot(state)
        newest = max([last, *(boot for boot, _ in taken)])
        boot = last if boot_id == last_id and last == newest else newest + 1
        if (boot_id, boot) != (last_id, last):
            write_atomically(state, json.dumps({"boot_id": boot_id, "number": boot}))
    except OSError as error:
        raise LogError(f"{directory}: logs cannot be written there ({error.strerror})") from error
    segment = 1 + max((number for of_boot, number in taken if of_boot == boot), default=-1)
    return directory / f"{boot:05d}-{segment:03d}.mcap"


def _numbers(name: str) -> tuple[int, int] | None:
    """Boot and segment in a file's name, that of a damaged original too; None for other files."""
    match = _NAME.match(name)
    return None if match is None else (int(match[1]), int(match[2]))


def in_order(names: Iterable[str]) -> list[str]:
    """Names of segments in the order of their numbers, and others behind them: as texts, 1000 would come before 999."""
    return sorted(names, key=lambda name: (_numbers(name) is None, _numbers(name) or (0, 0), name))


def _last_boot(state: Path) -> tuple[str, int]:
    with contextlib.suppress(FileNotFoundError, ValueError, KeyError, TypeError):
        tree = json.loads(state.read_text(encoding="utf-8"))
        return str(tree["boot_id"]), int(tree["number"])
    return "", 0


def write_atomically(path: Path, text: str, *, sync: bool = True) -> None:
    """Replace a file so that a reader, or a power cut, finds the old text or the new one."""
    temporary = f"{path.parent}/.{path.name}.new"
    with open(temporary, "wb", buffering=0) as file:  # noqa: PTH123 - each second, and paths as objects take most of the time
        os.fchmod(file.fileno(), 0o644)  # whoever may enter the folder may read it, whatever the umask
        data = memoryview(text.encode())
        while data:
            data = data[file.write(data) :]
        if sync:
            os.fsync(file.fileno())
    os.replace(temporary, path)  # noqa: PTH105 - each second, and a path as an object costs most of the time
    if sync:
        sync_directory(path.parent)


def sync_directory(directory: Path) -> None:
    """Force the names in a folder on to the disk."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# Manifest -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Entry:
    """A line of the manifest: one finished file."""

    file: str
    size: int
    sha256: str
    messages: Mapping[str, int]
    """By topic."""
    first_ns: int
    last_ns: int
    """Log time of the first and the last message [ns]."""
    boot_id: str
    how: str
    """`closed` by the recorder, `salvaged` after it was cut off, found `whole`, or a `damaged` original beside a salvaged one."""
    drops: Mapping[str, int] = field(default_factory=dict)
    """Messages that did not get into it, by reason."""
    lost: Mapping[str, Any] = field(default_factory=dict)
    """What a salvage could not read."""


def append_to_manifest(directory: Path, line: Mapping[str, Any]) -> None:
    """Add a line, synced; after one that a power cut tore, a new one is begun."""
    with (directory / MANIFEST).open("a+b") as file:
        file.seek(0, os.SEEK_END)
        if file.tell():
            file.seek(-1, os.SEEK_END)
        torn = file.read(1) not in (b"", b"\n")
        file.write(b"\n" * torn + json.dumps(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())
    sync_directory(directory)


def enter(directory: Path, entry: Entry) -> None:
    """Add a finished file to the manifest."""
    append_to_manifest(directory, asdict(entry))


def read_manifest(directory: Path) -> dict[str, dict[str, Any]]:
    """The newest line of each file; lines that a power cut tore are passed over."""
    return {str(line["file"]): line for line in _lines(directory / MANIFEST) if "file" in line}


def acknowledged(directory: Path) -> set[str]:
    """SHA-256 of the files that somebody has on the ground, verified."""
    return {str(line["sha256"]) for line in _lines(directory / ACKNOWLEDGED) if "sha256" in line}


def _lines(path: Path) -> list[dict[str, Any]]:
    found = []
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
            with contextlib.suppress(ValueError):
                tree = json.loads(text)
                if isinstance(tree, dict):
                    found.append(tree)
    return found


def sha256(path: Path, progress: Callable[[int], None] | None = None) -> str:
    """Checksum of a file; `progress` hears of each stretch read [bytes]."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(_READ_BYTES):
            digest.update(part)
            if progress is not None:
                progress(len(part))
    return digest.hexdigest()


def leftovers(directory: Path) -> list[Path]:
    """Segments that are in no manifest: their writer was cut off."""
    known = read_manifest(directory)
    names = (path.name for path in directory.glob("*.mcap") if _NAME.fullmatch(path.name) and path.name not in known)
    return [directory / name for name in in_order(names)]


# Space ----------------------------------------------------------------------------------------------------------------


class Space(Enum):
    """How much there is left, and so what is recorded."""

    ROOM = "room"
    LOW = "low"
    """The lidar is not recorded any more; MAVLink and clocks are."""
    FULL = "full"
    """Nothing is recorded; the log is closed."""


def space(free_bytes: int, floor_bytes: int, before: Space) -> Space:
    """Judge the space left: low below the floor, full below a quarter of it; better again only at one and a half times that."""
    if free_bytes < floor_bytes // 4 or (before is Space.FULL and free_bytes < floor_bytes * 3 // 8):
        return Space.FULL
    if free_bytes < floor_bytes or (before is not Space.ROOM and free_bytes < floor_bytes * 3 // 2):
        return Space.LOW
    return Space.ROOM


def free_bytes(directory: Path) -> int:
    """What may still be written to the file system of a folder."""
    disk = os.statvfs(directory)
    return disk.f_bavail * disk.f_frsize


def hold_reserve(directory: Path) -> None:
    """Reserve some space, so that a log can be closed on a disk that another program filled."""
    try:
        with (directory / _RESERVE).open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, _RESERVE_BYTES)
    except OSError:  # it is full already, or cannot do this: then there is none
        release_reserve(directory)


def release_reserve(directory: Path) -> None:
    """Give that space back."""
    (directory / _RESERVE).unlink(missing_ok=True)


def prune(directory: Path, enough: Callable[[], bool]) -> list[str]:
    """Delete the oldest segments that are on the ground, acknowledged, until there is enough space; gives their names.

    Segments that nobody acknowledged are never deleted.
    """
    safe = acknowledged(directory)
    gone = []
    lines = read_manifest(directory)
    for name in in_order(lines):
        line = lines[name]
        if enough():
            break
        path = directory / Path(name).name
        if line.get("sha256") in safe and path.exists():
            path.unlink()
            append_to_manifest(directory, {"file": name, "pruned": line["sha256"]})
            _log.warning("%s deleted to make room; it was acknowledged", name)
            gone.append(name)
    return gone
