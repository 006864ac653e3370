"""RTKLIB's solution files (.pos): read in every form that RTKLIB writes, and written in one.

Format: RTKLIB 2.4.3 manual, appendix B.1. Times are calendar or week and seconds of week, in GPS time, UTC or Japan's. Positions are
degrees, degrees-minutes-seconds, geocentric, or a baseline from a stated base. Fields are parted by white space or by any one character.
"""

import dataclasses
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import GPS_EPOCH_UNIX_S
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError
from groundproc.flight.positions.ellipsoid import ecef_from_geodetic, geodetic_from_ecef, mat_ecef_enu, turned
from groundproc.flight.positions.scales import utc_from_gps_calendar
from groundproc.flight.positions.solution import ANTENNA, ELLIPSOID, INS, MSL, Quality, Solution, symmetric, tidied
from groundproc.text import decimal_comma, open_text

Array = npt.NDArray[np.float64]

_FIRST: Final = {"latitude": "llh", "x-ecef": "xyz", "e-baseline": "enu"}
_COLUMN_LINE: Final = re.compile(r"^%\s+(GPST|UTC|JST)\s*(\S?)\s*((?:latitude|x-ecef|e-baseline)\(.*)$")
_SIGMAS: Final = {"llh": "sdn", "xyz": "sdx", "enu": "sde"}
_COLUMNS: Final = {
    "llh": ("latitude", "longitude", "height", "Q", "ns", "sdn", "sde", "sdu", "", "", "", "age", "ratio"),
    "xyz": ("x-ecef", "y-ecef", "z-ecef", "Q", "ns", "sdx", "sdy", "sdz", "", "", "", "age", "ratio"),
    "enu": ("e-baseline", "n-baseline", "u-baseline", "Q", "ns", "sde", "sdn", "sdu", "", "", "", "age", "ratio"),
}
_WEEK_S: Final = 604_800
_LATEST_NS: Final = 1 << 62
_LARGEST: Final = 1e12
"""Of a value: what RTKLIB writes when it is lost is below, and its square is a number."""
_NEAREST_M: Final = 6.3e6
_FARTHEST_M: Final = 6.5e6
"""From the centre of the Earth."""
_JST_AHEAD_S: Final = 9 * 3600
_FORMAT: Final = "RTKLIB .pos"
POINT_OF_INS: Final = "point     : origin of the ins frame"
"""A line of the header of files that hold the way of the IMU, not that of an antenna."""


@dataclass(slots=True)
class _Header:
    """What the lines that begin with % say."""

    scale: str = ""
    layout: str = ""
    separator: str | None = None
    names: tuple[str, ...] = ()
    sexagesimal: bool = False
    geodetic: bool = False
    datum: str = "WGS84"
    base: str = ""
    combined: bool = False
    ratio_threshold: float = math.inf
    program: str = ""
    point: str = ANTENNA


def looks_like_pos(head: str) -> bool:
    """Whether the beginning of a text is an RTKLIB solution: its line of column names tells."""
    return any(_COLUMN_LINE.match(line) for line in head.splitlines())


