"""Events in slots of 0.1 s, by topic; packets of the lidar that came late are handed back to the slot that they belong to."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

from flightlog import hdl32e, records
from flightlog.constants import NS_PER_MS
from groundproc.flight.importers.joining import Event
from groundproc.sensors.sequence import NEAR_US

SLOT_NS: Final = 100 * NS_PER_MS
_LARGEST_SLOT: Final = 4096
"""Events; more in 0.1 s means stamps that stand still."""
_TAIL: Final = 64
"""Packets at either side of the edge of a slot that are looked at: networks swap packets by a few."""
_SIZES: Final = {records.LIDAR.topic: hdl32e.DATA_BYTES, records.POSITION.topic: hdl32e.POSITION_BYTES}
_STAMP_AT: Final = {records.LIDAR.topic: 1200, records.POSITION.topic: 198}
"""Where the packets of the two ports have their stamp (HDL-32E manual, appendix E)."""


@dataclass(slots=True)
class Slot:
    """The events of 0.1 s; those of the lidar may still be joined by late ones of the next slot.

    Attributes
    ----------
    topics : dict of str to list of Event
    log_ns : dict of str to int
        Time of the last event of each topic.
    """

    topics: dict[str, list[Event]] = field(default_factory=dict)
    log_ns: dict[str, int] = field(default_factory=dict)


def slots(events: Iterable[Event]) -> Iterator[Slot]:
    """Events of 0.1 s each, by topic."""
    slot: list[Event] = []
    for event in events:
        if slot and (event.time_ns >= slot[0].time_ns + SLOT_NS or len(slot) >= _LARGEST_SLOT):
            yield _by_topic(slot)
            slot = []
        slot.append(event)
    if slot:
        yield _by_topic(slot)


def _by_topic(events: list[Event]) -> Slot:
    slot = Slot()
    for event in events:
        slot.topics.setdefault(event.topic, []).append(event)
    slot.log_ns = {topic: each[-1].time_ns for topic, each in slot.topics.items()}
    return slot


def hand_back(before: Slot, slot: Slot) -> None:
    """Move packets of the lidar that were sent before the last one of the slot before, or are that one again, to that slot."""
    for topic, size in _SIZES.items():
        if topic not in before.topics or topic not in slot.topics:
            continue
        latest = _latest_us(before.topics[topic], topic, size)
        early = {
            i
            for i, event in enumerate(slot.topics[topic][:_TAIL])
            if len(event.data) == size and event.sender in latest
            if -NEAR_US < _after_us(_stamp_us(event, topic), latest[event.sender]) <= 0
        }
        if early:
            events = slot.topics[topic]
            before.topics[topic] += [events[i] for i in sorted(early)]
            slot.topics[topic] = [event for i, event in enumerate(events) if i not in early]


def _latest_us(events: list[Event], topic: str, size: int) -> dict[bytes, int]:
    """The latest stamp of each sender [us past the hour]; of a clock that was set, the last one counts."""
    latest: dict[bytes, int] = {}
    for event in events[-_TAIL:]:
        if len(event.data) == size:
            stamp_us = _stamp_us(event, topic)
            passed_us = _after_us(stamp_us, latest.get(event.sender, stamp_us))
            if passed_us >= 0 or passed_us < -NEAR_US:
                latest[event.sender] = stamp_us
    return latest


def _stamp_us(event: Event, topic: str) -> int:
    start = _STAMP_AT[topic]
    return int.from_bytes(event.data[start : start + 4], "little")


def _after_us(stamp_us: int, reference_us: int) -> int:
    half = hdl32e.STAMP_WRAP_US // 2
    return (stamp_us - reference_us + half) % hdl32e.STAMP_WRAP_US - half
