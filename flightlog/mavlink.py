"""MAVLink 1 and 2: frames out of raw bytes, and messages of one kind as a numpy table.

The dialect is pymavlink's `ardupilotmega`. Framing is our own for two reasons: a log holds bytes as received, with
their own receive times, and frames whose checksum cannot be verified must not pass for messages.
"""

import re
from collections.abc import Sequence
from enum import Enum
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from fastcrc.crc16 import mcrf4xx as checksum
from pymavlink.dialects.v20 import ardupilotmega as dialect

_STX_1: Final = 0xFE
_STX_2: Final = 0xFD
_START: Final = re.compile(rb"[\xfd\xfe]")
_SIGNED: Final = 0x01
_SIGNATURE_BYTES: Final = 13
_CRC_EXTRA: Final[dict[int, int]] = {number: kind.crc_extra for number, kind in dialect.mavlink_map.items()}
_NAMES: Final[dict[int, str]] = {number: kind.msgname for number, kind in dialect.mavlink_map.items()}

AUTOPILOT_INVALID: Final = 8
"""HEARTBEAT.autopilot of everything that is no autopilot: ground stations, gimbals, companions."""


class Frame(NamedTuple):
    """One frame as received."""

    time_ns: int
    """Receive time of its last byte [ns of log time]."""
    system: int
    component: int
    message_id: int
    sequence: int
    version: int
    """1 or 2."""
    known: bool
    """Its checksum was verified. An id outside the dialect cannot be: it proves nothing about the link."""
    data: bytes
    """The whole frame, start byte to checksum or signature."""

    @property
    def payload(self) -> bytes:
        """The message's own bytes; version 2 cuts trailing zeros."""
        start = 6 if self.version == 1 else 10
        return self.data[start : start + self.data[1]]

    @property
    def name(self) -> str:
        """Name of the message, UNKNOWN_n for one outside the dialect."""
        return _NAMES.get(self.message_id, f"UNKNOWN_{self.message_id}")


class FrameParser:
    """Cuts a byte stream into frames; keeps an unfinished one until the rest arrives.

    Which known frames come out does not depend on how the stream was cut into pieces.

    Attributes
    ----------
    bad_bytes : int
        Bytes that belong to no frame.
    unknown : int
        Frames with an id outside the dialect.
    """

    def __init__(self) -> None:
        self.bad_bytes = 0
        self.unknown = 0
        self._rest = b""
        self._start = 0
        """Place of the first byte of `_rest` in the stream."""
        self._pieces: list[tuple[int, int]] = []
        """Place in the stream where a piece ended, and its receive time [ns], of the pieces that `_rest` is made of."""

    def feed(self, time_ns: int, data: bytes) -> list[Frame]:
        """Take the next bytes, received at `time_ns` [ns of log time], and give the frames that they complete."""
        self._rest += data
        self._pieces.append((self._start + len(self._rest), time_ns))
        return self._cut(last=False)

    def finish(self) -> list[Frame]:
        """Give the frames left among the bytes held back, and count the rest as bad: no more bytes will come."""
        return self._cut(last=True)

    def _cut(self, *, last: bool) -> list[Frame]:
        buffer, frames = self._rest, []
        offset = 0
        while True:
            start = _next_start(buffer, offset)
            self.bad_bytes += start - offset
            offset = start
            if offset == len(buffer):
                break
            frame = _frame_at(buffer, offset, last=last)
            if frame is _Answer.WAIT:
                break
            if frame is _Answer.NONE:
                self.bad_bytes += 1
                offset += 1
                continue
            self.unknown += not frame.known
            offset += len(frame.data)
            frames.append(frame._replace(time_ns=self._time_ns(offset)))
        self._rest = buffer[offset:]
        self._start += offset
        self._pieces = [piece for piece in self._pieces if piece[0] > self._start]
        return frames

    def _time_ns(self, end: int) -> int:
        """Receive time of the byte before `end` in `_rest`."""
        return next(time_ns for place, time_ns in self._pieces if place >= self._start + end)


class _Answer(Enum):
    NONE = 0
    """No frame begins here."""
    WAIT = 1
    """More bytes will tell."""


def _frame_at(buffer: bytes, offset: int, *, last: bool) -> Frame | _Answer:
    """The frame at `offset`, not yet timed; with `last` there is nothing to wait for."""
    unfinished = _Answer.NONE if last else _Answer.WAIT
    size = _frame_size(buffer, offset)
    if size is None or offset + size > len(buffer):
        return unfinished
    frame = _read_frame(buffer, offset, size) if size else None
    if frame is None:
        return _Answer.NONE
    if frame.known:
        return frame
    doubt = _doubt(buffer, offset, offset + size)
    if doubt is _Answer.WAIT and last:
        return frame
    return frame if doubt is None else doubt


def _doubt(buffer: bytes, offset: int, end: int) -> _Answer | None:
    """Reasons to doubt a frame with an id outside the dialect: noise can look like one, and must not hide known frames."""
    if end < len(buffer) and not _START.match(buffer, end):
        return _Answer.NONE
    doubt = None
    inside = _next_start(buffer, offset + 1)
    while inside < end:
        size = _frame_size(buffer, inside)
        if size is None or inside + size > len(buffer):
            doubt = _Answer.WAIT
        elif size:
            frame = _read_frame(buffer, inside, size)
            if frame is not None and frame.known:
                return _Answer.NONE
        inside = _next_start(buffer, inside + 1)
    return doubt


