"""What every recording is to an import: read once as a stream of events, with what was found in it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

from groundproc.flight.importers.joining import Event
from groundproc.flight.importers.starting import Start
from groundproc.flight.importers.steady import Steady


class Source(Protocol):
    """One recording."""

    path: Path
    kind: str

    @property
    def mavlink_frames(self) -> int:
        """Good MAVLink frames taken of it."""

    def events(self) -> Iterator[Event]:
        """What was received, each thing with its time, which never steps back."""

    def facts(self) -> dict[str, Any]:
        """What it was and what was found in it, for the log's metadata; complete once it has been read."""

    def notes(self) -> list[str]:
        """Sentences on what was not as it should be."""

    def close(self) -> None:
        """Close the file."""


class Timed(Source, Protocol):
    """A recording whose stamps are times of reception."""

    steady: Steady

    def start(self) -> Start | None:
        """What the first stamps say; None where there are none."""


def facts_of(source: Source, size: int, sha256: str, counters: dict[str, Any]) -> dict[str, Any]:
    """Name, size, hash and counters of a source."""
    return {
        "name": source.path.name,
        "kind": source.kind,
        "bytes": size,
        "sha256": sha256,
        "counters": {name: value for name, value in counters.items() if not name.startswith("_")},
    }
