"""NMEA 0183 of a receiver: GGA or GNS for positions, RMC or ZDA for the date, GST for sigmas, RMC or VTG for velocity.

Format: NMEA 0183 version 4.10. Sentences of one epoch are recognised by their time of day, in whatever order they come; what is
between sentences, such as a receiver's binary messages, is passed over.
"""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, TextIO

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from flightlog.errors import LogError
from flightlog.nmea import checksum
from groundproc.flight.positions.scales import in_era, stray
from groundproc.flight.positions.solution import ANTENNA, MSL, Quality, Solution, tidied
from groundproc.text import open_text

Array = npt.NDArray[np.float64]

_SENTENCE: Final = re.compile(
    rb"\$([A-Z]{2}(GGA|GNS|GST|RMC|VTG|ZDA),[\x20-\x23\x25-\x29\x2b-\x7e]*)(?:\*([0-9A-Fa-f]{2}))?"
)
_CLOCK: Final = re.compile(r"([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9]|60)(\.[0-9]{1,9})?", re.ASCII)
_DAY_NS: Final = 86_400 * NS_PER_S
_KNOT_M_S: Final = 1852 / 3600
_LONGEST_LINE: Final = 1 << 16
_LARGEST: Final = 1e9

_GGA_QUALITY: Final = {
    1: Quality.SINGLE, 2: Quality.DGPS, 3: Quality.SINGLE, 4: Quality.FIX, 5: Quality.FLOAT, 6: Quality.DEAD_RECKONING,
}  # fmt: skip
_GNS_QUALITY: Final = {
    "A": Quality.SINGLE, "D": Quality.DGPS, "P": Quality.SINGLE, "R": Quality.FIX, "F": Quality.FLOAT, "E": Quality.DEAD_RECKONING,
}  # fmt: skip
ASSUMED_M: Final = {
    Quality.FIX: 0.02, Quality.FLOAT: 0.4, Quality.SBAS: 1.5, Quality.DGPS: 1.5, Quality.SINGLE: 2.5, Quality.PPP: 0.2,
    Quality.DEAD_RECKONING: 10.0,
}  # fmt: skip
"""Horizontal sigma on each axis at a dilution of precision of 1 [m], where a receiver states none of its own."""
VERTICAL_FACTOR: Final = 1.5


@dataclass(slots=True)
class _Epoch:
    """What the sentences of one time of day say."""

    of_day_ns: int
    date_ns: int | None = None
    place: tuple[float, float, float] | None = None
    """Latitude, longitude, height above sea level."""
    undulation_m: float = math.nan
    quality: Quality = Quality.NONE
    satellites: float = 0.0
    hdop: float = math.nan
    age_s: float = math.nan
    sigmas: tuple[float, float, float, float] | None = None
    """Variances east, north, up and covariance east-north."""
    velocity: tuple[float, float] | None = None
    """East, north."""

    def say(self, words: list[str], quality: Quality, undulation_m: float, age_s: float) -> None:
        """Take a position of GGA or GNS, all of it or, where a word is no number, nothing."""
        place = (_angle(words[2], words[3], "N", "S"), _angle(words[4], words[5], "E", "W"), _value(words[9]))
        satellites, hdop = _value(words[7] or "0"), _optional(words[8])
        self.place, self.quality, self.satellites, self.hdop = place, quality, satellites, hdop
        self.undulation_m, self.age_s = undulation_m, age_s


@dataclass(slots=True)
class _Reader:
    """Sentences gathered into epochs."""

    epochs: list[_Epoch] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)

    def epoch(self, clock: str) -> _Epoch:
        """The epoch of a sentence's time; a new one where it differs from the last."""
        of_day_ns = _of_day_ns(clock)
        if not self.epochs or self.epochs[-1].of_day_ns != of_day_ns:
            self.epochs.append(_Epoch(of_day_ns))
        return self.epochs[-1]

    def take(self, body: bytes, kind: str, given: bytes | None) -> None:
        """One sentence; a damaged one is counted."""
        text = body.decode("ascii")
        whole = given is not None and int(given, 16) == checksum(text)
        try:
            if whole:
                _PARSERS[kind](self, text.split(","))
        except (ValueError, IndexError):
            whole = False
        if not whole:
            self.left_out["damaged"] = self.left_out.get("damaged", 0) + 1


def looks_like_nmea(head: bytes) -> bool:
    """Whether bytes hold a sentence with a position and the right checksum."""
    return any(
        kind in (b"GGA", b"GNS", b"RMC") and given and int(given, 16) == checksum(body.decode("ascii"))
        for body, kind, given in _SENTENCE.findall(head)
    )


