"""ArduPilot's dataflash log (.bin): self-describing messages as numpy tables.

Layout: A3 95, message type, body; type 128 (FMT) declares the others: type, length, name, one letter per field, field names.
Source: ArduPilot, libraries/AP_Logger/LogStructure.h (the field letters) and its documentation of logs.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError

HEAD: Final = b"\xa3\x95"
_FMT: Final = 128
_FMT_BYTES: Final = 89

_LETTERS: Final[dict[str, tuple[str, float | None]]] = {
    "b": ("i1", None), "B": ("u1", None), "M": ("u1", None), "h": ("<i2", None), "H": ("<u2", None),
    "i": ("<i4", None), "I": ("<u4", None), "q": ("<i8", None), "Q": ("<u8", None), "f": ("<f4", None),
    "d": ("<f8", None), "n": ("S4", None), "N": ("S16", None), "Z": ("S64", None),
    "c": ("<i2", 0.01), "C": ("<u2", 0.01), "e": ("<i4", 0.01), "E": ("<u4", 0.01), "L": ("<i4", 1e-7),
    "a": ("(32,)<i2", None), "g": ("<f2", None),
}  # fmt: skip
"""Letter -> storage, and the factor that turns the stored number into the unit of its name."""


@dataclass(slots=True)
class Dataflash:
    """The messages of one log, by name.

    Attributes
    ----------
    tables : dict of str to structured ndarray, shape (n,)
        Fields as declared by the log, scaled: latitudes in degrees, hundredths resolved.
    bad_bytes : int
        Bytes that belong to no message, or to one that cannot be read: of a type with a field letter that nobody knows, or of a
        name that was declared anew with other fields (the last declaration stands).
    """

    tables: dict[str, npt.NDArray[np.void]] = field(default_factory=dict)
    bad_bytes: int = 0


@dataclass(frozen=True, slots=True)
class _Format:
    name: str
    size: int
    dtype: np.dtype[np.void] | None
    """None: its length is known, its fields are not."""
    scales: tuple[float | None, ...]


def is_dataflash(head: bytes) -> bool:
    """Whether a file that starts so is a dataflash log: its first message must be a FMT."""
    return head[:3] == HEAD + bytes((_FMT,))


def parse(data: bytes, place: str) -> Dataflash:
    """Read a whole dataflash log.

    Raises
    ------
    CaptureError
        The bytes do not start with a FMT message.
    """
    if not is_dataflash(data):
        raise CaptureError(f"{place}: is no ArduPilot dataflash log (it does not start with A3 95 80)")
    formats = {_FMT: _Format("FMT", _FMT_BYTES, np.dtype("V86"), ())}
    bodies: dict[_Format, list[bytes]] = {}
    log = Dataflash()
    offset, end = 0, len(data)
    while offset + 3 <= end:
        kind = formats.get(data[offset + 2]) if data[offset : offset + 2] == HEAD else None
        if kind is None or offset + kind.size > end:
            following = data.find(HEAD, offset + 1)
            following = end if following < 0 else following
            log.bad_bytes += following - offset
            offset = following
            continue
        body = data[offset + 3 : offset + kind.size]
        if data[offset + 2] == _FMT:
            _declare(body, formats)
        else:
            bodies.setdefault(kind, []).append(body)
        offset += kind.size
    log.bad_bytes += end - offset
    last = {kind.name: kind for kind in bodies if kind.dtype is not None}
    for kind, parts in bodies.items():
        if kind.dtype is None or last[kind.name] != kind:
            log.bad_bytes += kind.size * len(parts)
        else:
            log.tables[kind.name] = _table(kind.dtype, kind.scales, parts)
    return log


def _declare(body: bytes, formats: dict[int, _Format]) -> None:
    """Take a FMT message. Of one that contradicts itself, or has letters that we do not know, only the length is taken."""
    number, size = body[0], body[1]
    name, letters, labels = (_text(body[a:b]) for a, b in ((2, 6), (6, 22), (22, 86)))
    if number == _FMT or size < len(HEAD) + 1:
        return
    dtype = _dtype(letters, labels.split(",") if labels else [])
    if name and dtype is not None and dtype.itemsize + 3 == size:
        formats[number] = _Format(name, size, dtype, tuple(_LETTERS[c][1] for c in letters))
    else:
        formats.setdefault(number, _Format(name, size, None, ()))


def _dtype(letters: str, names: list[str]) -> np.dtype[np.void] | None:
    """Storage of the fields as declared, None where that cannot be."""
    if not names or not all(names) or len(set(names)) != len(names):
        return None
    if len(names) != len(letters) or not set(letters) <= set(_LETTERS):
        return None
    return np.dtype([(n, _LETTERS[c][0]) for n, c in zip(names, letters, strict=True)])


def _table(dtype: np.dtype[np.void], scales: tuple[float | None, ...], parts: list[bytes]) -> npt.NDArray[np.void]:
    stored = np.frombuffer(b"".join(parts), dtype)
    if not any(scales):
        return stored
    assert dtype.names is not None
    assert dtype.fields is not None
    fields = [(n, "<f8" if scale else dtype.fields[n][0]) for n, scale in zip(dtype.names, scales, strict=True)]
    out = np.empty(len(stored), np.dtype(fields))
    for n, scale in zip(dtype.names, scales, strict=True):
        out[n] = stored[n] * scale if scale else stored[n]
    return out


def _text(raw: bytes) -> str:
    return raw.split(b"\x00")[0].decode("ascii", errors="replace")
