"""Which image when: tables of events, a DJI or Autel .MRK, put to images by name or by order."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import gps_week_to_utc_ns, is_plausible
from flightlog.errors import CaptureError
from groundproc.imagery.measurements import rows_of
from groundproc.imagery.poses import NO_TIME
from groundproc.text import open_text, table_of

Ints = npt.NDArray[np.int64]

_MRK: Final = re.compile(r"\s*(\d+)\s+(\d+(?:\.\d+)?)\s+\[(\d+)\]")
_ALIKE_S: Final = 0.3
"""Intervals between images and between events agree to so much: EXIF often has whole seconds, which leaves a little more."""
_WHOLE_S: Final = 1.1


def times_of(path: Path, images: Sequence[str], exif_ns: Ints) -> tuple[Ints, str]:
    """UTC of images [ns], `NO_TIME` for those without a partner, and a sentence on how they were found.

    Parameters
    ----------
    path : Path
        A CSV with image,utc_ns; a CSV with utc_ns alone; or a .MRK.
    images : sequence of str
    exif_ns : ndarray of int64, shape (i,)
        Tell which event is which image where their numbers differ.

    Raises
    ------
    CaptureError
        It cannot be read, or nothing in it fits.
    """
    if path.suffix.lower() == ".mrk":
        return by_order(_mrk(path), exif_ns, str(path))
    named, events = _table(path)
    if not named:
        return by_order(events, exif_ns, str(path))
    rows = rows_of(named, images)
    found = np.array([events[rows[name]] if name in rows else NO_TIME for name in images], np.int64)
    if (found == NO_TIME).all():
        raise CaptureError(f"{path}: none of its images is one of those given, such as {images[0]}")
    return found, f"times of {path.name}, by name"


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


def by_order(events: Ints, exif_ns: Ints, place: str) -> tuple[Ints, str]:
    """Events put to images in the order of both; where their numbers differ, by the intervals between them.

    Raises
    ------
    CaptureError
        Numbers differ, and the images' own times do not tell which is which.
    """
    events = np.sort(events)
    count = len(exif_ns)
    order = np.argsort(exif_ns, kind="stable")
    if len(events) == count:
        found = np.empty(count, np.int64)
        found[order] = events
        return found, f"times of {place}, by order"
    stamped = exif_ns[order]
    if (stamped == NO_TIME).any() or count < 3:
        raise CaptureError(
            f"{place}: {len(events)} events for {count} images, and the images' own times do not tell which is which"
        )
    whole = bool((stamped % 10**9 == 0).all())
    offset, partners = _aligned(events, stamped, _WHOLE_S if whole else _ALIKE_S)
    del offset
    found = np.full(count, NO_TIME)
    has = partners >= 0
    if has.sum() < max(3, 0.5 * count):
        raise CaptureError(f"{place}: {len(events)} events for {count} images, and no clock offset makes them agree")
    found[order[has]] = events[partners[has]]
    return found, f"times of {place}, by intervals: {int(has.sum())} of {count} images have one"


def _aligned(events: Ints, stamps: Ints, slack_s: float) -> tuple[float, Ints]:
    """The clock offset [s] under which most stamps have an event of their own, and the event of each, -1 where none."""
    zero = events[0]
    event_s, stamp_s = (events - zero) * 1e-9, (stamps - zero) * 1e-9
    best: tuple[int, float, float] = (-1, 0.0, 0.0)
    for anchor in (0, len(stamp_s) // 2, len(stamp_s) - 1):
        for event in event_s:
            offset = float(event - stamp_s[anchor])
            _, gap = _nearest(event_s, stamp_s + offset)
            inside = gap < slack_s
            score = (int(inside.sum()), -float(gap[inside].sum()) if inside.any() else 0.0, offset)
            best = max(best, score)
    offset = best[2]
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