def read_nmea(path: Path, *, near_utc_ns: int | None = None) -> Solution:
    """Read a receiver's NMEA sentences.

    Sentences without or with a wrong checksum are left out and counted. Where a receiver sends no GST, sigmas are assumed: `ASSUMED_M`
    times the horizontal dilution of precision, half as much again for heights.

    Parameters
    ----------
    path : Path
    near_utc_ns : int, optional
        A time of the flight [ns]; needed only where the file has no date (RMC or ZDA).

    Raises
    ------
    LogError
        It cannot be read, holds no position, or no date is known.
    """
    reader = _Reader()
    try:
        # one byte a character: what is between sentences may be anything
        with open_text(path, "latin-1") as file:
            for body, kind, given in _sentences(file):
                reader.take(body, kind, given)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from None
    time_ns = _times_ns(reader.epochs, near_utc_ns, path)
    placed = [(t, e) for t, e in zip(time_ns, reader.epochs, strict=True) if e.place is not None]
    if not placed:
        raise LogError(f"{path}: no GGA or GNS sentence with a position and a right checksum in it")
    return tidied(_solution(path, placed, reader.left_out), str(path))


def _sentences(file: TextIO) -> Iterator[tuple[bytes, str, bytes | None]]:
    """Body, kind and checksum of each sentence; lines are cut where a file of other content has none."""
    while line := file.readline(_LONGEST_LINE):
        for body, kind, given in _SENTENCE.findall(line.encode("latin-1", "replace")):
            yield body, kind.decode("ascii"), given or None


def _of_day_ns(text: str) -> int:
    found = _CLOCK.fullmatch(text)
    if found is None:
        raise ValueError
    whole = int(found[1]) * 3600 + int(found[2]) * 60 + int(found[3])
    return whole * NS_PER_S + int((found[4] or ".")[1:].ljust(9, "0"))


def _midnight_ns(year: int, month: int, day: int) -> int:
    return round(datetime(year, month, day, tzinfo=UTC).timestamp()) * NS_PER_S


def _angle(text: str, letter: str, positive: str, negative: str) -> float:
    """Degrees of ddmm.mmm and a letter."""
    if letter not in (positive, negative):
        raise ValueError
    value = _value(text)
    degrees, minutes = divmod(value, 100.0)
    if value < 0 or minutes >= 60.0:
        raise ValueError
    return (degrees + minutes / 60.0) * (1 if letter == positive else -1)


def _value(text: str) -> float:
    """A number that can be one of a receiver's."""
    value = float(text)
    if not abs(value) <= _LARGEST:
        raise ValueError
    return value


def _optional(text: str) -> float:
    return _value(text) if text else math.nan


def _gga(reader: _Reader, words: list[str]) -> None:
    if not words[1]:
        return
    epoch = reader.epoch(words[1])
    quality = _GGA_QUALITY.get(int(words[6] or 0), Quality.NONE)
    if quality is Quality.NONE:
        reader.left_out["without_fix"] = reader.left_out.get("without_fix", 0) + 1
        return
    if words[10] not in ("M", "") or words[12] not in ("M", ""):
        raise ValueError
    epoch.say(words, quality, _optional(words[11]), _optional(words[13]))


def _gns(reader: _Reader, words: list[str]) -> None:
    if not words[1]:
        return
    epoch = reader.epoch(words[1])
    if epoch.place is not None:  # GGA has said the same
        return
    kinds = [_GNS_QUALITY[letter] for letter in words[6] if letter in _GNS_QUALITY]
    if not kinds:
        reader.left_out["without_fix"] = reader.left_out.get("without_fix", 0) + 1
        return
    epoch.place = (_angle(words[2], words[3], "N", "S"), _angle(words[4], words[5], "E", "W"), _value(words[9]))
    # each system has a letter; what the best of them reaches is what the position has
    epoch.quality, epoch.satellites, epoch.hdop = min(kinds), _value(words[7] or "0"), _optional(words[8])
    epoch.undulation_m, epoch.age_s = _optional(words[10]), _optional(words[11])


def _gst(reader: _Reader, words: list[str]) -> None:
    epoch = reader.epoch(words[1])
    major, minor, azimuth_deg = _optional(words[3]), _optional(words[4]), _optional(words[5])
    north, east, up = _optional(words[6]), _optional(words[7]), _optional(words[8])
    if not (north > 0 and east > 0 and up > 0):
        return
    cross = 0.0
    if major > 0 and minor > 0 and math.isfinite(azimuth_deg):
        cross = 0.5 * (major**2 - minor**2) * math.sin(2 * math.radians(azimuth_deg))
        cross = max(-0.999 * east * north, min(0.999 * east * north, cross))
    epoch.sigmas = (east**2, north**2, up**2, cross)


def _rmc(reader: _Reader, words: list[str]) -> None:
    if not words[1]:
        return
    epoch = reader.epoch(words[1])
    date = words[9]
    if len(date) == 6 and date.isdecimal():
        year = int(date[4:])
        epoch.date_ns = _midnight_ns(year + (1900 if year >= 80 else 2000), int(date[2:4]), int(date[:2]))
    if words[2] == "A" and words[7] and words[8]:
        epoch.velocity = _course(_value(words[7]), _value(words[8]))


