"""What was received in several recordings, each thing with its time: events, and the messages of a log made of them."""

from typing import NamedTuple


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
