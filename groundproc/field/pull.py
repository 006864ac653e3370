"""Flight logs from the aircraft: over SSH, resumable, verified against its manifest, then acknowledged."""

import hashlib
import json
import os
import re
import shlex
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from flightlog.errors import SwathError, UsageError
from flightlog.words import clean
from groundproc.field import bounded

INCOMING: Final = ".incoming"
"""Folder of what is not verified yet."""
_NAME: Final = re.compile(r"[0-9A-Za-z][0-9A-Za-z_-]*\.mcap(\.[a-z]+)?")
_SHA256: Final = re.compile(r"[0-9a-f]{64}")
_SILENT_S: Final = 30
"""A link that moves nothing for this long is broken."""
_CHUNK: Final = 1 << 20
_OF_THE_FILE: Final = (11, 23, 24)
"""Exit codes of rsync that tell of this file and not of the link."""
_ACK_BATCH: Final = 500
_ASK_S: Final = 120.0
_ANSWER_BYTES: Final = 32 << 20
"""Of an answer; a manifest has some 600 bytes a segment."""
_LINE_BYTES: Final = 1 << 16
_MOST_SEGMENTS: Final = 50_000
_LARGEST_BYTES: Final = 1 << 40
"""Of a segment; aboard they end at 64 GB."""
_SLOWEST_BYTES_S: Final = 2_000
"""A transfer that is slower on the whole is given up."""
_LEAST_FETCH_S: Final = 600.0
_FREE_BYTES: Final = 64 << 20
"""Left free on the disk here."""


class PullError(SwathError):
    """The aircraft could not be reached, or gave what it should not."""


class LinkError(PullError):
    """The link broke; what comes next would fail as well."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A closed segment on the aircraft, as its manifest has it."""

    name: str
    size: int
    sha256: str
    acknowledged: bool = False


