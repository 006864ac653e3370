"""What a key of the pull may do here: see the health, read the manifest and flight logs, acknowledge them. No more."""

import fcntl
import json
import os
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from flightlog.errors import LogError, UsageError
from onboard import logfolder

_SHA256: Final = re.compile(r"[0-9a-f]{64}")
_WRITABLE: Final = 0o222
_MAX_WORDS: Final = 2000


class RefusedError(UsageError):
    """A command that the key is not good for."""

    exit_code = 126


@dataclass(frozen=True, slots=True)
class Wish:
    """What the other side may have: `health`, `health --json`, `manifest`, `rsync` or `ack`."""

    verb: str
    words: tuple[str, ...] = ()


def wish(command: str) -> Wish:
    """Understand the command of an SSH client; RefusedError where it is none of those allowed."""
    refused = RefusedError(
        f"{command[:80]!r} refused: health [--json], manifest, ack SHA256... and reading rsync are allowed"
    )
    try:
        words = shlex.split(command)
    except ValueError:
        raise refused from None
    match words:
        case ["health"] | ["health", "--json"] | ["manifest"]:
            return Wish(words[0], tuple(words[1:]))
        case ["rsync", "--server", "--sender", *_]:
            return Wish("rsync")
        case ["ack", *sums] if 0 < len(sums) <= _MAX_WORDS and all(map(_SHA256.fullmatch, sums)):
            return Wish("ack", tuple(sums))
    raise refused


def manifest(directory: Path) -> list[dict[str, Any]]:
    """Lines of the manifest whose segments are here and closed, each with `acknowledged`, whether somebody has it.

    Raises
    ------
    LogError
        The folder cannot be read.
    """
    try:
        safe = logfolder.acknowledged(directory)
        lines = logfolder.read_manifest(directory)
    except OSError as error:
        raise LogError(f"{directory}: cannot be read ({error.strerror})") from None
    return [
        {**line, "acknowledged": line["sha256"] in safe}
        for name, line in lines.items()
        if "sha256" in line and _closed(directory / Path(name).name)
    ]


def _closed(segment: Path) -> bool:
    """Whether a segment is there and complete: those are read-only."""
    try:
        return segment.is_file() and not segment.stat().st_mode & _WRITABLE
    except OSError:
        return False


def acknowledge(directory: Path, sums: tuple[str, ...]) -> int:
    """Note that somebody has the segments with these SHA-256 sums, safely on the disk; gives how many were new.

    Raises
    ------
    RefusedError
        A sum is not in the manifest.
    LogError
        It cannot be noted.
    """
    files = {line["sha256"]: name for name, line in logfolder.read_manifest(directory).items() if "sha256" in line}
    if unknown := [one for one in sums if one not in files]:
        raise RefusedError(f"ack {unknown[0]}: no segment of the manifest has this sum")
    path = directory / logfolder.ACKNOWLEDGED
    try:
        with path.open("a", encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            known = logfolder.acknowledged(directory)
            new = [one for one in dict.fromkeys(sums) if one not in known]
            file.writelines(json.dumps({"file": files[one], "sha256": one}) + "\n" for one in new)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise LogError(f"{path}: cannot be written ({error.strerror})") from None
    return len(new)