def _vtg(reader: _Reader, words: list[str]) -> None:
    # it has no time of its own: it belongs to the epoch it stands in
    if reader.epochs and words[1] and words[5]:
        reader.epochs[-1].velocity = _course(_value(words[5]), _value(words[1]))


def _course(speed_knots: float, course_deg: float) -> tuple[float, float]:
    speed, course = speed_knots * _KNOT_M_S, math.radians(course_deg)
    return speed * math.sin(course), speed * math.cos(course)


def _zda(reader: _Reader, words: list[str]) -> None:
    if words[1] and words[2] and words[3] and words[4]:
        reader.epoch(words[1]).date_ns = _midnight_ns(int(words[4]), int(words[3]), int(words[2]))


_PARSERS: Final[dict[str, Callable[[_Reader, list[str]], None]]] = {
    "GGA": _gga, "GNS": _gns, "GST": _gst, "RMC": _rmc, "VTG": _vtg, "ZDA": _zda,
}  # fmt: skip


def _times_ns(epochs: list[_Epoch], near_utc_ns: int | None, path: Path) -> list[int]:
    """Unix times of epochs: by their own date, else the day nearest to the epoch before, else to the one after."""
    known = _known_ns(epochs)
    first = next((t for t in known if t is not None), near_utc_ns)
    if first is None:
        raise LogError(f"{path}: no date in it (RMC or ZDA with a right checksum); a log of the same flight gives one")
    last, times = first, []
    for epoch, time_ns in zip(epochs, known, strict=True):
        last = _nearest(epoch.of_day_ns, last) if time_ns is None else time_ns
        times.append(last)
    return times


def _known_ns(epochs: list[_Epoch]) -> list[int | None]:
    """Unix times of the epochs that have a date; one of another era is mended, and one that none of the others bears out is none."""
    rows = [i for i, epoch in enumerate(epochs) if epoch.date_ns is not None]
    time_ns, _ = in_era(np.array([(e.date_ns or 0) + e.of_day_ns for e in epochs if e.date_ns is not None], np.int64))
    known: list[int | None] = [None] * len(epochs)
    for i, time, wild in zip(rows, time_ns.tolist(), stray(time_ns).tolist(), strict=True):
        known[i] = None if wild else time
    return known


def _nearest(of_day_ns: int, near_ns: int) -> int:
    """The time with this time of day that is nearest to another."""
    return of_day_ns + round((near_ns - of_day_ns) / _DAY_NS) * _DAY_NS


def _solution(path: Path, placed: list[tuple[int, _Epoch]], left_out: dict[str, int]) -> Solution:
    epochs = [epoch for _, epoch in placed]
    place = np.array([epoch.place for epoch in epochs])
    undulation = np.array([epoch.undulation_m for epoch in epochs])
    stated = np.array([epoch.sigmas is not None for epoch in epochs])
    velocity = np.array([(*(epoch.velocity or (math.nan, math.nan)), math.nan) for epoch in epochs])
    return Solution(
        source=path.name,
        format="NMEA",
        point=ANTENNA,
        height_reference=MSL,
        sigma_source=_sigma_source(stated),
        time_ns=np.array([time_ns for time_ns, _ in placed], np.int64),
        latitude_deg=place[:, 0],
        longitude_deg=place[:, 1],
        height_m=place[:, 2],
        covariance_m2=np.array([_covariance(epoch) for epoch in epochs]),
        quality=np.array([epoch.quality for epoch in epochs], np.uint8),
        undulation_m=undulation if np.isfinite(undulation).any() else None,
        velocity_m_s=velocity if np.isfinite(velocity[:, :2]).any() else None,
        satellites=np.array([epoch.satellites for epoch in epochs]),
        age_s=np.array([epoch.age_s for epoch in epochs]),
        left_out=left_out,
    )


def _sigma_source(stated: npt.NDArray[np.bool_]) -> str:
    assumed = "assumed for the kind of fix, times the dilution of precision"
    if stated.all():
        return "GST sentences"
    return assumed if not stated.any() else f"GST sentences; of {int((~stated).sum())} positions {assumed}"


def _covariance(epoch: _Epoch) -> list[list[float]]:
    if epoch.sigmas is not None:
        east, north, up, cross = epoch.sigmas
    else:
        horizontal = ASSUMED_M[epoch.quality] * max(epoch.hdop if math.isfinite(epoch.hdop) else 2.0, 0.5)
        east = north = horizontal**2
        up, cross = (VERTICAL_FACTOR * horizontal) ** 2, 0.0
    return [[east, cross, 0.0], [cross, north, 0.0], [0.0, 0.0, up]]
