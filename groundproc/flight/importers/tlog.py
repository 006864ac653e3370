"""Telemetry logs of Mission Planner and MAVProxy: each MAVLink frame behind the time of its reception.

A record is a big-endian u64 of Unix microseconds, whose two lowest bits may carry a link number, and one raw frame. Frames that
fail their checksum are in such files too, as received, and a crash of the ground station leaves garbage.
"""

import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from flightlog.constants import NS_PER_US
from flightlog.mavlink import FrameParser

_STAMP_BYTES: Final = 8
_STARTS: Final = (0xFE, 0xFD)
_SIGNED: Final = 0x01
_LINK_BITS: Final = 0x3
_DATED_US: Final = 946_684_800_000_000
"""2000-01-01."""
_LATEST_US: Final = 1 << 53
"""In 2255. Any stamp is one, for a computer may have had no clock; later ones are bytes of something else."""
_AHEAD_US: Final = 3_600_000_000
_BACK_US: Final = 10_000_000
"""Around the last stamp, where the next is looked for behind bytes that are no frame."""
_HEAD_BYTES: Final = 65_536


Bytes = bytes | mmap.mmap


class Record(NamedTuple):
    """Bytes received at one time: one frame, or what was received instead."""

    time_ns: int
    data: bytes


@dataclass(slots=True)
class TlogCount:
    """What was found in a telemetry log."""

    records: int = 0
    frames: int = 0
    """With a right checksum."""
    unknown: int = 0
    """Frames of a message outside the dialect: their checksum cannot be known."""
    bad_frames: int = 0
    """Records whose bytes are no good frame."""
    bad_bytes: int = 0
    """Bytes in no frame, those that were left out included."""
    dropped_bytes: int = 0
    """Bytes without a time, left out."""
    cut: bool = False
    """The last record is not whole."""


def records(data: Bytes, count: TlogCount) -> Iterator[Record]:
    """Cut a telemetry log into its records; garbage is stepped over and counted.

    Parameters
    ----------
    data : bytes-like
        The whole file; a memory map will do.
    count : TlogCount
        Filled as records are taken.
    """
    end = len(data)
    offset = _next_good(data, 0)
    _drop(count, offset)
    last_us = _stamp(data, offset)
    while offset + _STAMP_BYTES < end:
        stamp_us = _stamp(data, offset)
        if not _near(stamp_us, last_us) and not _is_stamped_frame(data, offset):
            following = _next_record(data, offset + 1, last_us)
            _drop(count, following - offset)
            offset = following
            continue
        framed = _framed_end(data, offset, stamp_us)
        if framed is not None:
            following, last_us = framed, stamp_us
        else:  # the stamp may be garbage too: the bytes are kept at the time of the record before
            following = _next_record(data, offset + _STAMP_BYTES, last_us)
        body = bytes(data[offset + _STAMP_BYTES : following])
        _judge(body, count, last=following == end)
        yield Record((last_us & ~_LINK_BITS) * NS_PER_US, body)
        offset = following
    if offset < end:
        count.cut = True
        _drop(count, end - offset)


def is_tlog(head: bytes) -> bool:
    """Whether the beginning of a file holds stamped good frames: one at its very start, or two behind each other."""
    head = head[:_HEAD_BYTES]
    offset = _next_good(head, 0)
    while 0 < offset < len(head):
        end = _frame_end(head, offset + _STAMP_BYTES)
        if end is not None and _is_stamped_frame(head, end):
            return True
        offset = _next_good(head, offset + 1)
    return offset < len(head)


def is_plain_mavlink(head: bytes) -> bool:
    """Whether the beginning of a file holds good frames one behind the other, with no times between."""
    frames = [frame for frame in FrameParser().feed(0, head[:_HEAD_BYTES]) if frame.known]
    return any(first.data + second.data in head for first, second in pairwise(frames))


def _drop(count: TlogCount, size: int) -> None:
    count.bad_bytes += size
    count.dropped_bytes += size


def _stamp(data: Bytes, offset: int) -> int:
    return int.from_bytes(data[offset : offset + _STAMP_BYTES], "big")


def _frame_end(data: Bytes, offset: int) -> int | None:
    """Where the frame at `offset` says that it ends, None where none starts or its end is missing."""
    if offset + 3 > len(data) or data[offset] not in _STARTS:
        return None
    size = data[offset + 1] + 8
    if data[offset] == 0xFD:
        size += 4 + (13 if data[offset + 2] & _SIGNED else 0)
    return offset + size if offset + size <= len(data) else None


def _is_good(frame: bytes) -> bool:
    """Whether these bytes are exactly one frame with a right checksum."""
    parser = FrameParser()
    found = parser.feed(0, frame) + parser.finish()
    return len(found) == 1 and found[0].known and len(found[0].data) == len(frame)


def _near(stamp_us: int, last_us: int) -> bool:
    return last_us - _BACK_US <= stamp_us <= last_us + _AHEAD_US


def _framed_end(data: Bytes, offset: int, stamp_us: int) -> int | None:
    """End of the record at `offset` where a frame says so that is good or that another record follows, else None."""
    start = offset + _STAMP_BYTES
    end = _frame_end(data, start)
    if end is None:
        return None
    follows = end == len(data) or (end + _STAMP_BYTES <= len(data) and _near(_stamp(data, end), stamp_us))
    return end if follows or _is_good(bytes(data[start:end])) else None


def _next_record(data: Bytes, offset: int, last_us: int) -> int:
    """Offset of the next record: at a dated stamp near the last one, or at a good frame with any stamp; the end of the data."""
    good = _next_good(data, offset)
    if (
        last_us < _DATED_US
    ):  # the stamps of a computer without a clock begin with zeros, as much else does: good frames only
        return good
    # stamps so close together share their upper bytes, but for one carry
    moments = (last_us - _BACK_US, last_us, last_us + _AHEAD_US)
    for head in {moment.to_bytes(_STAMP_BYTES, "big")[:4] for moment in moments}:
        place = data.find(head, offset, good)
        while place >= 0 and not _near(_stamp(data, place), last_us):
            place = data.find(head, place + 1, good)
        good = place if place >= 0 else good
    return good


def _next_good(data: Bytes, offset: int) -> int:
    """Offset of the next stamp, of any time, that a good frame follows; the end where there is none."""
    start = offset + _STAMP_BYTES
    while True:
        places = [place for place in (data.find(b"\xfe", start), data.find(b"\xfd", start)) if place >= 0]
        if not places:
            return len(data)
        start = min(places)
        if _is_stamped_frame(data, start - _STAMP_BYTES):
            return start - _STAMP_BYTES
        start += 1


def _is_stamped_frame(data: Bytes, offset: int) -> bool:
    """Whether a time and a good frame stand at `offset`."""
    if offset < 0 or _stamp(data, offset) >= _LATEST_US:
        return False
    start = offset + _STAMP_BYTES
    end = _frame_end(data, start)
    return end is not None and _is_good(bytes(data[start:end]))


def _judge(body: bytes, count: TlogCount, *, last: bool) -> None:
    """Count the frames and the bad bytes of one record."""
    count.records += 1
    parser = FrameParser()
    found = parser.feed(0, body) + parser.finish()
    known = sum(frame.known for frame in found)
    count.frames += known
    count.unknown += len(found) - known
    count.bad_bytes += parser.bad_bytes
    if not found:
        count.bad_frames += 1
        count.cut |= last and _frame_end(body, 0) is None
