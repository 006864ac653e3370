"""Spans of time as people write them: START/END, each seconds of a flight or UTC, either left open."""

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import UsageError

_NS: Final = 1_000_000_000
_OPEN_NS: Final = (-(1 << 62), 1 << 62)
_LONGEST_S: Final = 1e9
EXAMPLE: Final = "START/END such as 60/480, 60/ or 2026-05-01T10:02:00Z/2026-05-01T10:09:30Z"


def spans_ns(texts: Sequence[str], start_ns: int, what: str = "times") -> npt.NDArray[np.int64]:
    """Spans, shape (k, 2) [ns UTC]: first instant and the one after the last.

    Parameters
    ----------
    texts : sequence of str
        Seconds count from `start_ns`. UTC is ISO 8601; without an offset from it, it is UTC.
    start_ns : int
        UTC.
    what : str
        Names the option in an error.

    Raises
    ------
    UsageError
        A text is no span, or one that ends before it begins.
    """
    found = []
    for text in texts:
        parts = text.split("/")
        if len(parts) != 2:
            raise UsageError(f"{what} {text!r}: expected {EXAMPLE}")
        begin, end = (
            _instant(part.strip(), start_ns, otherwise, f"{what} {text!r}")
            for part, otherwise in zip(parts, _OPEN_NS, strict=True)
        )
        if end <= begin:
            raise UsageError(f"{what} {text!r}: ends before it begins; expected {EXAMPLE}")
        found.append((begin, end))
    return np.array(found, np.int64).reshape(-1, 2)


def _instant(text: str, start_ns: int, otherwise: int, what: str) -> int:
    if not text:
        return otherwise
    try:
        seconds = float(text)
    except ValueError:
        return _utc_ns(text, what)
    if not (math.isfinite(seconds) and abs(seconds) < _LONGEST_S):
        raise UsageError(f"{what}: {text} s found, expected seconds of the flight; {EXAMPLE}")
    return start_ns + round(seconds * _NS)


def _utc_ns(text: str, what: str) -> int:
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        raise UsageError(f"{what}: {text!r} is neither seconds nor UTC; expected {EXAMPLE}") from None
    found = found.astimezone(UTC) if found.tzinfo else found.replace(tzinfo=UTC)
    since = found - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * _NS + since.microseconds * 1000