def read_pos(path: Path) -> Solution:
    """Read an RTKLIB solution.

    A file that RTKLIB combined of a forward and a backward run states sigmas that are too small by the root of two, because both runs
    rest on the same observations; they are restored. Its rows where both runs fixed different ambiguities are contradictions, which
    RTKLIB marks as float with the sigma of a fix; they are left out and counted.

    Parameters
    ----------
    path : Path

    Raises
    ------
    LogError
        It cannot be read, has no line of column names, or holds no position.
    """
    header, table, times, damaged = _parse(path)
    _check_columns(header, path)
    if header.datum != "WGS84":
        raise LogError(f"{path}: its datum is {header.datum}, expected WGS84")
    column = {name: table[:, i] for i, name in enumerate(header.names)}
    base = _base(header, path)
    latitude, longitude, height, mat_place = _places(header, column, base)
    first = header.names.index(_SIGMAS[header.layout])
    covariance = _covariance(table[:, first : first + 6], header.layout)
    covariance = turned(mat_place, covariance) if mat_place is not None else covariance
    velocity, velocity_covariance = _velocity(header, table, mat_place)
    quality = np.where((column["Q"] >= 0) & (column["Q"] <= Quality.DEAD_RECKONING), column["Q"], 0).astype(np.uint8)
    found = Solution(
        source=path.name,
        format=_FORMAT,
        point=header.point,
        height_reference=MSL if header.geodetic else ELLIPSOID,
        sigma_source="RTKLIB's filter",
        time_ns=times,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        covariance_m2=covariance,
        quality=quality,
        velocity_m_s=velocity,
        velocity_covariance_m2_s2=velocity_covariance,
        satellites=column["ns"],
        age_s=column["age"],
        ratio=column["ratio"],
        base_ecef_m=base,
        left_out={"damaged": damaged} if damaged else {},
    )
    return tidied(_uncombined(found, header) if header.combined else found, str(path))


def _check_columns(header: _Header, path: Path) -> None:
    """The columns that RTKLIB always writes, in its order; the three roots of covariances have names of several spellings."""
    places = tuple(name for name in header.names if not name.endswith("'"))
    for found, expected in itertools.zip_longest(places[:13], _COLUMNS[header.layout]):
        if expected and found != expected:
            raise LogError(
                f"{path}: its line of column names has {found or 'nothing'} in the place of {expected}; is it RTKLIB's?"
            )


def _uncombined(solution: Solution, header: _Header) -> Solution:
    """What RTKLIB's combination makes too good, put right; see `read_pos`."""
    assert solution.ratio is not None
    against = (solution.quality == Quality.FLOAT) & (solution.ratio >= header.ratio_threshold)
    left_out = solution.left_out | ({"contradictory": int(against.sum())} if against.any() else {})
    note = "combined by RTKLIB: sigmas times the root of two, because both runs rest on the same observations"
    kept = solution.rows(~against)
    return dataclasses.replace(kept, covariance_m2=kept.covariance_m2 * 2.0, left_out=left_out, notes=(note,))


def _parse(path: Path) -> tuple[_Header, Array, npt.NDArray[np.int64], int]:
    """Header, values (n, columns), times (n,) and the number of lines that are no row."""
    header = _Header()
    rows: list[list[float]] = []
    times: list[int] = []
    damaged, comma = 0, ""
    try:
        with open_text(path) as file:
            for line in file:
                if line.startswith("%"):
                    _header_line(line.rstrip("\r\n"), header)
                elif line.strip():
                    row = _row(line, header) if header.names else None
                    if row is None:
                        damaged += 1
                        comma = comma or decimal_comma(line.split(header.separator))
                        continue
                    times.append(row[0])
                    rows.append(row[1])
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from None
    if not header.names:
        raise LogError(
            f"{path}: has no line of column names (% GPST latitude(deg) ...); RTKLIB's option out-outhead=on writes it"
        )
    if not rows:
        reason = f"; {comma}" if comma else f", {damaged} lines are damaged" if damaged else ""
        raise LogError(f"{path}: holds no position; RTKLIB found none{reason}")
    return header, np.array(rows), _utc_ns(np.array(times, np.int64), header.scale), damaged


def _utc_ns(time_ns: npt.NDArray[np.int64], scale: str) -> npt.NDArray[np.int64]:
    """Unix times of calendars of a scale."""
    if scale == "GPST":
        return utc_from_gps_calendar(time_ns)
    return np.asarray(time_ns - (_JST_AHEAD_S * NS_PER_S if scale == "JST" else 0))


