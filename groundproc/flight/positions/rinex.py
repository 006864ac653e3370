"""What a RINEX file holds, as far as it must be known before it is processed: kind, times, base position, ephemerides.

Formats: RINEX 2.11 and 3.05. Observations themselves are read by RTKLIB alone.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from flightlog.constants import NS_PER_S
from flightlog.errors import LogError
from groundproc.text import open_text

UBX_SYNC: Final = b"\xb5\x62"
_RTCM3: Final = 0xD3
_HEADER_LINES: Final = 5000
_TWO_DIGITS: Final = 80
_UBX_RAW: Final = (b"\xb5\x62\x02\x15", b"\xb5\x62\x02\x10")
"""RXM-RAWX and the older RXM-RAW."""
_V2_EPOCH: Final = re.compile(
    r"^ (\d\d) ([ \d]\d) ([ \d]\d) ([ \d]\d) ([ \d]\d)((?:  \d| \d\d|\d{3})\.\d{7})  ([0-6])(  \d| \d\d|\d{3})"
)
_V3_EPOCH: Final = re.compile(
    r"^> (\d{4}) ([ \d]\d) ([ \d]\d) ([ \d]\d) ([ \d]\d)((?:  \d| \d\d|\d{3})\.\d{7})  ([0-6])(  \d| \d\d|\d{3})"
)


@dataclass(slots=True)
class Observations:
    """Header and epochs of an observation file.

    Attributes
    ----------
    version : float
    approximate_m : tuple of float, or None
        APPROX POSITION XYZ, geocentric; None where it is missing or zero.
    epochs : int
        Those with observations.
    start_ns, end_ns : int
        First and last epoch, of the receiver's own calendar counted from 1970.
    """

    version: float = 0.0
    approximate_m: tuple[float, float, float] | None = None
    epochs: int = 0
    start_ns: int = 0
    end_ns: int = 0

    @property
    def seconds(self) -> float:
        """Time from first to last epoch [s]."""
        return (self.end_ns - self.start_ns) / NS_PER_S


@dataclass(slots=True)
class Navigation:
    """Ephemerides of a navigation file: reference times [ns, calendar counted from 1970], by satellite."""

    version: float = 0.0
    times_ns: dict[str, list[int]] = field(default_factory=dict)

    def satellites_near(self, start_ns: int, end_ns: int, reach_ns: int) -> int:
        """How many satellites have an ephemeris within reach of a stretch of time."""
        return sum(
            any(start_ns - reach_ns <= time_ns <= end_ns + reach_ns for time_ns in times)
            for times in self.times_ns.values()
        )


def is_raw_observations(head: bytes) -> bool:
    """Whether bytes begin a RINEX file, or hold a receiver's raw observations."""
    return kind_of(head) in ("observations", "ubx", "rtcm3")


def kind_of(head: bytes) -> str:
    """What a file is by its first bytes: observations, navigation, compact, other_rinex, ubx, rtcm3, or nothing known ("")."""
    first = head[:400].splitlines()[0] if head[:400].strip() else b""
    if first[60:80].strip() == b"RINEX VERSION / TYPE":
        letter = first[20:21].upper()
        if letter == b"O":
            return "observations"
        return "navigation" if letter in b"NGHL" or b"NAV" in first[20:40].upper() else "other_rinex"
    if first[60:80].strip() == b"CRINEX VERS   / TYPE":
        return "compact"
    if UBX_SYNC in head and any(mark in head for mark in _UBX_RAW):
        return "ubx"
    if head[:2] == UBX_SYNC:
        return "ubx"
    return "rtcm3" if head[:1] == bytes([_RTCM3]) and len(head) > 1 and head[1] < 4 else ""


def observations(path: Path) -> Observations:
    """Go through an observation file once.

    Raises
    ------
    LogError
        It is none, its version is not known to RTKLIB, or it has no epoch with observations.
    """
    found = Observations()
    with open_text(path) as file:
        lines = iter(file)
        types = _observation_header(lines, found, path)
        epochs = _v3_epochs(lines) if found.version >= 3 else _v2_epochs(lines, types)
        for time_ns in epochs:
            if time_ns is None:
                continue
            if not found.epochs or time_ns < found.start_ns:
                found.start_ns = time_ns
            found.end_ns = max(found.end_ns, time_ns)
            found.epochs += 1
    if not found.epochs:
        raise LogError(f"{path}: holds no observations, expected RINEX epochs with satellites")
    return found


