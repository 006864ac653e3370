"""A landing is a disarming that lasts: nobody who flips between armed and disarmed fills the folder with segments."""

import itertools

from onboard.landing import Landing

S = 1_000_000_000


def landings(states: list[bool | None]) -> list[int]:
    landing = Landing()
    return [second for second, state in enumerate(states) if landing.look(state, second * S)]


def test_a_flight_lands_once_five_seconds_after_disarming() -> None:
    assert landings([False] * 10 + [True] * 60 + [False] * 100) == [75]


def test_flipping_each_second_is_no_landing() -> None:
    assert landings([True, False] * 30) == []


def test_flipping_slowly_makes_a_segment_each_half_minute_at_most() -> None:
    found = landings(([True] + [False] * 6) * 40)
    assert min(b - a for a, b in itertools.pairwise(found)) >= 30
    assert len(found) <= 280 // 30 + 1


def test_silence_neither_lands_nor_forgets_the_flight() -> None:
    assert landings([True, None, None, None, False, None] + [False] * 6) == [11]