def _header_line(line: str, header: _Header) -> None:
    columns = _COLUMN_LINE.match(line)
    if columns:
        _columns(columns, header)
        return
    label, colon, value = line[1:].partition(":")
    label, value = label.strip(), value.strip()
    if "=" in label or label.startswith("("):
        found = re.search(r"(?:height|ecef|baseline)=(\w+)(?:/(\w+))?", line)
        if found:
            header.datum, header.geodetic = found[1], found[2] == "geodetic"
    elif colon and label == "ref pos":
        header.base = value
    elif colon and label == "solution":
        header.combined = value.lower() == "combined"
    elif colon and label == "val thres":
        header.ratio_threshold = _number(value)
    elif colon and label == "program":
        header.program = value
    elif line[1:].strip() == POINT_OF_INS:
        header.point = INS


def _columns(found: re.Match[str], header: _Header) -> None:
    """The line of column names: it says time scale, layout, separator and which columns there are."""
    header.scale, separator, rest = found[1], found[2], found[3]
    plain = re.match(r"\S+?\)(.)", rest)
    header.separator = (separator or (plain[1] if plain else " ")).strip() or None
    if header.separator is None and "\t" in rest:
        header.separator = "\t"
    words = rest.split(header.separator)
    names = [word.strip().partition("(")[0] for word in words]
    if names[0] not in _FIRST:
        return
    header.layout = _FIRST[names[0]]
    header.sexagesimal = "'" in words[0]
    if header.sexagesimal:
        names[:2] = ["latitude", "latitude'", "latitude''", "longitude", "longitude'", "longitude''"]
    header.names = tuple(names)


def _row(line: str, header: _Header) -> tuple[int, list[float]] | None:
    """Time [ns] and values of a line; None where it is none."""
    words = line.split(header.separator)
    calendar = "/" in words[0]
    try:
        if calendar and header.separator is not None:
            day, clock = words[0].split()
            time_ns, words = _calendar_ns(day, clock), words[1:]
        elif calendar:
            time_ns, words = _calendar_ns(words[0], words[1]), words[2:]
        else:
            time_ns, words = _week_ns(words[0], words[1]), words[2:]
        values = [float(word) for word in words]
    except (ValueError, IndexError, OverflowError):
        return None
    possible = all(abs(value) <= _LARGEST for value in values) and 0 <= time_ns < _LATEST_NS
    if len(values) != len(header.names) or not possible:
        return None
    return time_ns, values


_DAYS: dict[str, int] = {}


def _calendar_ns(day: str, clock: str) -> int:
    """Nanoseconds since 1970 of a calendar, leap seconds not counted; each day is worked out once."""
    if day not in _DAYS:
        if len(_DAYS) > 1000:
            _DAYS.clear()
        year, month, date = map(int, day.split("/"))
        _DAYS[day] = round(datetime(year, month, date, tzinfo=UTC).timestamp())
    hour, minute, second = clock.split(":")
    whole = _DAYS[day] + int(hour) * 3600 + int(minute) * 60
    return whole * NS_PER_S + _decimal_ns(second)


def _week_ns(week: str, tow: str) -> int:
    """The same of week and seconds of week."""
    return (GPS_EPOCH_UNIX_S + int(week) * _WEEK_S) * NS_PER_S + _decimal_ns(tow)


def _decimal_ns(text: str) -> int:
    """Nanoseconds of decimal seconds, exactly."""
    whole, _, rest = text.strip().partition(".")
    return int(whole) * NS_PER_S + int(rest[:9].ljust(9, "0"))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.inf


def _base(header: _Header, path: Path) -> tuple[float, float, float] | None:
    """The base station's place, geocentric [m]; None where the file names none."""
    words = header.base.replace(header.separator or " ", " ").split()
    values = [_number(word) for word in words]
    place = None
    if len(values) == 3 and header.layout == "xyz":
        place = np.array(values)
    elif len(values) in (3, 7):
        angles = values[:2] if len(values) == 3 else [_degrees(values[:3]), _degrees(values[3:6])]
        place = ecef_from_geodetic(np.array(angles[0]), np.array(angles[1]), np.array(values[-1]))
    # RTKLIB writes zeros where there is no base
    if place is not None and _NEAREST_M < float(np.linalg.norm(place)) < _FARTHEST_M and any(values):
        return float(place[0]), float(place[1]), float(place[2])
    if header.layout == "enu":
        raise LogError(f"{path}: has baselines, but no line of the base station's place (% ref pos)")
    return None


