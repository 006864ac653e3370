"""A thread that must make progress: it reports progress, and its death is noticed."""

import logging
import threading
import time
from abc import ABC, abstractmethod

from flightlog.errors import SwathError
from onboard.journal import event

_log = logging.getLogger(__name__)


class Worker(threading.Thread, ABC):
    """Base of the daemon's threads.

    Attributes
    ----------
    progress_ns : int
        When it last reported progress [ns of the monotonic clock].
    failure : str or None
        One sentence, once it has died.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name=name, daemon=True)
        self.progress_ns = time.monotonic_ns()
        self.failure: str | None = None
        self._stop_asked = threading.Event()

    @abstractmethod
    def work(self) -> None:
        """Do the thread's work until `stopping`."""

    @property
    def stopping(self) -> bool:
        """Whether it was asked to end."""
        return self._stop_asked.is_set()

    def progress(self) -> None:
        """Report progress."""
        self.progress_ns = time.monotonic_ns()

    def stop(self, timeout_s: float = 10.0) -> None:
        """Ask it to end and wait for that."""
        self._stop_asked.set()
        if self.ident is not None:
            self.join(timeout_s)

    def pause(self, seconds: float) -> None:
        """Wait, but not longer than until `stop`."""
        self._stop_asked.wait(seconds)

    def run(self) -> None:
        """Work; any error is kept in `failure`."""
        try:
            self.work()
        except SwathError as error:
            self.failure = f"{self.name}: {error}"
            _log.error("%s", self.failure, extra=event("failure", worker=self.name))
        except OSError as error:  # a disk or a device, not a mistake of ours
            self.failure = f"{self.name}: {error.strerror or error}"
            _log.error("%s", self.failure, extra=event("failure", worker=self.name))
        except Exception as error:  # the top of a thread: the failure is kept, and the watchdog no longer stroked
            self.failure = f"{self.name}: {type(error).__name__}: {error}"
            _log.exception("%s died", self.name, extra=event("failure", worker=self.name))