def _header(lines: Iterator[str]) -> Iterator[tuple[str, str]]:
    """Content and label of header lines."""
    for number, line in enumerate(lines):
        label = line[60:].strip()
        yield line[:60], label
        if label == "END OF HEADER" or number > _HEADER_LINES:
            return


def _observation_header(lines: Iterator[str], found: Observations, path: Path) -> int:
    """Fill in what the header says; gives the number of observation types of version 2."""
    types = 0
    for content, label in _header(lines):
        if label == "RINEX VERSION / TYPE":
            found.version = _version(content, path)
        elif label == "APPROX POSITION XYZ":
            x, y, z = (_float(content[i : i + 14]) for i in (0, 14, 28))
            found.approximate_m = (x, y, z) if x * x + y * y + z * z > 1e12 else None
        elif label == "# / TYPES OF OBSERV" and content[:6].strip():
            types = int(_float(content[:6]))
    return types


def _version(content: str, path: Path) -> float:
    version = _float(content[:9])
    if not 2.0 <= version < 4.0:
        raise LogError(
            f"{path}: RINEX version {content[:9].strip() or 'none'} found, expected 2 or 3, which RTKLIB reads"
        )
    return version


def _float(text: str) -> float:
    try:
        return float(text.replace("D", "E"))
    except ValueError:
        return 0.0


def _v3_epochs(lines: Iterator[str]) -> Iterator[int | None]:
    for line in lines:
        if line.startswith(">"):
            found = _V3_EPOCH.match(line)
            if found and found[7] in "01" and int(found[8]) > 0:
                yield _calendar_ns(int(found[1]), found.groups())


def _v2_epochs(lines: Iterator[str], types: int) -> Iterator[int | None]:
    """Epoch lines of version 2; the lines of observations between them are passed over by their number."""
    for line in lines:
        found = _V2_EPOCH.match(line)
        if found is None:
            continue
        count = int(found[8])
        if found[7] in "01":
            if count > 0:
                yield _calendar_ns(_year(int(found[1])), found.groups())
            # more than twelve satellites go on in lines of their own
            count = (count - 1) // 12 + count * -(-types // 5)
        for _ in range(count):
            next(lines, None)


def _year(two: int) -> int:
    return two + (1900 if two >= _TWO_DIGITS else 2000)


def _calendar_ns(year: int, words: tuple[str, ...]) -> int | None:
    """Nanoseconds since 1970 of the month, day, hour, minute and second at places 1 to 5; None where they are no date."""
    month, day, hour, minute = (int(word) for word in words[1:5])
    whole, _, rest = words[5].strip().partition(".")
    try:
        base = round(datetime(year, month, day, tzinfo=UTC).timestamp())
    except ValueError:
        return None
    return (base + hour * 3600 + minute * 60 + int(whole)) * NS_PER_S + int(rest.ljust(9, "0"))


_V2_EPHEMERIS: Final = re.compile(
    r"^([ \d]\d) (\d\d) ([ \d]\d) ([ \d]\d) ([ \d]\d) ([ \d]\d)((?:  \d| \d\d|\d{3})\.\d)[ -]\d?\.\d"
)
_V3_EPHEMERIS: Final = re.compile(r"^([GREJCIS][ \d]\d) (\d{4}) (\d\d) (\d\d) (\d\d) (\d\d) (\d\d)[ -]")


def navigation(path: Path) -> Navigation:
    """Go through a navigation file once.

    Raises
    ------
    LogError
        It is none, its version is not known to RTKLIB, or it has no ephemeris.
    """
    found = Navigation()
    system = "G"
    with open_text(path) as file:
        lines = iter(file)
        for content, label in _header(lines):
            if label == "RINEX VERSION / TYPE":
                found.version = _version(content, path)
                system = "R" if content[20:21] == "G" else "G"
        pattern = _V3_EPHEMERIS if found.version >= 3 else _V2_EPHEMERIS
        for line in lines:
            match = pattern.match(line)
            if match:
                name, year, *rest = match.groups()
                name, number = (name, int(year)) if found.version >= 3 else (f"{system}{name}", _year(int(year)))
                time_ns = _calendar_ns(number, ("", *rest))
                if time_ns is not None:
                    found.times_ns.setdefault(name, []).append(time_ns)
    if not found.times_ns:
        raise LogError(f"{path}: holds no ephemeris, expected a RINEX navigation file")
    return found