@dataclass(frozen=True, slots=True)
class Vehicle:
    """How to reach the aircraft.

    Attributes
    ----------
    host : str
        USER@HOST, or a name of the SSH configuration.
    port, identity, ssh_config
        As for ssh; None leaves it to its configuration.
    """

    host: str
    port: int | None = None
    identity: Path | None = None
    ssh_config: Path | None = None

    def __post_init__(self) -> None:
        if not self.host or self.host.startswith("-") or not re.fullmatch(r"[\w.@%-]+", self.host):
            raise UsageError(f"{self.host!r} found, expected USER@HOST")

    def ssh(self) -> list[str]:
        """The words that begin an SSH command, without the host."""
        words = ["ssh", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10"]
        words += ["-o", "ServerAliveInterval=10", "-o", "ServerAliveCountMax=3"]
        words += ["-F", str(self.ssh_config)] if self.ssh_config else []
        words += ["-p", str(self.port)] if self.port else []
        return words + (["-i", str(self.identity), "-o", "IdentitiesOnly=yes"] if self.identity else [])

    def ask(self, command: str, accept: Iterable[int] = (0,)) -> str:
        """Answer of the gate to a command; PullError where it gives none."""
        words = [*self.ssh(), "--", self.host, command]
        try:
            done = bounded.run(words, most_bytes=_ANSWER_BYTES, seconds=_ASK_S)
        except FileNotFoundError:
            raise PullError("ssh: is not installed here; apt install openssh-client") from None
        except bounded.TooLateError:
            raise PullError(f"{self.host}: no answer to `{command[:40]}` within {_ASK_S:.0f} s") from None
        except bounded.TooMuchError:
            raise PullError(
                f"{self.host}: more than {_ANSWER_BYTES >> 20} MB came for `{command[:40]}`, expected far less; is it a swathd?"
            ) from None
        if done.code not in accept:
            raise PullError(f"{self.host}: {_last_line(done.errors) or f'exit code {done.code}'}")
        return done.output.decode("utf-8", errors="replace")


def _parsed(text: str) -> Any:
    """What JSON of another machine says; ValueError where it is none, however long or deep it goes."""
    if len(text) > _LINE_BYTES:
        raise ValueError("too long")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("too deep") from None


def armed(vehicle: Vehicle) -> bool | None:
    """Whether the aircraft is armed; None where it does not know. PullError if it cannot be reached."""
    try:
        answer = _parsed(vehicle.ask("health --json", accept=(0, 1, 2)))
    except ValueError:
        return None
    found = answer.get("armed") if isinstance(answer, dict) else None
    return found if isinstance(found, bool) else None


def check_disarmed(vehicle: Vehicle, anyway: bool) -> None:
    """Refuse to load the radio and the card of an aircraft that may fly.

    Raises
    ------
    PullError
        It is armed, or that is not known and `anyway` is not set.
    """
    state = armed(vehicle)
    if state:
        raise PullError(f"{vehicle.host}: is armed; pull after landing")
    if state is None and not anyway:
        raise PullError(
            f"{vehicle.host}: whether it is armed is not known (no fresh word of an autopilot); --anyway goes on"
        )


def segments(vehicle: Vehicle) -> list[Segment]:
    """The closed segments on the aircraft; PullError where its manifest is not one."""
    found: dict[str, Segment] = {}
    for number, line in enumerate(vehicle.ask("manifest").splitlines(), 1):
        try:
            segment = _segment(_parsed(line))
        except (ValueError, KeyError, TypeError):
            shown = clean(line, 60)
            raise PullError(f"{vehicle.host}: line {number} of its manifest is none: {shown}") from None
        found[segment.name] = segment  # a later line of the same file replaces an earlier one
        if len(found) > _MOST_SEGMENTS:
            raise PullError(f"{vehicle.host}: its manifest names more than {_MOST_SEGMENTS} segments")
    return list(found.values())


def _segment(tree: dict[str, Any]) -> Segment:
    name, size, sha256 = tree["file"], tree["size"], tree["sha256"]
    is_size = type(size) is int and 0 <= size <= _LARGEST_BYTES
    if not is_size or not _NAME.fullmatch(name) or not _SHA256.fullmatch(sha256):
        raise ValueError(name)
    return Segment(name, size, sha256, tree.get("acknowledged") is True)


def sha256(path: Path) -> str:
    """SHA-256 sum of a file, in hexadecimal."""
    total = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            total.update(chunk)
    return total.hexdigest()


def _same(path: Path, segment: Segment) -> bool:
    return path.is_file() and path.stat().st_size == segment.size and sha256(path) == segment.sha256


Say = Callable[[str], None]


def fetch(vehicle: Vehicle, segment: Segment, directory: Path, say: Say, quiet: bool = True) -> bool:
    """Bring one segment here, unless it is here already.

    What an earlier pull left of it is gone on with. It gets its name in `directory` only when its sum is the manifest's.

    Parameters
    ----------
    vehicle : Vehicle
    segment : Segment
    directory : Path
    say : callable
        Told what happens, one sentence each.
    quiet : bool
        Without rsync's own progress.

    Returns
    -------
    bool
        Whether it had to be brought.

    Raises
    ------
    PullError
        The link broke, the aircraft has something else than its manifest says, or another file of this name is here.
    """
    final, part = directory / segment.name, directory / INCOMING / segment.name
    if final.exists():
        if _same(final, segment):
            return False
        raise PullError(
            f"{final}: another file than {vehicle.host} has by this name; give each aircraft a folder of its own (-o)"
        )
    part.parent.mkdir(parents=True, exist_ok=True)
    if part.exists() and part.stat().st_size > segment.size:
        part.unlink()  # of another flight
    if part.exists() and part.stat().st_size:
        say(f"{segment.name}: goes on at {part.stat().st_size / 1e6:.1f} of {segment.size / 1e6:.1f} MB")
    _rsync(vehicle, segment, part, ["--append-verify"], quiet)
    if not _same(part, segment):
        say(f"{segment.name}: the sum is wrong; what differs is brought again")
        _rsync(vehicle, segment, part, ["--checksum", "--inplace", "--no-whole-file"], quiet)
    if not _same(part, segment):
        raise PullError(
            f"{segment.name}: on {vehicle.host} it is not what its manifest says; not acknowledged, kept as {part}"
        )
    _settle(part, final)
    return True


def _settle(part: Path, final: Path) -> None:
    """Give a file its name, when it is on the disk: once acknowledged, the aircraft may delete its own."""
    _sync(part)
    part.replace(final)
    _sync(final.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _rsync(vehicle: Vehicle, segment: Segment, part: Path, how: list[str], quiet: bool) -> None:
    words = ["rsync", "--times", "--partial", f"--timeout={_SILENT_S}", *how, "--rsh", shlex.join(vehicle.ssh())]
    words += [] if quiet else ["--info=progress2"]
    words += ["--", f"{vehicle.host}:{segment.name}", str(part)]
    seconds = max(_LEAST_FETCH_S, segment.size / _SLOWEST_BYTES_S)
    try:
        done = bounded.run(words, most_bytes=1 << 20, seconds=seconds, file_bytes=segment.size + 1, shown=not quiet)
    except FileNotFoundError:
        raise PullError("rsync: is not installed here; apt install rsync") from None
    except (bounded.TooLateError, bounded.TooMuchError):
        raise LinkError(f"{segment.name}: not here after {seconds:.0f} s; the next pull goes on from here") from None
    if part.exists() and part.stat().st_size > segment.size:
        part.unlink()
        raise PullError(f"{segment.name}: {vehicle.host} sends more than the {segment.size} bytes of its manifest")
    if done.code:
        reason = _last_line(done.errors.replace("\nrsync error", "\n#")) or f"rsync ended with {done.code}"
        broken = PullError if done.code in _OF_THE_FILE else LinkError
        raise broken(f"{segment.name}: {reason}; the next pull goes on from here")


def check_space(there: list[Segment], directory: Path) -> None:
    """See that there is room for all that is to come, before anything comes.

    Raises
    ------
    PullError
        There is not.
    """
    missing = 0
    for segment in there:
        if not (directory / segment.name).exists():
            part = directory / INCOMING / segment.name
            missing += segment.size - min(segment.size, part.stat().st_size if part.exists() else 0)
    free = shutil.disk_usage(directory).free
    if missing and missing + _FREE_BYTES > free:
        raise PullError(
            f"{directory}: {missing / 1e9:.2f} GB are to come and {free / 1e9:.2f} GB are free; make room or name another folder (-o)"
        )


def acknowledge(vehicle: Vehicle, those: list[Segment]) -> None:
    """Tell the aircraft that these are safe here, so that it may delete them when it needs room; PullError if it cannot be told."""
    for begin in range(0, len(those), _ACK_BATCH):
        vehicle.ask(" ".join(["ack", *(segment.sha256 for segment in those[begin : begin + _ACK_BATCH])]))


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a pull did."""

    brought: list[Segment]
    here: list[Segment]
    """Were here before."""
    acknowledged: int
    troubles: list[str]


def pull(vehicle: Vehicle, directory: Path, say: Say, *, anyway: bool = False, quiet: bool = True) -> Outcome:
    """Bring every closed segment that is not here yet, verify all, acknowledge what is right.

    Raises
    ------
    PullError
        Nothing could be done; the trouble of a single segment is in the outcome.
    """
    check_disarmed(vehicle, anyway)
    there = segments(vehicle)
    check_space(there, directory)
    brought: list[Segment] = []
    here: list[Segment] = []
    troubles: list[str] = []
    for segment in there:
        try:
            (brought if fetch(vehicle, segment, directory, say, quiet) else here).append(segment)
        except PullError as error:
            troubles.append(str(error))
            if isinstance(error, LinkError):
                break
    new = [segment for segment in [*brought, *here] if not segment.acknowledged]
    try:
        acknowledge(vehicle, new)
    except PullError as error:
        troubles.append(str(error))
        new = []
    return Outcome(brought, here, len(new), troubles)


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return clean(lines[-1], 300) if lines else ""
