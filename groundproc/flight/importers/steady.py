"""Receive times of a recording, corrected by the clocks of the devices in it.

The clock of a recording computer may be set while it records, by an hour or by 56 years, and single stamps may be
wild. The devices' own clocks run on all the while. So it is decided message by message what stepped. If a device's
clock went on normally from one message to the next and the stamp did not, the stamp is wrong. If the device's clock
jumped and the stamp went on, it was the device. If both went on by as much, there was silence.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

from flightlog import clock
from flightlog.constants import HOUR_NS, NS_PER_S
from groundproc.flight.importers.devices import Reading
from groundproc.flight.importers.foresight import foreseen
from groundproc.flight.importers.joining import Event
from groundproc.flight.importers.ordering import Order, Placed

_JUMP_NS: Final = NS_PER_S // 2
"""A device's clock that is set is set by more."""
_CLOSE_NS: Final = 2 * NS_PER_S
"""A device's messages follow each other within this; more and it was silent."""
_SAME_NS: Final = NS_PER_S // 10
"""So close to whole turns of a device's clock, it did not turn: one silence in 18,000 ends there by chance."""
_SKIPPED: Final = 32
"""Numbers of messages that may be missing where a device is said to have gone on; a reboot begins again at 0."""
_SLEW: Final = 1e-3
"""A computer's clock is slewed by 500 ppm at most (RFC 5905, section 12), and crystals differ by 100 ppm."""
_YEAR_NS: Final = 365 * 86_400 * NS_PER_S
"""A silence is shorter; a computer that had no clock gains more when it is set."""
_LEVELS: Final = 16
_FEWEST: Final = 8
"""So many messages on end at another level are a clock that was set; fewer are wild stamps."""
_WAITING: Final = 1024


@dataclass(slots=True, eq=False)
class _Level:
    """A state of the recording computer's clock: time = stamp + offset."""

    offset_ns: int
    hits: int = 0
    confirmed: bool = False


@dataclass(slots=True)
class _Device:
    """What is known of a device's clock."""

    time_ns: int
    """Its latest time, its turns counted."""
    raw_ns: int
    """Stamp of that message."""
    base_ns: int
    """Time of reception less the device's, of the fastest messages."""
    sequence: int | None
    epoch: int = 0
    """How often it was set or began anew."""


