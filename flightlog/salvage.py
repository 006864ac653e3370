"""Makes a whole log of a cut or damaged one and reports exactly what was lost. Used aboard and on the ground."""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from flightlog.errors import LogError
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter

SALVAGE: Final = "swath.salvage"
"""Metadata that marks a log which was made so."""
_OURS: Final = frozenset(("swath.log", "swath.topics"))
"""Metadata that the writer adds by itself."""


@dataclass(frozen=True, slots=True)
class Salvage:
    """What was found in a log."""

    truncated: bool
    """The footer was missing: the writer was cut off."""
    bad_chunks: int
    lost_bytes: int
    places: tuple[str, ...]
    """One phrase for each damaged place, the first twenty."""
    messages: Mapping[str, int] = field(default_factory=dict)
    """What could be read, by topic."""
    start_ns: int = 0
    end_ns: int = 0
    """Log time of the first and last of it [ns]."""
    torn_tail_only: bool = True
    """Nothing but the end of the file is damaged, as after a power cut."""

    @property
    def lossy(self) -> bool:
        """Whether bytes of the log are gone."""
        return self.bad_chunks > 0 or self.lost_bytes > 0

    @property
    def whole(self) -> bool:
        """Whether there was nothing to mend."""
        return not (self.truncated or self.lossy)

    def sentences(self) -> list[str]:
        """What to tell a person."""
        found = f"{sum(self.messages.values()):,} messages over {(self.end_ns - self.start_ns) / 1e9:.3f} s"
        if self.whole:
            return [f"{found}; the log is whole"]
        lines = [f"{found} recovered" + ("; the log was cut off" if self.truncated else "")]
        if self.lossy:
            lines.append(f"lost: {self.lost_bytes:,} bytes, {self.bad_chunks} damaged chunks")
            lines += [f"  {place}" for place in self.places]
        else:
            lines.append("nothing that was in the file is lost; only its index was missing")
        return lines

    def to_mapping(self) -> dict[str, Any]:
        """Plain values, for a manifest."""
        return {
            "truncated": self.truncated,
            "bad_chunks": self.bad_chunks,
            "lost_bytes": self.lost_bytes,
            "places": list(self.places),
        }


def examine(source: Path, progress: Callable[[int], None] | None = None) -> Salvage:
    """Read a log through, every checksum included; see `salvage` for the errors."""
    return _go_through(source, lambda log: None, progress)


def salvage(
    source: Path, target: Path, *, compression: str = "zstd", progress: Callable[[int], None] | None = None
) -> Salvage:
    """Write what can be read of a log to a new one: damaged chunks left out, summary and index made anew, synced to the disk.

    Parameters
    ----------
    source : Path
        Is not changed.
    target : Path
        Must not exist. Taken away again if the work fails.
    compression : str
        See LogWriter.
    progress : callable, optional
        Called with the number of bytes of the source done since the last call.

    Raises
    ------
    LogError
        The source is no flight log, or the target cannot be written.
    """
    try:
        stream = target.open("xb", buffering=0)
    except OSError as error:
        raise LogError(f"{target}: cannot be written ({error.strerror})") from None
    try:
        with stream:
            out = _Out(stream, compression)
            found = _go_through(source, out.begin, progress, out)
            out.writer.add_metadata(SALVAGE, {"source": source.name, "found": json.dumps(found.to_mapping())})
            out.writer.finish()
            os.fsync(stream.fileno())
    except OSError as error:
        target.unlink(missing_ok=True)
        raise LogError(f"{target}: cannot be written ({error.strerror})") from None
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    return found


class _Out:
    """The new log."""

    def __init__(self, stream: Any, compression: str) -> None:
        self._stream, self._compression = stream, compression

    def begin(self, log: LogReader) -> None:
        """Write what stands at the head of a log."""
        self.writer = LogWriter(
            self._stream,
            metadata={name: values for name, values in log.metadata.items() if name not in _OURS},
            attachments=log.attachments,
            library="swath recover",
            compression=self._compression,
        )


def _go_through(
    source: Path, begin: Callable[[LogReader], None], progress: Callable[[int], None] | None, out: _Out | None = None
) -> Salvage:
    counts: dict[str, int] = {}
    start_ns = end_ns = 0
    with LogReader(source) as log:
        begin(log)
        for message in log.messages(None, progress):
            topic, time_ns, data = message
            if not counts:
                start_ns = end_ns = time_ns
            counts[topic] = counts.get(topic, 0) + 1
            start_ns, end_ns = min(start_ns, time_ns), max(end_ns, time_ns)
            if out is not None:
                out.writer.write(topic, time_ns, bytes(data))
        damage = log.damage
        return Salvage(
            damage.truncated,
            damage.bad_chunks,
            damage.lost_bytes,
            tuple(damage.places),
            counts,
            start_ns,
            end_ns,
            torn_tail_only=damage.count == 0 or (damage.count == 1 and damage.reaches == log.size),
        )
