"""Events of one recording in the order in which they were sent, within a window."""

from bisect import bisect_right, insort
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from groundproc.flight.importers.joining import Event

_WINDOW: Final = 2048
"""Events among which the order is restored: a second of a lidar."""


class Placed(NamedTuple):
    """An event whose time was judged."""

    event: Event
    chain: Hashable
    """Events of one chain were sent in the order of their device's times; None for one without."""
    device_ns: int


class _Entry(NamedTuple):
    """An event in the window; entries sort as they are to be given."""

    time_ns: int
    number: int
    beside: int
    """-1: ahead of the event with that number, 1: behind it."""
    device_ns: int
    own: int
    event: Event


@dataclass(slots=True)
class Order:
    """Restores the order of events.

    What came late, by its device's time, goes ahead of the event that it was to precede, with that event's time or its own, whichever is
    earlier: the later ones keep theirs. What was sent later is never given a time before what was sent earlier.
    """

    out_of_order: int = 0
    _window: list[_Entry] = field(default_factory=list)
    _chains: dict[Hashable, list[tuple[int, int, int]]] = field(default_factory=dict)
    """Device time, time and number of the latest events of each chain, in the order of device times."""
    _number: int = 0
    _last_ns: int | None = None

    def put(self, placed: Placed) -> Iterator[Event]:
        """Take the next event; give those that no later one can precede."""
        self._number += 1
        entry = self._entry(placed)
        if not self._window or entry > self._window[-1]:
            self._window.append(entry)
        else:
            insort(self._window, entry)
            self.out_of_order += entry.beside != 0 or placed.chain is None
        if len(self._window) >= 2 * _WINDOW:
            yield from self._give(_WINDOW)

    def finish(self) -> Iterator[Event]:
        """Give the rest."""
        yield from self._give(len(self._window))

    def _give(self, count: int) -> Iterator[Event]:
        given, self._window = self._window[:count], self._window[count:]
        oldest = self._number - 2 * _WINDOW
        self._chains = {name: chain[-_WINDOW:] for name, chain in self._chains.items() if chain[-1][2] >= oldest}
        for entry in given:
            if self._last_ns is None or entry.time_ns > self._last_ns:
                self._last_ns = entry.time_ns
            event = entry.event
            yield event if event.time_ns == self._last_ns else event._replace(time_ns=self._last_ns)

    def _entry(self, placed: Placed) -> _Entry:
        event, device_ns, own = placed.event, placed.device_ns, self._number
        if placed.chain is None:
            return _Entry(event.time_ns, own, 0, 0, own, event)
        chain = self._chains.setdefault(placed.chain, [])
        if not chain or device_ns >= chain[-1][0]:
            time_ns = max(event.time_ns, chain[-1][1]) if chain else event.time_ns
            chain.append((device_ns, time_ns, own))
            return _Entry(time_ns, own, 0, device_ns, own, event)
        place = bisect_right(chain, device_ns, key=lambda known: known[0])
        _, next_ns, next_number = chain[place]
        entry = _Entry(min(event.time_ns, next_ns), next_number, -1, device_ns, own, event)
        if place and entry.time_ns < chain[place - 1][1]:
            _, before_ns, before_number = chain[place - 1]
            entry = _Entry(before_ns, before_number, 1, device_ns, own, event)
        insort(chain, (device_ns, entry.time_ns, entry.number))
        return entry
