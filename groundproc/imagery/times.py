"""Which image when: events of a log, of a table, of a DJI or Autel .MRK, put to images by name, by order, or by intervals."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import gps_week_to_utc_ns, is_plausible
from flightlog.errors import CaptureError
from groundproc.imagery.exposures import LOGS, Noted, exposures_of
from groundproc.imagery.measurements import rows_of
from groundproc.imagery.poses import NO_TIME
from groundproc.numerics import robust
from groundproc.text import open_text, table_of

Ints = npt.NDArray[np.int64]

_MRK: Final = re.compile(r"\s*(\d+)\s+(\d+(?:\.\d+)?)\s+\[(\d+)\]")
_ALIKE_S: Final = 0.3
"""Intervals between images and between events agree to so much: EXIF often has whole seconds, which leaves a little more."""
_WHOLE_S: Final = 1.1
_QUARTER_S: Final = 900.0
_STEADY_S: Final = 0.02
"""A camera's clock that agrees so well with the events tells the times of images without one: 10 cm at 5 m/s, at most."""


@dataclass(frozen=True, slots=True)
class Timed:
    """Times of images.

    Attributes
    ----------
    utc_ns : ndarray of int64, shape (i,)
        `NO_TIME` for those without.
    note : str
        How they were found.
    offset_s : float
        UTC minus the images' own clock; not a number where no event tells.
    own : ndarray of bool, shape (i,)
        Images without an event, placed by their own clock.
    """

    utc_ns: Ints
    note: str
    offset_s: float
    own: npt.NDArray[np.bool_]


def times_of(path: Path, images: Sequence[str], exif_ns: Ints, camera: Ints | None = None) -> Timed:
    """UTC of images by a file.

    Parameters
    ----------
    path : Path
        A CSV with image,utc_ns; a CSV with utc_ns alone; a .MRK; a log whose autopilot noted exposures (`exposures`).
    images : sequence of str
    exif_ns : ndarray of int64, shape (i,)
        Tell which event is which image where their numbers differ.
    camera : ndarray of int64, shape (i,), optional
        Of each image.

    Raises
    ------
    CaptureError
        It cannot be read, or nothing in it fits.
    """
    if path.suffix.lower() in LOGS:
        noted = exposures_of(path)
        if noted is None:
            raise CaptureError(
                f"{path}: notes no exposures; expected CAMERA_FEEDBACK, CAMERA_IMAGE_CAPTURED or CAMERA_TRIGGER, or CAM or TRIG of a card"
            )
        return by_camera(noted, exif_ns, np.zeros(len(images), np.int64) if camera is None else camera, str(path))
    if path.suffix.lower() == ".mrk":
        return by_order(_mrk(path), exif_ns, str(path))
    named, events = _table(path)
    if not named:
        return by_order(events, exif_ns, str(path))
    rows = rows_of(named, images)
    found = np.array([events[rows[name]] if name in rows else NO_TIME for name in images], np.int64)
    if (found == NO_TIME).all():
        raise CaptureError(f"{path}: none of its images is one of those given, such as {images[0]}")
    return Timed(found, f"times of {path.name}, by name", _offset_s(found, exif_ns), np.zeros(len(images), np.bool_))


def by_camera(noted: Noted, exif_ns: Ints, camera: Ints, place: str) -> Timed:
    """Exposures that an autopilot noted, put to the images of each camera.

    Where it numbers as many cameras as there are, each has its own; else all cameras expose together.

    Raises
    ------
    CaptureError
        They do not fit; see `by_order`.
    """
    numbers, cameras = np.unique(noted.camera), np.unique(camera)
    of_each = len(numbers) == len(cameras) > 1
    place = f"{place} ({noted.source})"
    utc_ns, own = np.full(len(exif_ns), NO_TIME), np.zeros(len(exif_ns), np.bool_)
    notes, offsets = [], []
    for rank, number in enumerate(cameras.tolist()):
        mine = camera == number
        events = noted.utc_ns[noted.camera == numbers[rank]] if of_each else np.unique(noted.utc_ns)
        timed = by_order(events, exif_ns[mine], place)
        utc_ns[mine], own[mine] = timed.utc_ns, timed.own
        notes.append(timed.note)
        offsets.append(timed.offset_s)
    return Timed(utc_ns, "; ".join(dict.fromkeys(notes)), offsets[0], own)


def _offset_s(utc_ns: Ints, exif_ns: Ints) -> float:
    """UTC minus the images' own clock, the median; not a number where none has both."""
    both = (utc_ns != NO_TIME) & (exif_ns != NO_TIME)
    return float(np.median(utc_ns[both] - exif_ns[both])) * 1e-9 if both.any() else float("nan")


def _table(path: Path) -> tuple[list[str], Ints]:
    """Names, where the table has any, and stamps."""
    names: list[str] = []
    stamps: list[int] = []
    try:
        with open_text(path) as file:
            table = table_of(file, str(path), "utc_ns", CaptureError, "times of images have image,utc_ns")
            at = table.names.index("utc_ns")
            named = table.names.index("image") if "image" in table.names else None
            for number, words in table.rows():
                if not re.fullmatch(r"\d{15,19}", words[at].strip()):
                    raise CaptureError(f"{path}: line {number}: {table.blame(words, 'utc_ns in whole nanoseconds')}")
                stamps.append(int(words[at]))
                names += [words[named]] if named is not None else []
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not stamps:
        raise CaptureError(f"{path}: holds no times")
    return names, np.array(stamps, np.int64)


