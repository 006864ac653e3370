"""NMEA 0183 sentences as the lidar passes them on: GPRMC and its kin (GNRMC). Pure."""

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

from flightlog.constants import NS_PER_S

_CLOCK: Final = re.compile(r"([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9]|60)(\.[0-9]{1,9})?", re.ASCII)
_DATE: Final = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2})", re.ASCII)
_FASTEST_M_S: Final = 10_000.0
_TOP_YEAR: Final = 80
"""Two-digit years from here on are of the 1900s: GPS began in 1980."""


@dataclass(frozen=True, slots=True)
class Rmc:
    """Recommended minimum data of a GPS receiver."""

    utc_ns: int
    """Unix time [ns] that the sentence states."""
    valid: bool
    """Status A; a receiver without a fix says V and may still know the time."""
    latitude_deg: float
    longitude_deg: float
    speed_m_s: float
    course_deg: float


def checksum(body: str) -> int:
    """XOR of the characters between $ and *."""
    value = 0
    for character in body.encode("ascii", errors="replace"):
        value ^= character
    return value


def parse_rmc(text: str | bytes) -> Rmc | None:
    """Read an RMC sentence; None for anything else, for a wrong checksum, and for one without date and time."""
    if isinstance(text, bytes):
        text = text.split(b"\x00")[0].decode("ascii", errors="replace")
    text = text.strip()
    if not text.startswith("$") or text[3:6] != "RMC":
        return None
    body, star, given = text[1:].partition("*")
    try:
        if star and int(given[:2], 16) != checksum(body):
            return None
        return _parse_fields(body.split(","))
    except (ValueError, IndexError, OverflowError):
        return None


def _parse_fields(words: list[str]) -> Rmc:
    clock, date = _CLOCK.fullmatch(words[1]), _DATE.fullmatch(words[9])
    if clock is None or date is None:  # a sentence that was cut may still look like one: "1112" of "111212"
        raise ValueError
    day, month, year = map(int, date.groups())
    midnight = datetime((1900 if year >= _TOP_YEAR else 2000) + year, month, day, tzinfo=UTC)
    # timedelta, not replace(): a leap second is written as second 60
    whole = midnight + timedelta(hours=int(clock[1]), minutes=int(clock[2]), seconds=int(clock[3]))
    fraction_ns = int((clock[4] or ".")[1:].ljust(9, "0"))
    utc_ns = round(whole.timestamp()) * NS_PER_S + fraction_ns
    found = Rmc(
        utc_ns=utc_ns,
        valid=words[2] == "A",
        latitude_deg=_angle(words[3], 2) * (-1 if words[4] == "S" else 1),
        longitude_deg=_angle(words[5], 3) * (-1 if words[6] == "W" else 1),
        speed_m_s=float(words[7] or 0) * 1852 / 3600,
        course_deg=float(words[8] or 0),
    )
    if not _is_possible(found):
        raise ValueError
    return found


def _is_possible(found: Rmc) -> bool:
    """Whether it is a place on Earth, and a speed and a course that can be; `float` also reads nan, inf and 1e300."""
    on_earth = abs(found.latitude_deg) <= 90.0 and abs(found.longitude_deg) <= 180.0
    return on_earth and abs(found.speed_m_s) <= _FASTEST_M_S and abs(found.course_deg) <= 720.0


def _angle(text: str, degree_digits: int) -> float:
    """Ddmm.mmmm to degrees; an empty field is 0."""
    return int(text[:degree_digits]) + float(text[degree_digits:]) / 60 if text else 0.0


def format_rmc(utc_ns: int, latitude_deg: float, longitude_deg: float, *, valid: bool = True) -> str:
    """Write a GPRMC sentence with checksum and line end, as a receiver does; fractions of a second are cut off."""
    moment = datetime.fromtimestamp(utc_ns // NS_PER_S, UTC)
    north, east = "N" if latitude_deg >= 0 else "S", "E" if longitude_deg >= 0 else "W"
    body = (
        f"GPRMC,{moment:%H%M%S},{'A' if valid else 'V'},"
        f"{_degrees_minutes(latitude_deg, 2)},{north},{_degrees_minutes(longitude_deg, 3)},{east},"
        f"000.0,000.0,{moment:%d%m%y},000.0,E"
    )
    return f"${body}*{checksum(body):02X}\r\n"


def _degrees_minutes(angle_deg: float, degree_digits: int) -> str:
    """Ddmm.mmmm of an angle; rounded before it is split, so that minutes never read 60."""
    degrees, minutes = divmod(round(abs(angle_deg) * 600_000), 600_000)
    return f"{degrees:0{degree_digits}d}{minutes / 10_000:07.4f}"
