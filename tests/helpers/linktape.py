"""A MAVLink link of swathd alone, with what it hands over."""

import time
from collections.abc import Callable

from flightlog import records
from onboard.autopilot import Link
from onboard.config import LinkConfig
from onboard.timesync import LogTime, read_clocks


class Tape:
    """What a link handed over."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, int, bytes]] = []
        self.log_time = LogTime.start(read_clocks())

    def put(self, topic: str, log_time_ns: int, data: bytes, vital: bool) -> bool:
        assert vital
        self.messages.append((topic, log_time_ns, data))
        return True

    def link(self, device: str, **more: object) -> Link:
        return Link("ins", LinkConfig(device, **more), self.log_time, self.put)  # type: ignore[arg-type]

    def bytes(self) -> bytes:
        return b"".join(chunk for _, _, data in self.messages for _, chunk in records.decode_raw(data))


def until(condition: Callable[[], bool], seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)