@dataclass(slots=True)
class Steady:
    """Gives the events of one recording in the order in which they were sent, with times that never step back.

    Attributes
    ----------
    out_of_order : int
        Events that came behind later ones and were put in their place.
    out_of_range : int
        Events whose time no log can hold (1970 to 2038); left out.
    wild_stamps : int
        Single stamps that a device's clock, or the messages around them, showed to be wrong; mended.
    steps_back, steps_ahead : int
        How often the recording computer's clock was set.
    stepped_ns : int
        What the last stamps needed for all these steps.
    moved_ns : int
        What was added to all times, because the computer had no clock at first, or never.
    first_ns : int or None
    last_ns : int
        Of the events given.
    """

    out_of_order: int = 0
    out_of_range: int = 0
    wild_stamps: int = 0
    steps_back: int = 0
    steps_ahead: int = 0
    stepped_ns: int = 0
    moved_ns: int = 0
    first_ns: int | None = None
    last_ns: int = 0
    _levels: list[_Level] = field(default_factory=lambda: [_Level(0)])
    """The one in force last."""
    _ran: tuple[_Level | None, int] = (None, 0)
    """The level of the last message, and how many on end were at it."""
    _held: _Level | None = None
    """The last level that was confirmed."""
    _devices: dict[tuple[str, bytes], _Device] = field(default_factory=dict)
    _time_ns: int | None = None
    """Time of the last event with a device's clock."""
    _latest_ns: int = 0
    """The latest time of all."""
    _waiting: list[Event] = field(default_factory=list)
    """Events without a device's clock: the next with one tells which level they are of."""

    def begin(self, moved_ns: int) -> None:
        """Add so much to all times; before the first event."""
        self.moved_ns = moved_ns
        self._levels = [_Level(moved_ns)]

    def __call__(self, events: Iterable[Event]) -> Iterator[Event]:
        """The events of the recording, put right."""
        order = Order()
        for placed in self.judged(events):
            yield from self._given(order.put(placed))
        yield from self._given(order.finish())
        self.out_of_order = order.out_of_order
        held = self._held or max(self._levels, key=lambda level: level.hits)
        self.wild_stamps += sum(level.hits for level in self._levels if not level.confirmed and level is not held)

    def _given(self, events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if not 0 <= event.time_ns < clock.PLAUSIBLE_UTC_NS[1]:
                self.out_of_range += 1
                continue
            if self.first_ns is None:
                self.first_ns = event.time_ns
            self.last_ns = event.time_ns
            yield event

    def dated_ns(self) -> int | None:
        """What makes times of stamps [ns] at the level that most messages have of those whose stamps can be dates; None without such."""
        last_ns = self._time_ns or 0
        able = [level for level in self._levels if level.hits and clock.is_plausible(last_ns - level.offset_ns)]
        return max(able, key=lambda level: level.hits).offset_ns if able else None

    def judged(self, events: Iterable[Event]) -> Iterator[Placed]:
        """Events with mended times, in the order of the recording."""
        for event, read, step_ns in foreseen(events):
            before_ns, level = self._time_ns, self._levels[-1]
            if step_ns and read is not None:
                self._foresee(event.time_ns, read, step_ns)
            device_ns = None if read is None or read.time_ns is None else self._take(event.time_ns, read)
            if read is None or device_ns is None:
                if read is not None and read.device in self._devices:
                    self._devices[read.device].sequence = read.sequence
                self._waiting.append(event)
                if len(self._waiting) >= _WAITING:
                    yield from self._release(before_ns, None)
                continue
            assert self._time_ns is not None
            if self._waiting:
                yield from self._release(before_ns, self._time_ns, stepped=self._levels[-1] is not level)
            chain = (read.device, event.topic, read.kind, self._devices[read.device].epoch)
            self._latest_ns = max(self._latest_ns, self._time_ns)
            yield Placed(_at(event, self._time_ns), chain, device_ns)
        yield from self._release(self._time_ns, None)

    def _take(self, raw_ns: int, read: Reading) -> int | None:
        """Judge the stamp of a message with a device's time; that time, or None where device and stamp are both doubtful."""
        assert read.time_ns is not None
        device = self._devices.get(read.device)
        if device is None:
            return self._meet(raw_ns, read)
        step_ns = self._device_step(raw_ns, read, device)
        device_ns = device.time_ns + step_ns
        expected_ns = device_ns + device.base_ns
        level = self._matching(raw_ns, expected_ns, step_ns, read)
        beyond_ns = raw_ns + self._levels[-1].offset_ns - expected_ns
        if level is not None:
            time_ns = raw_ns + level.offset_ns
            # delays only add: the base is that of the fastest, and follows the slower no quicker than clocks drift
            device.base_ns += min(time_ns - expected_ns, round(_SLEW * abs(step_ns)))
        elif _goes_on(raw_ns, step_ns, beyond_ns, read, device):
            time_ns = max(expected_ns, self._latest_ns) if step_ns >= 0 else expected_ns
            level = self._new_level(time_ns - raw_ns)
        elif abs(beyond_ns) < _JUMP_NS:  # it came ahead of others
            level = self._levels[-1]
            time_ns = raw_ns + level.offset_ns
        else:
            level = self._after_event(raw_ns)
            time_ns = raw_ns + level.offset_ns
            device.base_ns = time_ns - device_ns
            device.epoch += 1
            step_ns = 0
        self._enter(level)
        if step_ns >= 0:  # what comes late tells nothing of what follows
            device.time_ns, device.raw_ns = device_ns, raw_ns
        device.sequence = read.sequence
        self._time_ns = time_ns
        return device_ns

    def _foresee(self, raw_ns: int, read: Reading, step_ns: int) -> None:
        """Make the level behind a small step ahead, unless another device's messages have told of it already."""
        device, level = self._devices.get(read.device), self._levels[-1]
        if device is None or read.time_ns is None:
            return
        late_ns = raw_ns + level.offset_ns - device.base_ns - device.time_ns - self._device_step(raw_ns, read, device)
        if late_ns > step_ns // 2:
            self._new_level(level.offset_ns - step_ns)

    def _meet(self, raw_ns: int, read: Reading) -> int | None:
        """The first message of a device: taken where its stamp is near those of the others, or is the first of all."""
        assert read.time_ns is not None
        time_ns = raw_ns + self._levels[-1].offset_ns
        if self._time_ns is not None and abs(time_ns - self._time_ns) > 10 * NS_PER_S:
            return None
        self._devices[read.device] = _Device(read.time_ns, raw_ns, time_ns - read.time_ns, read.sequence)
        self._enter(self._levels[-1])
        self._time_ns = time_ns
        return read.time_ns

    def _device_step(self, raw_ns: int, read: Reading, device: _Device) -> int:
        """By how much a device's clock went on [ns]; how often it turned over, the stamps tell."""
        assert read.time_ns is not None
        half_ns = read.wrap_ns // 2
        step_ns = (read.time_ns - device.time_ns + half_ns) % read.wrap_ns - half_ns
        if abs(step_ns) < _SAME_NS:
            return step_ns
        sent_ns = device.time_ns + device.base_ns + step_ns
        beyond = [raw_ns + level.offset_ns - sent_ns for level in reversed(self._levels)]
        nearest_ns = min(beyond, key=lambda ns: abs((ns + half_ns) % read.wrap_ns - half_ns))
        # years are no turns of a device's clock, but a computer's that was set: it turned at most once
        turns = round(nearest_ns / read.wrap_ns) if abs(nearest_ns) < _YEAR_NS else int(step_ns < 0)
        return step_ns + max(turns, 0) * read.wrap_ns

    def _matching(self, raw_ns: int, expected_ns: int, step_ns: int, read: Reading) -> _Level | None:
        """The level at which a stamp is nearest to what a device's clock lets expect, the newest first; None where it is at none."""
        early_ns = read.early_ns + round(_SLEW * abs(step_ns))
        best = self._levels[-1]
        if abs(raw_ns + best.offset_ns - expected_ns) <= early_ns:
            return best
        best = min(reversed(self._levels), key=lambda level: abs(raw_ns + level.offset_ns - expected_ns))
        return best if -early_ns <= raw_ns + best.offset_ns - expected_ns <= read.slack_ns + early_ns else None

    def _after_event(self, raw_ns: int) -> _Level:
        """The level after a device's clock was set or began anew: the one in force, where time goes on with it."""
        level = self._levels[-1]
        passed_ns = 0 if self._time_ns is None else raw_ns + level.offset_ns - self._time_ns
        if self._time_ns is None or -_JUMP_NS <= passed_ns < _YEAR_NS:
            return level
        return self._new_level(self._time_ns - raw_ns)

    def _new_level(self, offset_ns: int) -> _Level:
        self._levels.append(_Level(offset_ns))
        if len(self._levels) > _LEVELS:
            left = self._levels.pop(next(i for i, each in enumerate(self._levels) if each is not self._held))
            self.wild_stamps += 0 if left.confirmed else left.hits
        return self._levels[-1]

    def _enter(self, level: _Level) -> None:
        """Make a level the one in force, and count a step once it has lasted."""
        level.hits += 1
        self._ran = (level, self._ran[1] + 1 if self._ran[0] is level else 1)
        if level is not self._levels[-1]:
            self._levels.remove(level)
            self._levels.append(level)
        held = self._held
        if level is held or self._ran[1] < _FEWEST:
            return
        level.confirmed, self._held = True, level
        if held is not None:
            self.steps_back += level.offset_ns > held.offset_ns
            self.steps_ahead += level.offset_ns < held.offset_ns
            self.stepped_ns += level.offset_ns - held.offset_ns

    def _release(self, before_ns: int | None, after_ns: int | None, *, stepped: bool = False) -> Iterator[Placed]:
        """Events without a device's clock, between two times that are sure; None where there is none.

        A step is known only to the jitter of messages: there the order of the recording goes before the stamps.
        """
        waiting, self._waiting = self._waiting, []
        for event in waiting:
            if after_ns is None:
                time_ns = self._by_stamp(event.time_ns)
            else:
                first_ns = after_ns - HOUR_NS if before_ns is None else before_ns
                time_ns = self._between(event.time_ns, first_ns, after_ns)
                if stepped:
                    time_ns = before_ns = min(max(time_ns, first_ns), after_ns)
            self._latest_ns = max(self._latest_ns, time_ns)
            yield Placed(_at(event, time_ns), None, 0)

    def _between(self, raw_ns: int, first_ns: int, last_ns: int) -> int:
        for level in reversed(self._levels):
            time_ns = raw_ns + level.offset_ns
            if first_ns - NS_PER_S <= time_ns <= last_ns + NS_PER_S:
                return time_ns
        self.wild_stamps += 1
        return last_ns

    def _by_stamp(self, raw_ns: int) -> int:
        """The time of an event that nothing but its stamp tells of: it goes on, by less than a year."""
        last_ns = raw_ns + self._levels[-1].offset_ns if self._time_ns is None else self._time_ns
        for level in reversed(self._levels):
            if -NS_PER_S <= raw_ns + level.offset_ns - last_ns < _YEAR_NS:
                break
        else:
            level = self._new_level(last_ns - raw_ns)
        self._enter(level)
        self._time_ns = raw_ns + level.offset_ns
        return self._time_ns


def _at(event: Event, time_ns: int) -> Event:
    return event if event.time_ns == time_ns else event._replace(time_ns=time_ns)


def _goes_on(raw_ns: int, step_ns: int, beyond_ns: int, read: Reading, device: _Device) -> bool:
    """Whether a device's clock went on as from one of its messages to the next, and the stamps did not.

    What a stamp is beyond expectation must have come about since the message before: a clock of another rate does not jump.
    """
    passed_ns = raw_ns - device.raw_ns
    if 2 * abs(passed_ns - step_ns) < abs(beyond_ns):
        return False
    if abs(passed_ns) > _YEAR_NS:
        return 0 <= step_ns <= HOUR_NS
    numbers = (read.sequence, device.sequence)
    skipped = 0 if numbers[0] is None or numbers[1] is None else (numbers[0] - numbers[1] - 1) % 256
    return abs(step_ns) < _CLOSE_NS and abs(step_ns) <= abs(passed_ns) and skipped <= _SKIPPED
