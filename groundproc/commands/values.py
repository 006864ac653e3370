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


def classes(text: str, word: str) -> tuple[int, ...]:
    """Classes of points between commas, such as "2,9".

    Raises
    ------
    UsageError
    """
    found = tuple(int(each) if each.strip().isdecimal() else -1 for each in text.split(","))
    if not all(0 <= each <= 255 for each in found):
        raise UsageError(f"{word} {text!r}: expected classes of 0 to 255 between commas, such as 2,9")
    return found


def numbers(text: str, word: str, count: int | None, example: str) -> tuple[float, ...]:
    """Numbers between commas, such as a place "533000,6472000"; so many, or any number of them.

    Raises
    ------
    UsageError
    """
    try:
        found = tuple(float(each) for each in text.split(","))
    except ValueError:
        found = ()
    if (not found if count is None else len(found) != count) or not all(map(math.isfinite, found)):
        expected = "numbers" if count is None else f"{count} numbers"
        raise UsageError(f"{word} {text!r}: expected {expected} between commas, {example}")
    return found