def _mrk(path: Path) -> Ints:
    """UTC of the events of a .MRK: number, seconds of the GPS week, [week]."""
    stamps: list[int] = []
    try:
        with open_text(path) as file:
            for number, line in enumerate(file, 1):
                found = _MRK.match(line)
                if found is None:
                    if line.strip():
                        raise CaptureError(f"{path}: line {number}: expected a number, seconds of the week and [week]")
                    continue
                whole, _, part = found[2].partition(".")
                stamp = gps_week_to_utc_ns(int(found[3]), int(whole) * 1000) + int(part.ljust(9, "0")[:9] or 0)
                if not is_plausible(stamp):
                    raise CaptureError(f"{path}: line {number}: week {found[3]} is no date of a flight")
                stamps.append(stamp)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not stamps:
        raise CaptureError(f"{path}: holds no events")
    return np.array(stamps, np.int64)


def by_order(events: Ints, exif_ns: Ints, place: str) -> Timed:
    """Events put to images in the order of both; where numbers or intervals differ, by the intervals between them.

    An image without an event is placed by its own clock where that has sub-seconds and agrees with the events.

    Raises
    ------
    CaptureError
        Numbers differ, and the images' own times do not tell which is which.
    """
    events = np.sort(events)
    count = len(exif_ns)
    order = np.argsort(exif_ns, kind="stable")
    stamped = exif_ns[order]
    untold = bool((stamped == NO_TIME).any()) or count < 3
    whole = not untold and bool((stamped % 10**9 == 0).all())
    slack_s = _WHOLE_S if whole else _ALIKE_S
    nothing = np.zeros(count, np.bool_)
    if len(events) == count:
        off_s = (events - stamped) * 1e-9
        if untold or np.abs(off_s - np.median(off_s)).max() < slack_s:
            found = np.empty(count, np.int64)
            found[order] = events
            return Timed(found, f"times of {place}, by order", _offset_s(found, exif_ns), nothing)
    if untold:
        raise CaptureError(
            f"{place}: {len(events)} events for {count} images, and the images' own times do not tell which is which"
        )
    _, partners = _aligned(events, stamped, slack_s)
    found = np.full(count, NO_TIME)
    has = partners >= 0
    if has.sum() < max(3, 0.5 * count):
        raise CaptureError(f"{place}: {len(events)} events for {count} images, and no clock offset makes them agree")
    found[order[has]] = events[partners[has]]
    note = f"times of {place}, by intervals: {int(has.sum())} of {count} images have one"
    offset_s = _offset_s(found, exif_ns)
    off_s = (found - exif_ns)[found != NO_TIME] * 1e-9 - offset_s
    own = (found == NO_TIME) & (robust.MAD_TO_SIGMA * float(np.median(np.abs(off_s))) < _STEADY_S)
    return Timed(np.where(own, exif_ns + round(offset_s * 1e9), found), note, offset_s, own)


def _aligned(events: Ints, stamps: Ints, slack_s: float) -> tuple[float, Ints]:
    """The clock offset [s] under which most stamps have an event of their own, and the event of each, -1 where none."""
    zero = events[0]
    event_s, stamp_s = (events - zero) * 1e-9, (stamps - zero) * 1e-9
    tried = []
    for anchor in (0, len(stamp_s) // 2, len(stamp_s) - 1):
        for event in event_s:
            offset = float(event - stamp_s[anchor])
            _, gap = _nearest(event_s, stamp_s + offset)
            inside = gap < slack_s
            tried.append((offset, int(inside.sum()), float(gap[inside].mean()) if inside.any() else np.inf))
    most = max(count for _, count, _ in tried)
    least = min(mean for _, count, mean in tried if count == most)
    # exposures in step fit as well one step later: clocks are set, and show local time at worst
    alike = [offset for offset, count, mean in tried if count == most and mean <= 2.0 * least + 0.02]
    offset = min(alike, key=lambda offset: abs(offset - _QUARTER_S * round(offset / _QUARTER_S)))
    near, gap = _nearest(event_s, stamp_s + offset)
    partners = np.where(gap < slack_s, near, -1)
    # one event, one image: of two that ask for it the nearer one gets it
    for event in np.unique(partners[partners >= 0]):
        asking = np.flatnonzero(partners == event)
        partners[asking[asking != asking[np.argmin(gap[asking])]]] = -1
    return offset, partners


def _nearest(
    event_s: npt.NDArray[np.float64], stamp_s: npt.NDArray[np.float64]
) -> tuple[Ints, npt.NDArray[np.float64]]:
    after = np.clip(np.searchsorted(event_s, stamp_s), 1, len(event_s) - 1)
    near = np.where(stamp_s - event_s[after - 1] < event_s[after] - stamp_s, after - 1, after)
    return near, np.abs(event_s[near] - stamp_s)
