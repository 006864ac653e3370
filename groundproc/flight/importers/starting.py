"""When recordings begin: those of computers without a clock take their date from the devices in them, or from each other."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from flightlog import clock
from flightlog.constants import NS_PER_S
from groundproc.flight.importers.devices import stated_utc_ns
from groundproc.flight.importers.joining import Event
from groundproc.flight.importers.steady import Steady

_HEAD: Final = 256
_SAME_COMPUTER_NS: Final = 5 * NS_PER_S
"""GPS sentences and SYSTEM_TIME lag by less than this on the way."""
_DAY_NS: Final = 86_400 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Start:
    """What the beginning of a recording says of its computer's clock.

    Attributes
    ----------
    moved_ns : int
        What to add to all times for the first stamps that can be a date to be right.
    known : bool
        Whether any stamps can.
    first_ns : int
        Time of the first event, `moved_ns` added.
    stated_ns : int or None
        Where no stamp can be a date: what a device's own statement of UTC asks to be added; None where there is none.
    """

    moved_ns: int
    known: bool
    first_ns: int
    stated_ns: int | None


def start_of(again: Callable[[], Iterable[Event]]) -> Start | None:
    """Look at the beginning of a recording; at all of it where its stamps are no dates. None where it holds nothing.

    Parameters
    ----------
    again : callable
        Gives the events, from the first on.
    """
    trial, first_ns, stated_ns = Steady(), None, None
    for number, placed in enumerate(trial.judged(again())):
        if first_ns is None:
            first_ns = placed.event.time_ns
        if stated_ns is None and (utc_ns := stated_utc_ns(placed.event)) is not None:
            stated_ns = utc_ns - placed.event.time_ns
        if number >= _HEAD and trial.dated_ns() is not None:
            break
    if first_ns is None:
        return None
    offset_ns = trial.dated_ns()
    if offset_ns is None:
        return Start(0, False, first_ns, stated_ns)
    return Start(-offset_ns, True, first_ns - offset_ns, None)


def moves(starts: Sequence[Start | None]) -> list[int]:
    """What to add to the times of recordings of one flight [ns].

    A recording without a date takes that of another whose stamps begin within a day of its own, unless a device in it states one that
    differs by seconds: they are of one computer, whose clock ties them. Else that which a device states in it; else it begins where the
    first of those with a date does. Without any date stamps stay what they are, but within the range of a log.

    Parameters
    ----------
    starts : sequence of Start or None
    """
    known = [start.first_ns for start in starts if start is not None and start.known]
    stated = [start for start in starts if start is not None and not start.known and start.stated_ns is not None]
    return [0 if start is None else start.moved_ns if start.known else _move(start, known, stated) for start in starts]


def _move(start: Start, known: list[int], stated: list[Start]) -> int:
    own_ns = start.stated_ns
    for other in stated:
        if other.stated_ns is None or abs(other.first_ns - start.first_ns) >= _DAY_NS:
            continue
        if own_ns is None or abs(other.stated_ns - own_ns) < _SAME_COMPUTER_NS:
            return other.stated_ns
    if own_ns is not None:
        return own_ns
    if known:
        return min(known) - start.first_ns
    return 0 if 0 <= start.first_ns < clock.PLAUSIBLE_UTC_NS[0] else -(start.first_ns // _DAY_NS) * _DAY_NS
