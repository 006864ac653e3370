"""NMEA 0183 sentences as the lidar passes them on: GPRMC and its kin (GNRMC). Pure."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from flightlog.constants import NS_PER_S


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
    clock, date = words[1], words[9]
    year = 2000 + int(date[4:6]) if int(date[4:6]) < 80 else 1900 + int(date[4:6])
    midnight = datetime(year, int(date[2:4]), int(date[:2]), tzinfo=UTC)
    fraction = clock[6:].ljust(1, "0") if len(clock) > 6 else ".0"
    # timedelta, not replace(): a leap second is written as second 60
    whole = midnight + timedelta(hours=int(clock[:2]), minutes=int(clock[2:4]), seconds=int(clock[4:6]))
    utc_ns = round(whole.timestamp()) * NS_PER_S + round(float("0" + fraction) * NS_PER_S)
    return Rmc(
        utc_ns=utc_ns,
        valid=words[2] == "A",
        latitude_deg=_angle(words[3], 2) * (-1 if words[4] == "S" else 1),
        longitude_deg=_angle(words[5], 3) * (-1 if words[6] == "W" else 1),
        speed_m_s=float(words[7] or 0) * 1852 / 3600,
        course_deg=float(words[8] or 0),
    )


def _angle(text: str, degree_digits: int) -> float:
    """Ddmm.mmmm to degrees; an empty field is 0."""
    return int(text[:degree_digits]) + float(text[degree_digits:]) / 60 if text else 0.0


def format_rmc(utc_ns: int, latitude_deg: float, longitude_deg: float, *, valid: bool = True) -> str:
    """Write a GPRMC sentence with checksum and line end, as a receiver does."""
    moment = datetime.fromtimestamp(utc_ns // NS_PER_S, UTC)
    latitude, north = abs(latitude_deg), "N" if latitude_deg >= 0 else "S"
    longitude, east = abs(longitude_deg), "E" if longitude_deg >= 0 else "W"
    body = (
        f"GPRMC,{moment:%H%M%S},{'A' if valid else 'V'},"
        f"{int(latitude):02d}{latitude % 1 * 60:07.4f},{north},{int(longitude):03d}{longitude % 1 * 60:07.4f},{east},"
        f"000.0,000.0,{moment:%d%m%y},000.0,E"
    )
    return f"${body}*{checksum(body):02X}\r\n"
