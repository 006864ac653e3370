"""What RTKLIB gets: RINEX of the user's files, found to fit together."""

import gzip
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from flightlog.constants import NS_PER_S
from flightlog.errors import SourceError, SwathError
from groundproc.flight.positions import rinex
from groundproc.flight.positions.ppkoptions import Base, PpkError
from groundproc.flight.positions.ppkrunning import SOLVER, run, tool
from groundproc.machine import system
from groundproc.text import head_of, is_plain, make_plain, open_text

CONVERTER: Final = "convbin"
_EPHEMERIS_REACH_NS: Final = 2 * 3600 * NS_PER_S
"""How far from its reference time RTKLIB uses a GPS ephemeris."""
_FEWEST_SATELLITES: Final = 4


@dataclass(frozen=True, slots=True)
class Input:
    """A file as RTKLIB gets it: `path` in the working folder, `name` as the user knows it."""

    name: str
    kind: str
    path: Path
    converted: bool = False


def prepared(rover: Path, base: Path, navigation: Sequence[Path], folder: Path) -> list[Input]:
    """Rover, base and navigation as RINEX files in the working folder; converted and unpacked where they must be."""
    tool(SOLVER)
    inputs = [*_taken(rover, "rover", folder), *_taken(base, "base", folder)]
    for number, path in enumerate(navigation):
        inputs += _taken(path, f"nav{number}", folder)
    for wanted, path in (("rover", rover), ("base", base)):
        if not any(item.kind == "observations" and item.path.stem == wanted for item in inputs):
            raise PpkError(f"{path}: holds no observations, expected RINEX or u-blox RXM-RAWX")
    extra = [item for item in inputs if item.kind == "observations" and item.path.stem not in ("rover", "base")]
    if extra:
        raise PpkError(f"{extra[0].name}: holds observations, expected ephemerides (--nav)")
    return sorted(inputs, key=lambda item: (item.kind != "observations", item.path.stem != "rover"))


def _taken(path: Path, stem: str, folder: Path) -> list[Input]:
    """One file of the user as what it is, by its content."""
    whole = _unpacked(path, folder / f"{stem}.raw")
    try:
        kind = rinex.kind_of(head_of(whole, 1 << 16))
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    if kind in ("observations", "navigation"):
        link = folder / f"{stem}.{'obs' if kind == 'observations' else 'nav'}"
        if is_plain(whole):
            system.linked(link, whole)
        else:  # RTKLIB looks at columns of plain text
            make_plain(whole, link)
        return [Input(path.name, kind, link)]
    if kind == "ubx":
        return _converted(path, whole, stem, folder)
    reasons = {
        "compact": "is Hatanaka-compressed RINEX; crx2rnx unpacks it",
        "other_rinex": "is RINEX, but neither observations nor GPS navigation",
        "rtcm3": "is RTCM 3, which does not say its date; convbin -r rtcm3 -tr DATE TIME makes RINEX of it",
    }
    raise PpkError(f"{path}: {reasons.get(kind, 'is nothing that is known')}, expected RINEX 2 or 3 or u-blox UBX")


def _unpacked(path: Path, to: Path) -> Path:
    """The file itself, or what is in it if it is gzip."""
    try:
        with path.open("rb") as file:
            if file.read(2) != b"\x1f\x8b":
                return path
        with gzip.open(path, "rb") as packed, to.open("wb") as plain:
            shutil.copyfileobj(packed, plain, 1 << 20)
    except (EOFError, gzip.BadGzipFile) as error:
        raise PpkError(f"{path}: is a damaged gzip file ({error})") from None
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    return to


def _converted(path: Path, whole: Path, stem: str, folder: Path) -> list[Input]:
    """RINEX of a u-blox file, by RTKLIB."""
    observed, sent = folder / f"{stem}.obs", folder / f"{stem}.nav"
    words = [
        tool(CONVERTER),
        "-r",
        "ubx",
        "-v",
        "3.04",
        "-od",
        "-os",
        "-o",
        observed.name,
        "-n",
        sent.name,
        str(whole.resolve()),
    ]
    run([words], folder, None)
    found = [
        Input(path.name, kind, made, converted=True)
        for kind, made in (("observations", observed), ("navigation", sent))
        if _has_body(made)
    ]
    if not found:
        raise PpkError(f"{path}: holds neither observations (RXM-RAWX) nor ephemerides (RXM-SFRBX) of u-blox")
    return found


def _has_body(path: Path) -> bool:
    """Whether a RINEX file has anything after its header."""
    if not path.is_file():
        return False
    with open_text(path) as file:
        for line in file:
            if line[60:].startswith("END OF HEADER"):
                return bool(next(file, "").strip())
    return False


def checked(inputs: Sequence[Input], where: Base) -> tuple[rinex.Observations, rinex.Observations, list[str]]:
    """Observations of rover and base, found to fit together, and sentences on what is not as it should be."""
    seen, base_seen = (_named(item, rinex.observations) for item in inputs[:2])
    rover_name, base_name = inputs[0].name, inputs[1].name
    overlap_s = (min(seen.end_ns, base_seen.end_ns) - max(seen.start_ns, base_seen.start_ns)) / NS_PER_S
    if overlap_s <= 0:
        raise PpkError(
            f"{base_name}: covers {stretch(base_seen)}, but the rover {rover_name} {stretch(seen)}: they do not overlap in time"
        )
    if where.position is None and not where.averaged:
        help_is = "give --base-position, or --base-average for a rough one"
        if inputs[1].converted:
            raise PpkError(f"{base_name}: a UBX file states no surveyed position; {help_is}")
        if base_seen.approximate_m is None:
            raise PpkError(f"{base_name}: its header states no position; {help_is}")
    _check_ephemerides(inputs, seen, rover_name)
    notes = []
    if overlap_s < 0.99 * seen.seconds:
        notes.append(f"the base covers {overlap_s:.0f} s of the rover's {seen.seconds:.0f} s only")
    return seen, base_seen, notes


def _named(item: Input, read: Callable[[Path], Any]) -> Any:
    """What a reader gives of a file in the working folder; its errors name the user's file."""
    try:
        return read(item.path)
    except SwathError as error:
        raise PpkError(str(error).replace(str(item.path), item.name)) from None


def _check_ephemerides(inputs: Sequence[Input], seen: rinex.Observations, rover_name: str) -> None:
    sent: list[rinex.Navigation] = [_named(item, rinex.navigation) for item in inputs if item.kind == "navigation"]
    if not sent:
        raise PpkError(
            f"{rover_name}: there is no ephemeris; give a RINEX navigation file with --nav (services of base stations have them)"
        )
    count = sum(item.satellites_near(seen.start_ns, seen.end_ns, _EPHEMERIS_REACH_NS) for item in sent)
    if count < _FEWEST_SATELLITES:
        raise PpkError(
            f"{rover_name}: the navigation files have ephemerides of {count} satellites within 2 h of {stretch(seen)}, expected "
            f"{_FEWEST_SATELLITES} or more"
        )


def stretch(seen: rinex.Observations) -> str:
    """From when to when, in words."""
    start, end = (
        np.datetime_as_string(np.datetime64(t, "ns"), "s").replace("T", " ") for t in (seen.start_ns, seen.end_ns)
    )
    return f"{start} to {end}"
