"""Packets of one lidar in the order in which they were sent, each once.

Networks and captures swap packets, and give them twice: a bridge that mirrors a port, two captures that overlap. The lidar's own stamps
tell.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_MS, NS_PER_US
from flightlog.hdl32e import STAMP_WRAP_US

NEAR_US: Final = 100 * NS_PER_MS // NS_PER_US
"""Stamps of neighbours further apart than this are a clock that was set, or a gap: what lies behind is not sorted with what lies before."""


class Sequence(NamedTuple):
    """What became of a batch.

    Attributes
    ----------
    kept : ndarray of intp, shape (k,)
        Packets in the order of their stamps.
    duplicates : int
        Packets left out, because another with the same stamp and the same bytes was kept.
    moved : int
        Packets kept that came behind later ones.
    """

    kept: npt.NDArray[np.intp]
    duplicates: int
    moved: int


def after_us(stamps_us: npt.NDArray[np.integer], reference_us: npt.NDArray[np.integer] | int) -> npt.NDArray[np.int64]:
    """How much later stamps past the hour are than others [us], within half an hour either way."""
    half = STAMP_WRAP_US // 2
    return np.asarray((stamps_us.astype(np.int64) - reference_us + half) % STAMP_WRAP_US - half)


def sequenced(
    stamps_us: npt.NDArray[np.uint32], packets: npt.NDArray[np.uint8], places: npt.NDArray[np.intp] | None = None
) -> Sequence:
    """Sort packets by their stamps and find those that are there twice.

    Parameters
    ----------
    stamps_us : ndarray of uint32, shape (n,)
        Past the hour [us].
    packets : ndarray of uint8, shape (m, bytes)
        Compared byte by byte where stamps are the same.
    places : ndarray of intp, shape (n,), optional
        Which of `packets` the stamps belong to. Default: all of them.
    """
    every = np.arange(len(stamps_us), dtype=np.intp)
    if len(stamps_us) < 2:
        return Sequence(every, 0, 0)
    steps = after_us(stamps_us[1:], stamps_us[:-1].astype(np.int64))
    if (steps > 0).all():
        return Sequence(every, 0, 0)
    stretch = np.concatenate([[0], np.cumsum(np.abs(steps) > NEAR_US)])
    passed_us = np.concatenate([[0], np.cumsum(steps)])
    order = np.lexsort((passed_us, stretch))
    same = (np.diff(passed_us[order]) == 0) & (np.diff(stretch[order]) == 0)
    places = every if places is None else places
    twice = _twice(packets, places[order], same) if same.any() else np.zeros(len(order), np.bool_)
    kept = order[~twice]
    as_came = np.sort(kept)
    late = _late(passed_us[as_came], stretch[as_came])
    return Sequence(kept, int(twice.sum()), int(late.sum()))


def _twice(
    packets: npt.NDArray[np.uint8], order: npt.NDArray[np.intp], same: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Which of sorted packets repeat one before; `same`: which have the stamp of the one before them, shape (n - 1,)."""
    twice = np.zeros(len(order), np.bool_)
    seen: set[bytes] = set()
    for i in np.flatnonzero(same) + 1:
        if i < 2 or not same[i - 2]:
            seen = {packets[order[i - 1]].tobytes()}
        content = packets[order[i]].tobytes()
        twice[i] = content in seen
        seen.add(content)
    return twice


def _late(passed_us: npt.NDArray[np.int64], stretch: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Which packets came behind a later one of their stretch."""
    late = np.zeros(len(passed_us), np.bool_)
    for number in np.unique(stretch):
        mine = stretch == number
        late[mine] = passed_us[mine] < np.maximum.accumulate(passed_us[mine])
    return late
