"""Flight logs from the aircraft: over SSH, resumable, verified against its manifest, then acknowledged."""

import hashlib
import json
import os
import re
import shlex
import subprocess
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from flightlog.errors import SwathError, UsageError

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
            done = subprocess.run(words, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=120)
        except FileNotFoundError:
            raise PullError("ssh: is not installed here; apt install openssh-client") from None
        except subprocess.TimeoutExpired:
            raise PullError(f"{self.host}: no answer to `{command[:40]}` within 120 s") from None
        if done.returncode not in accept:
            raise PullError(f"{self.host}: {_last_line(done.stderr) or f'exit code {done.returncode}'}")
        return done.stdout


def armed(vehicle: Vehicle) -> bool | None:
    """Whether the aircraft is armed; None where it does not know. PullError if it cannot be reached."""
    try:
        answer = json.loads(vehicle.ask("health --json", accept=(0, 1, 2)))
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
    found = {}
    for number, line in enumerate(vehicle.ask("manifest").splitlines(), 1):
        try:
            segment = _segment(json.loads(line))
        except (ValueError, KeyError, TypeError):
            raise PullError(f"{vehicle.host}: line {number} of its manifest is none: {line[:60]!r}") from None
        found[segment.name] = segment  # a later line of the same file replaces an earlier one
    return list(found.values())


def _segment(tree: dict[str, Any]) -> Segment:
    name, size, sha256 = tree["file"], tree["size"], tree["sha256"]
    if not _NAME.fullmatch(name) or not isinstance(size, int) or size < 0 or not _SHA256.fullmatch(sha256):
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
    try:
        done = subprocess.run(words, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    except FileNotFoundError:
        raise PullError("rsync: is not installed here; apt install rsync") from None
    if done.returncode:
        reason = _last_line(done.stderr.replace("\nrsync error", "\n#")) or f"rsync ended with {done.returncode}"
        broken = PullError if done.returncode in _OF_THE_FILE else LinkError
        raise broken(f"{segment.name}: {reason}; the next pull goes on from here")


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
    return lines[-1] if lines else ""
