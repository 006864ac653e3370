"""MAVLink 1 and 2: frames out of raw bytes, and messages of one kind as a numpy table.

The dialect is pymavlink's `ardupilotmega`; framing is ours because a log holds bytes as they came, with their own receive times,
and because frames whose checksum cannot be known must not pass for messages.
"""

from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from fastcrc.crc16 import mcrf4xx as checksum
from pymavlink.dialects.v20 import ardupilotmega as dialect

_STX_1: Final = 0xFE
_STX_2: Final = 0xFD
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
    """Cuts a byte stream into frames; keeps an unfinished one until the rest comes.

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

    def feed(self, time_ns: int, data: bytes) -> list[Frame]:
        """Take the next bytes, received at `time_ns` [ns of log time], and give the frames that they complete."""
        buffer = self._rest + data
        frames: list[Frame] = []
        offset, end = 0, len(buffer)
        while offset < end:
            start = _next_start(buffer, offset)
            self.bad_bytes += start - offset
            offset = start
            size = _frame_size(buffer, offset)
            if size is None or offset + size > end:
                break
            frame = _read_frame(buffer, offset, size, time_ns)
            if frame is None:
                self.bad_bytes += 1
                offset += 1
                continue
            self.unknown += not frame.known
            frames.append(frame)
            offset += size
        self._rest = buffer[offset:]
        return frames

    def finish(self) -> None:
        """Count what is left as bad: no more bytes will come."""
        rest, self._rest = self._rest, b""
        self.bad_bytes += len(rest)


def _next_start(buffer: bytes, offset: int) -> int:
    """Offset of the next start byte, or the end."""
    if buffer[offset] in (_STX_1, _STX_2):
        return offset
    one, two = buffer.find(b"\xfe", offset), buffer.find(b"\xfd", offset)
    return min((position for position in (one, two) if position >= 0), default=len(buffer))


def _frame_size(buffer: bytes, offset: int) -> int | None:
    """Size that the frame at `offset` claims, None where too little of it is there to tell."""
    if len(buffer) < offset + 3:
        return None
    if buffer[offset] == _STX_1:
        return buffer[offset + 1] + 8
    return buffer[offset + 1] + 12 + (_SIGNATURE_BYTES if buffer[offset + 2] & _SIGNED else 0)


def _read_frame(buffer: bytes, offset: int, size: int, time_ns: int) -> Frame | None:
    """Check the frame at `offset`; None where it is none."""
    data = buffer[offset : offset + size]
    if data[0] == _STX_1:
        version, head = 1, 6
        sequence, system, component, message_id = data[2], data[3], data[4], data[5]
    else:
        version, head = 2, 10
        if data[2] & ~_SIGNED:
            return None
        sequence, system, component = data[4], data[5], data[6]
        message_id = data[7] | data[8] << 8 | data[9] << 16
    end = head + data[1]
    extra = _CRC_EXTRA.get(message_id)
    if extra is None:
        # no checksum to go by: only a following start byte, or silence, makes it worth a record
        if offset + size < len(buffer) and buffer[offset + size] not in (_STX_1, _STX_2):
            return None
        return Frame(time_ns, system, component, message_id, sequence, version, False, data)
    if checksum(data[1:end] + bytes((extra,))) != data[end] | data[end + 1] << 8:
        return None
    return Frame(time_ns, system, component, message_id, sequence, version, True, data)


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
    out = np.empty(len(mine), np.dtype([*head, *((n, dtype.fields[n][0]) for n in dtype.names)]))  # type: ignore[index]
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


def autopilots(frames: Iterable[Frame]) -> list[tuple[int, int]]:
    """(system, component) of every autopilot that sent a heartbeat, in order of appearance.

    Ground stations, gimbals and companions say HEARTBEAT.autopilot = 8 and are left out.
    """
    found: dict[tuple[int, int], None] = {}
    offset = payload_dtype(0).fields["autopilot"][1]  # type: ignore[index]
    for frame in frames:
        if frame.message_id == 0 and frame.known:
            payload = frame.payload.ljust(9, b"\x00")
            if payload[offset] != AUTOPILOT_INVALID:
                found[(frame.system, frame.component)] = None
    return list(found)


def decode(frame: Frame) -> Any | None:
    """The frame as pymavlink's message object, None for an unknown one; for the odd message, not for streams."""
    if not frame.known:
        return None
    kind = dialect.mavlink_map[frame.message_id]
    payload = frame.payload.ljust(kind.unpacker.size, b"\x00")[: kind.unpacker.size]
    values = kind.unpacker.unpack(payload)
    fields, position = [], 0
    for order in range(len(kind.ordered_fieldnames)):
        length = kind.array_lengths[order]
        if length and not isinstance(values[position], bytes):
            fields.append(list(values[position : position + length]))
            position += length
        else:
            fields.append(values[position])
            position += 1
    by_name = dict(zip(kind.ordered_fieldnames, fields, strict=True))
    return kind(*(by_name[name] for name in kind.fieldnames))
