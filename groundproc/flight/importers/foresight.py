"""Small forward steps of a recording computer's clock, told from delays of a radio by what comes after them.

A radio may deliver messages 2 s late, so the first late message of a link cannot show whether the clock was set ahead
by as much. What follows shows it: a delay ends, or is uneven; after a step all messages are late by the same amount.
So a link is examined some seconds ahead. Larger steps, and steps back, need no foresight, nor do recordings with a
lidar, whose packets come in time.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Final, NamedTuple

from flightlog import records
from flightlog.constants import NS_PER_MS, NS_PER_S
from groundproc.flight.importers.devices import Reading, reading
from groundproc.flight.importers.joining import Event

_AHEAD_NS: Final = 10 * NS_PER_S
"""In recorded flights congestion of a radio lasted up to 7 s."""
_SMALL_NS: Final = (NS_PER_S // 2, 4 * NS_PER_S)
"""Steps that are told here: below, they are within what messages of one link differ by; above, no delay explains them."""
_FEWEST: Final = 8
_LEAST_NS: Final = 2 * NS_PER_S
"""So much on either side of a step."""
_SUDDEN: Final = 5
"""Messages around a step among which one is as fast as any."""
_EVEN_NS: Final = 100 * NS_PER_MS
"""Behind a step messages are no less even than before it, but for this."""
_MOST: Final = 20_000
"""Events that are held."""


class Foreseen(NamedTuple):
    """An event, the clock that its bytes tell of, and by how much the computer's clock was set ahead just before it [ns]."""

    event: Event
    read: Reading | None
    step_ns: int


@dataclass(slots=True)
class _Link:
    """The delays of the last messages of one autopilot, each beside its device's time [ns]."""

    past: deque[tuple[int, int]] = field(default_factory=deque)

    def add(self, device_ns: int, delay_ns: int) -> None:
        if self.past and abs(device_ns - self.past[-1][0]) > _AHEAD_NS:  # silence, or it began anew
            self.past.clear()
        self.past.append((device_ns, delay_ns))
        while self.past and device_ns - self.past[0][0] > _AHEAD_NS:
            self.past.popleft()


def foreseen(events: Iterable[Event]) -> Iterator[Foreseen]:
    """Events as they come, each with the small step ahead of the computer's clock that came before it, if any."""
    ahead: deque[tuple[Event, Reading | None]] = deque()
    links: dict[tuple[str, bytes], _Link] = {}
    stream = iter(events)
    for event in stream:
        ahead.append((event, reading(event)))
        if event.topic in (records.LIDAR.topic, records.POSITION.topic):
            break
        while ahead and (len(ahead) > _MOST or abs(event.time_ns - ahead[0][0].time_ns) > _AHEAD_NS + _SMALL_NS[1]):
            yield _judged(ahead, links)
    else:
        while ahead:
            yield _judged(ahead, links)
        return
    for event, read in ahead:
        yield Foreseen(event, read, 0)
    for event in stream:
        yield Foreseen(event, reading(event), 0)


def _judged(ahead: deque[tuple[Event, Reading | None]], links: dict[tuple[str, bytes], _Link]) -> Foreseen:
    """Take the first of the events."""
    event, read = ahead.popleft()
    if read is None or read.time_ns is None:
        return Foreseen(event, read, 0)
    link = links.setdefault(read.device, _Link())
    delay_ns = event.time_ns - read.time_ns
    step_ns = _step(link, (read.time_ns, delay_ns), _delays(ahead, read))
    if step_ns:
        link.past.clear()
    link.add(read.time_ns, delay_ns)
    return Foreseen(event, read, step_ns)


def _delays(ahead: Iterable[tuple[Event, Reading | None]], first: Reading) -> Iterator[tuple[int, int]]:
    """Device's times and delays of what follows a message of the same device, as far as it is looked ahead."""
    assert first.time_ns is not None
    for event, read in ahead:
        if read is None or read.time_ns is None or read.device != first.device:
            continue
        if read.time_ns - first.time_ns > _AHEAD_NS:
            return
        yield read.time_ns, event.time_ns - read.time_ns


def _step(link: _Link, now: tuple[int, int], following: Iterator[tuple[int, int]]) -> int:
    """By how much the computer's clock was set ahead before a message [ns]; 0 where it was not, or nothing tells."""
    past = link.past
    if len(past) < _FEWEST or past[-1][0] - past[0][0] < _LEAST_NS or abs(now[0] - past[-1][0]) > _LEAST_NS:
        return 0
    last_ns = min(delay_ns for _, delay_ns in islice(reversed(past), _SUDDEN))
    if not _SMALL_NS[0] <= now[1] - last_ns <= 2 * _SMALL_NS[1]:
        return 0
    fastest_ns = min(delay_ns for _, delay_ns in past)
    after = [now]
    for device_ns, delay_ns in following:
        if delay_ns - fastest_ns < _SMALL_NS[0]:  # it was a delay, and has ended
            return 0
        if delay_ns - fastest_ns > 2 * _SMALL_NS[1]:  # something else happened
            break
        after.append((device_ns, delay_ns))
    if len(after) < _FEWEST or after[-1][0] - now[0] < _LEAST_NS:
        return 0
    before = sorted(delay_ns for _, delay_ns in past)
    behind = sorted(delay_ns for _, delay_ns in after)
    first_ns = min(delay_ns for _, delay_ns in after[:_SUDDEN])
    spread_ns = before[len(before) // 2] - before[0]
    sudden = last_ns - before[0] <= spread_ns + _EVEN_NS and first_ns - behind[0] <= spread_ns + _EVEN_NS
    even = behind[len(behind) // 2] - behind[0] <= 2 * spread_ns + _EVEN_NS
    step_ns = behind[0] - before[0]
    return step_ns if sudden and even and step_ns <= _SMALL_NS[1] else 0
