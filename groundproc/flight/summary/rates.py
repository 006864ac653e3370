"""Rates that mean something."""

from typing import Final

from flightlog.constants import NS_PER_S

_FEWEST: Final = 3
_SHORTEST_NS: Final = NS_PER_S // 4
"""Packets of one batch lie closer together than their rate says; two batches and a half do not."""


def rate_hz(count: int, span_ns: int) -> float | None:
    """So many things a second, of the first to the last of them [Hz]; None for too few, or too close together to tell."""
    if count < _FEWEST or span_ns < _SHORTEST_NS:
        return None
    return (count - 1) / (span_ns / NS_PER_S)


def rounded(rate: float | None, digits: int) -> float | None:
    """A rate to so many digits behind the point."""
    return None if rate is None else round(rate, digits)
