"""ArduPilot's dataflash log (.bin): self-describing messages as numpy tables.

Layout: A3 95, message type, body; type 128 (FMT) declares the others: type, length, name, one letter per field, field names.
UNIT, MULT and FMTU, since 2018, say the unit of each field. Source: ArduPilot, libraries/AP_Logger/LogStructure.h (the field
letters) and its documentation of logs.

A log of an hour has ten million messages. Their places are found for a stretch of bytes at a time: each place where a message may
begin knows where the next one would, and only this chain is walked one by one.
"""

from collections.abc import Collection
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


_OLD_FACTORS: Final = {
    "TimeUS": 1e-6, "TimeMS": 1e-3, "SampleUS": 1e-6, "GMS": 1e-3, "SMS": 1e-3, "T": 1e-3, "Delta": 1e-3,
    "MagX": 1e-3, "MagY": 1e-3, "MagZ": 1e-3,
}  # fmt: skip
"""What turns a field into SI units in logs that do not say so themselves: those older than FMTU."""
_DEGREES: Final = frozenset(("deg", "degheading", "deg/s"))
_STRETCH: Final = 1 << 20
"""Bytes looked at together."""
_WINDOW: Final = 2048
"""Possible beginnings looked at together: a hostile file that declares a type before each message costs no more than so many each."""


