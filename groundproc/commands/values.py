"""Values on the command line that are more than a word or a number."""

import math

from flightlog.errors import UsageError


def field_of_view(text: str, word: str = "--fov-deg") -> tuple[float, float]:
    """Azimuths such as "255-105" or "-105:105", clockwise from first to second, or "all"; degrees."""
    if text == "all":
        return 0.0, 360.0
    words = text.split(":") if ":" in text else text.rsplit("-", 1)
    try:
        start, end = (float(word) for word in words)
    except ValueError:
        start = end = math.nan
    if not (-360.0 <= start <= 360.0 and -360.0 <= end <= 360.0):
        raise UsageError(f"{word} {text!r}: expected two azimuths such as 255-105 or -105:105, in degrees, or all")
    return start, end


def milliseconds(text: str, word: str = "--pose-grid-ms") -> float:
    """A duration such as "10ms", or a plain number of milliseconds."""
    try:
        value = float(text.removesuffix("ms"))
    except ValueError:
        value = math.nan
    if not 1.0 <= value <= 1000.0:
        raise UsageError(f"{word} {text!r}: expected a duration of 1ms to 1000ms")
    return value


def count(text: str, word: str) -> int:
    """A whole number of 1 and more."""
    if not (text.isdecimal() and 1 <= int(text) <= 10_000):
        raise UsageError(f"{word} {text!r}: expected a whole number of 1 to 10000")
    return int(text)


def numbers(text: str, word: str, count: int, example: str) -> tuple[float, ...]:
    """Numbers between commas, such as a place "533000,6472000".

    Raises
    ------
    UsageError
    """
    try:
        found = tuple(float(each) for each in text.split(","))
    except ValueError:
        found = ()
    if len(found) != count or not all(map(math.isfinite, found)):
        raise UsageError(f"{word} {text!r}: expected {count} numbers between commas, {example}")
    return found
