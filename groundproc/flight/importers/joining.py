"""What was received in several recordings, each thing with its time: events, the messages of a log made of them, and steady times."""

from dataclasses import dataclass
from typing import Final, NamedTuple

from flightlog.constants import NS_PER_MS

_JITTER_NS: Final = 50 * NS_PER_MS
"""A smaller step back is packets out of order, a larger one is a clock that was set."""


class Event(NamedTuple):
    """Something received at one time."""

    time_ns: int
    topic: str
    data: bytes
    sender: bytes
    """Address (IPv4, IPv6), or the topic of a bag; empty for what did not come over the network."""


class LogMessage(NamedTuple):
    """A message ready for LogWriter.write."""

    topic: str
    log_time_ns: int
    data: bytes


@dataclass(slots=True)
class Steady:
    """Makes the times of one recording never step back.

    A clock that was set back while it recorded is carried on from where it was; packets a little out of order share a time.
    """

    out_of_order: int = 0
    steps_back: int = 0
    stepped_ns: int = 0
    first_ns: int | None = None
    last_ns: int = 0

    def __call__(self, time_ns: int) -> int:
        """The time to use for something stamped `time_ns` [ns]."""
        steady_ns = time_ns + self.stepped_ns
        if self.first_ns is None:
            self.first_ns = self.last_ns = steady_ns
        if steady_ns < self.last_ns:
            back_ns = self.last_ns - steady_ns
            if back_ns > _JITTER_NS:
                self.steps_back += 1
                self.stepped_ns += back_ns
            else:
                self.out_of_order += 1
            steady_ns = self.last_ns
        self.last_ns = steady_ns
        return steady_ns
