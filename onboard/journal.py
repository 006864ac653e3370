"""The daemon's log messages: to the journal with fields that can be searched for, elsewhere as lines of text.

`journalctl SWATH_EVENT=hang` finds the message of `_log.error(..., extra=event("hang", worker="lidar"))`, and `-o
json` shows SWATH_WORKER.
"""

import logging
import os
import sys
from pathlib import Path
from typing import Any, Final

from flightlog.words import clean, clean_lines

try:
    from systemd.journal import send as _send
except ImportError:
    _send = None

_FIELDS: Final = "swath_fields"
_PRIORITIES: Final = (
    (logging.CRITICAL, 2),
    (logging.ERROR, 3),
    (logging.WARNING, 4),
    (logging.INFO, 6),
)
_DEBUG: Final = 7
_MOST_LINES: Final = 200
"""Of a record, a traceback with it."""


def event(name: str, **fields: object) -> dict[str, Any]:
    """Fields of a message, for `extra` of a logging call: SWATH_EVENT=name and each of the others as SWATH_NAME."""
    named = {"SWATH_EVENT": name} | {f"SWATH_{key.upper()}": str(value) for key, value in fields.items()}
    return {_FIELDS: named}


def priority(level: int) -> int:
    """Priority of syslog(3) for a level of `logging`."""
    return next((number for limit, number in _PRIORITIES if level >= limit), _DEBUG)


def fields(record: logging.LogRecord) -> dict[str, str | int]:
    """Fields of the journal for a record, the message excepted."""
    return {
        "PRIORITY": str(priority(record.levelno)),
        "CODE_FILE": record.pathname,
        "CODE_LINE": record.lineno,
        "CODE_FUNC": record.funcName or "",
        "SYSLOG_IDENTIFIER": "swathd",
        "SWATH_THREAD": record.threadName or "",
        **getattr(record, _FIELDS, {}),
    }


class JournalHandler(logging.Handler):
    """Sends records to the journal by its own protocol."""

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record; a journal that is away must not hold the daemon up, so standard error gets it instead."""
        assert _send is not None
        try:
            text = "\n".join(clean_lines(self.format(record), _MOST_LINES))
            _send(text, **fields(record))
        except OSError:
            sys.stderr.write(f"<{priority(record.levelno)}>{clean(record.getMessage())}\n")
        except Exception:  # as every logging handler: what is wrong with a record must not end who logs it
            self.handleError(record)


class PriorityFormatter(logging.Formatter):
    """Lines for a journal that reads our standard error: each begins with its priority, sd-daemon(3)."""

    def format(self, record: logging.LogRecord) -> str:
        """Format one record."""
        prefix = f"<{priority(record.levelno)}>"
        return "\n".join(prefix + line for line in clean_lines(super().format(record), _MOST_LINES))


class PlainFormatter(logging.Formatter):
    """Lines for a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """Format one record."""
        return "\n".join(clean_lines(super().format(record), _MOST_LINES))


def in_journal() -> bool:
    """Whether our standard error is the journal's, and not merely that of a shell started by a service."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return (device, inode) == (str(status.st_dev), str(status.st_ino))


def start(level: int = logging.INFO) -> None:
    """Send what is logged to where we were started from: journal or terminal."""
    handler: logging.Handler
    if not in_journal():
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(PlainFormatter("%(asctime)s %(levelname)s %(message)s"))
    elif _send is not None and Path("/run/systemd/journal/socket").exists():
        handler = JournalHandler()
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(PriorityFormatter())
    logging.basicConfig(level=level, handlers=[handler])
