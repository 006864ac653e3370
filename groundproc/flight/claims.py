"""Absolute times compared with each other: each is a claim, and some of the ways in which one is wrong can be recognised.

A receiver with old firmware states dates that are whole eras of 1024 GPS weeks early. One that has not heard of the
leap seconds yet, or does not apply them, is whole seconds off. A recording computer without a clock begins in 1970.
Device clocks are not claims: they say how much time passed, and tie the claims to one instant.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from flightlog import clock
from flightlog.clock import utc_text
from flightlog.constants import NS_PER_S
from groundproc.flight.positions.scales import EPOCH_NS, ERA_NS

GPRMC, SYSTEM_TIME, GPS_RAW, HOST = "gprmc", "system_time", "gps_raw", "host"
NAMES: Final = {
    GPRMC: "the lidar's GPS (GPRMC)", SYSTEM_TIME: "the autopilot's SYSTEM_TIME", GPS_RAW: "the autopilot's GPS_RAW_INT",
    HOST: "the recording computer",
}  # fmt: skip
FIRST_NS: Final = 1_262_304_000 * NS_PER_S
"""2010-01-01: no HDL-32E was sold and no MAVLink spoken before, so that a receiver's earlier date is of another era."""
_DAY_NS: Final = 86_400 * NS_PER_S
_NEAR_NS: Final = 7 * 86_400 * NS_PER_S
"""Claims of one era lie together within this."""
_EXACT_NS: Final = 400_000_000
"""Claims of one second: SYSTEM_TIME is that of the last fix, at 5 Hz, some 0.1 s old when it is sent."""
_MOST_LEAPS: Final = 18
"""All there are; a receiver that applies none is so many seconds ahead."""
_WITNESS_NS: Final = 500_000_000
"""A computer's clock that is so near to one of two claims, and not to the other, bears it out (NTP holds to milliseconds)."""


@dataclass(frozen=True, slots=True)
class Settled:
    """What claims are worth.

    Attributes
    ----------
    add_ns : mapping of str to int
        What makes a claim right, for each that can be.
    mended : tuple of str
        Sentences on what was recognised and mended.
    doubts : tuple of str
        Sentences on contradictions that nothing explains.
    """

    add_ns: Mapping[str, int] = field(default_factory=dict)
    mended: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def can_be(utc_ns: int) -> bool:
    """Whether a receiver's date can be one, of whichever era: not the first day of an era, which is what it says that knows none."""
    since_ns = utc_ns - EPOCH_NS
    return since_ns >= 0 and utc_ns < clock.PLAUSIBLE_UTC_NS[1] and since_ns % ERA_NS >= _DAY_NS


def settled(claims: Mapping[str, int], *, exact: bool = True) -> Settled:
    """Hold claims against each other.

    Parameters
    ----------
    claims : mapping of str to int
        What each source says that UTC was at one and the same instant [ns]; keys of `NAMES`.
    exact : bool
        GPRMC is known to better than half a second: whole leap seconds can be told.
    """
    add: dict[str, int] = {}
    mended: list[str] = []
    doubts: list[str] = []
    for name, utc_ns in claims.items():
        if clock.is_plausible(utc_ns) if name == HOST else can_be(utc_ns):
            add[name] = 0
        elif name != HOST:
            doubts.append(f"{NAMES[name]} states {utc_text(utc_ns)}, which cannot be; not used")
    _eras(claims, add, mended)
    if exact:
        _leaps(claims, add, mended)
    doubts += _contradictions({name: claims[name] + added for name, added in add.items()})
    return Settled(add, tuple(mended), tuple(doubts))


def _eras(claims: Mapping[str, int], add: dict[str, int], mended: list[str]) -> None:
    """Add the eras of 1024 weeks that a receiver is behind: it falls behind, never ahead, so that the latest claim is right."""
    able = [claims[name] for name in add if claims[name] >= FIRST_NS]
    for name in add:
        utc_ns = claims[name]
        if name == HOST:
            continue
        behind = [round((other - utc_ns) / ERA_NS) for other in able if _is_near((other - utc_ns) % ERA_NS)]
        eras = max(behind, default=0)
        if not eras and utc_ns < FIRST_NS:
            eras = -(-(FIRST_NS - utc_ns) // ERA_NS)
        if eras > 0 and clock.is_plausible(utc_ns + eras * ERA_NS):
            add[name] = eras * ERA_NS
            mended.append(
                f"{NAMES[name]} was {eras * 1024} weeks behind (rollover of the GPS week): {utc_text(utc_ns)} taken for "
                f"{utc_text(utc_ns + add[name])}"
            )


def _is_near(beyond_ns: int) -> bool:
    return min(beyond_ns, ERA_NS - beyond_ns) < _NEAR_NS


def _leaps(claims: Mapping[str, int], add: dict[str, int], mended: list[str]) -> None:
    """Take whole leap seconds off the one of two receivers that is ahead: it has not heard of them, or does not apply them."""
    pilot = next((name for name in (SYSTEM_TIME, GPS_RAW) if name in add), None)
    if GPRMC not in add or pilot is None:
        return
    utc_ns = {name: claims[name] + add[name] for name in add}
    ahead_ns = utc_ns[pilot] - utc_ns[GPRMC]
    leaps = round(ahead_ns / NS_PER_S)
    if not 1 <= abs(leaps) <= _MOST_LEAPS or abs(ahead_ns - leaps * NS_PER_S) > _EXACT_NS:
        return
    early, late = (GPRMC, pilot) if leaps > 0 else (pilot, GPRMC)
    wrong, by_ns = late, -abs(leaps) * NS_PER_S
    if HOST in utc_ns and abs(utc_ns[HOST] - utc_ns[late]) < _WITNESS_NS:
        wrong, by_ns = early, -by_ns
    add[wrong] += by_ns
    mended.append(
        f"{NAMES[wrong]} was {abs(leaps)} whole seconds {'ahead of' if by_ns < 0 else 'behind'} "
        f"{NAMES[late if wrong == early else early]}, as with wrong leap seconds; mended"
    )


def _contradictions(utc_ns: Mapping[str, int]) -> list[str]:
    """Receivers that differ by more than their messages are late; a computer's clock may be anything."""
    found = []
    for one, other in itertools.combinations([name for name in utc_ns if name != HOST], 2):
        apart_ns = utc_ns[other] - utc_ns[one]
        if abs(apart_ns) > 2 * NS_PER_S:
            found.append(f"{NAMES[one]} and {NAMES[other]} contradict each other by {apart_ns / NS_PER_S:.1f} s")
    return found