def _degrees(words: Sequence[float]) -> float:
    """Degrees of degrees, minutes, seconds; the sign is the degrees' own, that of a negative zero too."""
    return math.copysign(abs(words[0]) + words[1] / 60 + words[2] / 3600, words[0])


def _places(
    header: _Header, column: dict[str, Array], base: tuple[float, float, float] | None
) -> tuple[Array, Array, Array, Array | None]:
    """Latitude, longitude, height (n,), and what turns the file's axes into east, north, up, shape (n, 3, 3); None: nothing."""
    if header.layout == "llh":
        angles = [column["latitude"], column["longitude"]]
        if header.sexagesimal:
            angles = [
                np.copysign(np.abs(column[n]) + column[n + "'"] / 60 + column[n + "''"] / 3600, column[n])
                for n in ("latitude", "longitude")
            ]
        return angles[0], angles[1], column["height"], None
    if header.layout == "xyz":
        place = np.stack([column[name] for name in ("x-ecef", "y-ecef", "z-ecef")], axis=-1)
        latitude, longitude, height = geodetic_from_ecef(place)
        return latitude, longitude, height, np.swapaxes(mat_ecef_enu(latitude, longitude), -1, -2)
    assert base is not None
    origin = np.array(base)
    base_latitude, base_longitude, _ = geodetic_from_ecef(origin)
    mat_base = mat_ecef_enu(base_latitude, base_longitude)
    baseline = np.stack([column[f"{axis}-baseline"] for axis in "enu"], axis=-1)
    latitude, longitude, height = geodetic_from_ecef(origin + baseline @ mat_base.T)
    return latitude, longitude, height, np.swapaxes(mat_ecef_enu(latitude, longitude), -1, -2) @ mat_base


def _covariance(values: Array, layout: str) -> Array:
    """Covariances, shape (n, 3, 3), of six columns: three sigmas, then three signed roots of covariances.

    Degrees come as n, e, u, ne, eu, un; geocentric as x, y, z, xy, yz, zx; baselines as e, n, u, en, nu, ue. Columns of degrees are put
    in the order east, north, up; the others keep theirs.
    """
    square = np.copysign(np.square(values), values)
    a, b, c, ab, bc, ca = np.moveaxis(square, -1, 0)
    if layout == "llh":  # n, e, u, ne, eu, un
        return symmetric(np.stack([b, a, c], axis=-1), ab, ca, bc)
    return symmetric(np.stack([a, b, c], axis=-1), ab, bc, ca)


def _velocity(header: _Header, table: Array, mat_place: Array | None) -> tuple[Array | None, Array | None]:
    """Velocities and covariances in east, north, up; None where the file has none. RTKLIB writes zeros where it estimates none."""
    first = next((i for i, name in enumerate(header.names) if name in ("vn", "vx", "ve")), None)
    if first is None or first + 9 > len(header.names):
        return None, None
    velocity = table[:, first : first + 3]
    covariance = _covariance(table[:, first + 3 : first + 9], header.layout)
    if header.layout == "llh":
        velocity = velocity[:, [1, 0, 2]]
    if mat_place is not None:
        velocity = np.einsum("nij,nj->ni", mat_place, velocity)
        covariance = turned(mat_place, covariance)
    stated = (np.einsum("nii->ni", covariance) > 0).all(axis=1)
    if not stated.any():
        return None, None
    return np.where(stated[:, None], velocity, np.nan), np.where(stated[:, None, None], covariance, np.nan)