def _next_start(buffer: bytes, offset: int) -> int:
    """Offset of the next start byte, or the end."""
    found = _START.search(buffer, offset)
    return found.start() if found else len(buffer)


def _frame_size(buffer: bytes, offset: int) -> int | None:
    """Size that the frame at `offset` claims: None if too little of it has arrived, 0 if no frame can start there."""
    if len(buffer) < offset + 3:
        return None
    if buffer[offset] == _STX_1:
        return buffer[offset + 1] + 8
    flags = buffer[offset + 2]
    if flags & ~_SIGNED:  # a frame with a flag that we do not know must not be read (MAVLink 2, incompatibility flags)
        return 0
    return buffer[offset + 1] + 12 + (_SIGNATURE_BYTES if flags & _SIGNED else 0)


def _read_frame(buffer: bytes, offset: int, size: int) -> Frame | None:
    """The frame at `offset`, not yet timed; None where its checksum is wrong."""
    data = buffer[offset : offset + size]
    if data[0] == _STX_1:
        version, head = 1, 6
        sequence, system, component, message_id = data[2], data[3], data[4], data[5]
    else:
        version, head = 2, 10
        sequence, system, component = data[4], data[5], data[6]
        message_id = data[7] | data[8] << 8 | data[9] << 16
    extra = _CRC_EXTRA.get(message_id)
    if extra is not None:
        end = head + data[1]
        if checksum(data[1:end] + bytes((extra,))) != data[end] | data[end + 1] << 8:
            return None
    return Frame(0, system, component, message_id, sequence, version, extra is not None, data)


def frame_of(data: bytes) -> Frame | None:
    """The frame that some bytes begin with, not timed; None where none begins, its end is missing or its checksum is wrong."""
    if not data or data[0] not in (_STX_1, _STX_2):
        return None
    size = _frame_size(data, 0)
    return _read_frame(data, 0, size) if size and size <= len(data) else None


def message_id(name: str) -> int:
    """Id of a message of the dialect, by its name."""
    return _ids()[name]


@cache
def _ids() -> dict[str, int]:
    return {name: number for number, name in _NAMES.items()}


_FIELD_TYPES: Final = {
    "char": "S1", "uint8_t": "u1", "int8_t": "i1", "uint8_t_mavlink_version": "u1", "uint16_t": "<u2", "int16_t": "<i2",
    "uint32_t": "<u4", "int32_t": "<i4", "uint64_t": "<u8", "int64_t": "<i8", "float": "<f4", "double": "<f8",
}  # fmt: skip


@cache
def payload_dtype(number: int) -> np.dtype[np.void]:
    """The payload of a message as a packed dtype, fields in wire order, extensions last."""
    kind = dialect.mavlink_map[number]
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    fields: list[Any] = []
    for name, length in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True):
        code = _FIELD_TYPES[types[name]]
        if code == "S1":
            fields.append((name, f"S{max(length, 1)}"))
        else:
            fields.append((name, code, (length,)) if length > 1 else (name, code))
    return np.dtype(fields)


def message_name(number: int) -> str | None:
    """Name of the message with an id; None for one outside the dialect."""
    return _NAMES.get(number)


def field_offset(name: str, field: str) -> int | None:
    """Where a field of a message begins in its payload [bytes]; None where the message has no such field."""
    fields = payload_dtype(message_id(name)).fields
    return int(fields[field][1]) if fields is not None and field in fields else None


def table(frames: Sequence[Frame], name: str) -> npt.NDArray[np.void]:
    """All messages of one kind as one array.

    Parameters
    ----------
    frames : sequence of Frame
        Any frames; those of other kinds are passed over.
    name : str
        For example "ATTITUDE".

    Returns
    -------
    structured ndarray, shape (n,)
        Fields `host_ns` (receive time, log scale), `system`, `component`, and those of the message in its own units.
    """
    number = message_id(name)
    dtype = payload_dtype(number)
    mine = [frame for frame in frames if frame.message_id == number and frame.known]
    packed = b"".join(frame.payload[: dtype.itemsize].ljust(dtype.itemsize, b"\x00") for frame in mine)
    payload = np.frombuffer(packed, dtype)
    assert dtype.names is not None
    head = [("host_ns", "<i8"), ("system", "u1"), ("component", "u1")]
    # a message may itself have a field called system or component: its own values keep the plain name
    head = [field for field in head if field[0] not in dtype.names]
    out = np.empty(len(mine), np.dtype([*head, *((n, dtype[n]) for n in dtype.names)]))
    for field, values in (
        ("host_ns", [frame.time_ns for frame in mine]),
        ("system", [frame.system for frame in mine]),
        ("component", [frame.component for frame in mine]),
    ):
        if field not in dtype.names:
            out[field] = values
    for field in dtype.names:
        out[field] = payload[field]
    return out


def decode(frame: Frame) -> Any | None:
    """The frame as pymavlink's message object, None for an unknown one; for single messages, not for streams."""
    return _DECODER.decode(bytearray(frame.data)) if frame.known else None


_DECODER: Final = dialect.MAVLink(None)