@dataclass(slots=True)
class Dataflash:
    """The messages of one log, by name.

    Attributes
    ----------
    tables : dict of str to structured ndarray, shape (n,)
        Fields as declared by the log, scaled: latitudes in degrees, hundredths resolved.
    counts : dict of str to int
        Messages of every name that could be read, of those without a table too.
    factors : dict of str to dict of str to float
        Name and field: what a value is multiplied by to be in the unit of the log's own list (FMTU), without prefix.
    units : dict of str to dict of str to str
        Name and field: that unit, such as "m/s" or "degheading".
    bad_bytes : int
        Bytes that belong to no message, or to one that cannot be read: of a type with a field letter that nobody knows, or of a
        name that was declared anew with other fields (the last declaration stands).
    """

    tables: dict[str, npt.NDArray[np.void]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    factors: dict[str, dict[str, float]] = field(default_factory=dict)
    units: dict[str, dict[str, str]] = field(default_factory=dict)
    bad_bytes: int = 0

    def has(self, name: str, *fields: str) -> bool:
        """Whether there are messages of a name, with these fields."""
        table = self.tables.get(name)
        return table is not None and len(table) > 0 and set(fields) <= set(table.dtype.names or ())

    def si(self, name: str, field: str) -> npt.NDArray[np.float64]:
        """A field in SI units, shape (n,): m, s, m/s, Pa, and radians where the log says degrees or, before FMTU, nothing.

        Latitudes and longitudes stay in degrees.
        """
        values = np.asarray(self.tables[name][field], np.float64)
        factor = self.factors.get(name, {}).get(field)
        values = values * (_OLD_FACTORS.get(field, 1.0) if factor is None else factor)
        unit = self.units.get(name, {}).get(field)
        degrees = unit in _DEGREES if unit is not None else field in ("Roll", "Pitch", "Yaw", "GCrs")
        return np.deg2rad(values) if degrees else values


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


def parse(data: bytes, place: str, wanted: Collection[str] | None = None) -> Dataflash:
    """Read a whole dataflash log; see `Parser`.

    Raises
    ------
    CaptureError
        The bytes do not start with a FMT message.
    """
    if not is_dataflash(data):
        raise CaptureError(f"{place}: is no ArduPilot dataflash log (it does not start with A3 95 80)")
    parser = Parser(wanted)
    for start in range(0, len(data), _STRETCH):
        parser.feed(data[start : start + _STRETCH])
    return parser.finish()


class Parser:
    """Reads a dataflash log piece by piece; which messages come out does not depend on the pieces.

    Parameters
    ----------
    wanted : collection of str, optional
        Names of the messages to keep; the rest is counted only. Default: all.
    """

    def __init__(self, wanted: Collection[str] | None = None) -> None:
        self._wanted = None if wanted is None else frozenset(wanted) | {"UNIT", "MULT", "FMTU"}
        self._formats = {_FMT: _Format("FMT", _FMT_BYTES, np.dtype("V86"), ())}
        self._numbers: dict[int, str] = {}
        self._bodies: dict[_Format, list[npt.NDArray[np.uint8]]] = {}
        self._counts: dict[_Format, int] = {}
        self._bad_bytes = 0
        self._rest = b""

    def feed(self, data: bytes) -> None:
        """Take the next bytes."""
        self._rest += data
        if len(self._rest) >= _STRETCH:
            self._rest = self._rest[self._scan(self._rest, last=False) :]

    def finish(self) -> Dataflash:
        """All that was read; no more bytes will come."""
        self._scan(self._rest, last=True)
        self._rest = b""
        log = Dataflash(bad_bytes=self._bad_bytes)
        last = {kind.name: kind for kind in self._counts if kind.dtype is not None}
        for kind, count in self._counts.items():
            if kind.dtype is None or last[kind.name] != kind:
                log.bad_bytes += kind.size * count
                continue
            log.counts[kind.name] = count
            if kind in self._bodies:
                log.tables[kind.name] = _table(kind.dtype, kind.scales, self._bodies[kind])
        _find_units(log, {number: last[name] for number, name in self._numbers.items() if name in last})
        return log

    def _scan(self, data: bytes, *, last: bool) -> int:
        """Take the messages of a stretch; gives how many of its bytes are done with."""
        raw = np.frombuffer(data, np.uint8)
        end = len(raw)
        heads = np.flatnonzero((raw[:-2] == HEAD[0]) & (raw[1:-1] == HEAD[1])) if end >= 3 else np.empty(0, np.int64)
        kinds = raw[heads + 2]
        at, done, taken = 0, 0, 0
        pending: list[npt.NDArray[np.int64]] = []
        while at < len(heads):
            chosen, at, waits = self._walk(heads, kinds, at, end)
            pending.append(chosen)
            if len(chosen):
                sizes = self._sizes()[kinds[chosen]]
                done = int(heads[chosen[-1]] + sizes[-1])
                taken += int(sizes.sum())
            if at < len(heads) and kinds[at] == _FMT and heads[at] + _FMT_BYTES <= end:
                self._take(raw, heads, kinds, pending)
            while at < len(heads) and kinds[at] == _FMT and heads[at] + _FMT_BYTES <= end:
                self._declare(data[heads[at] + 3 : heads[at] + _FMT_BYTES])
                done, taken = int(heads[at]) + _FMT_BYTES, taken + _FMT_BYTES
                at = int(np.searchsorted(heads, done))
            if waits and not last:
                self._take(raw, heads, kinds, pending)
                self._bad_bytes += int(heads[at]) - taken
                return int(heads[at])
            at += waits
        self._take(raw, heads, kinds, pending)
        # two bytes may be the beginning of a head
        done = end if last else max(done, end - 2)
        self._bad_bytes += done - taken
        return done

    def _sizes(self) -> npt.NDArray[np.int64]:
        sizes = np.zeros(256, np.int64)
        for number, kind in self._formats.items():
            sizes[number] = kind.size
        return sizes

    def _walk(
        self, heads: npt.NDArray[np.int64], kinds: npt.NDArray[np.uint8], at: int, end: int
    ) -> tuple[npt.NDArray[np.int64], int, bool]:
        """Follow the chain of messages from a possible beginning, through one window or to the next FMT.

        Gives the beginnings of messages, where to go on, and whether the message there goes on beyond the data.
        """
        low, high = at, min(at + _WINDOW, len(heads))
        sizes = self._sizes()[kinds[low:high]]
        ends = heads[low:high] + sizes
        known = sizes > 0
        whole = known & (ends <= end)
        step = np.where(whole, np.searchsorted(heads, ends), np.arange(low + 1, high + 1)).tolist()
        # a FMT changes what follows; a message that is cut by the end of the data ends the walk
        stop = (kinds[low:high] == _FMT) & whole | (known & ~whole)
        state = np.where(stop, 2, np.where(whole, 1, 0)).tolist()
        chosen: list[int] = []
        while at < high:
            if state[at - low] == 2:
                return np.array(chosen, np.int64), at, not whole[at - low]
            if state[at - low] == 1:
                chosen.append(at)
            at = step[at - low]
        return np.array(chosen, np.int64), at, False

    def _take(
        self,
        raw: npt.NDArray[np.uint8],
        heads: npt.NDArray[np.int64],
        kinds: npt.NDArray[np.uint8],
        pending: list[npt.NDArray[np.int64]],
    ) -> None:
        """Keep the bodies of the messages that were found since the last declaration."""
        chosen = np.concatenate([np.empty(0, np.int64), *pending])
        pending.clear()
        places, kinds = heads[chosen], kinds[chosen]
        for number in np.unique(kinds).tolist():
            kind = self._formats[number]
            mine = places[kinds == number]
            self._counts[kind] = self._counts.get(kind, 0) + len(mine)
            if kind.dtype is not None and (self._wanted is None or kind.name in self._wanted):
                self._bodies.setdefault(kind, []).append(raw[mine[:, None] + np.arange(3, kind.size)])

    def _declare(self, body: bytes) -> None:
        """Take a FMT message. Of one that contradicts itself, or has letters that we do not know, only the length is taken."""
        number, size = body[0], body[1]
        name, letters, labels = (_text(body[a:b]) for a, b in ((2, 6), (6, 22), (22, 86)))
        if number == _FMT or size < len(HEAD) + 1:
            return
        dtype = _dtype(letters, labels.split(",") if labels else [])
        if name and dtype is not None and dtype.itemsize + 3 == size:
            self._formats[number] = _Format(name, size, dtype, tuple(_LETTERS[c][1] for c in letters))
            self._numbers[number] = name
        else:
            self._formats.setdefault(number, _Format(name, size, None, ()))


def _find_units(log: Dataflash, formats: dict[int, _Format]) -> None:
    """Fill in what UNIT, MULT and FMTU say of the fields of all messages."""
    if not (
        log.has("UNIT", "Id", "Label")
        and log.has("MULT", "Id", "Mult")
        and log.has("FMTU", "FmtType", "UnitIds", "MultIds")
    ):
        return
    labels = {int(row["Id"]): _text(bytes(row["Label"])) for row in log.tables["UNIT"]}
    # stored as doubles of what had been floats: a thousandth is 0.0010000000474974513
    multipliers = {int(row["Id"]): float(f"{row['Mult']:.7g}") for row in log.tables["MULT"]}
    for row in log.tables["FMTU"]:
        kind = formats.get(int(row["FmtType"]))
        if kind is None or kind.dtype is None:
            continue
        units, factors = log.units.setdefault(kind.name, {}), log.factors.setdefault(kind.name, {})
        stated = zip(kind.dtype.names or (), kind.scales, bytes(row["UnitIds"]), bytes(row["MultIds"]), strict=False)
        for label, scale, unit, multiplier in stated:
            units[label] = labels.get(unit, "")
            # the letter of a scaled field has its multiplier in it
            factor = 1.0 if scale else multipliers.get(multiplier, 1.0)
            factors[label] = factor if np.isfinite(factor) and factor > 0.0 else 1.0


def _dtype(letters: str, names: list[str]) -> np.dtype[np.void] | None:
    """Storage of the fields as declared, None where that cannot be."""
    if not names or not all(names) or len(set(names)) != len(names):
        return None
    if len(names) != len(letters) or not set(letters) <= set(_LETTERS):
        return None
    return np.dtype([(n, _LETTERS[c][0]) for n, c in zip(names, letters, strict=True)])


def _table(
    dtype: np.dtype[np.void], scales: tuple[float | None, ...], parts: list[npt.NDArray[np.uint8]]
) -> npt.NDArray[np.void]:
    stored = np.concatenate(parts).reshape(-1).view(dtype)
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
