"""Two sets of coordinates of the same points, by id, in one table."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.text import open_text, table_of

Array = npt.NDArray[np.float64]

_FARTHEST_M: Final = 1e8


@dataclass(frozen=True, slots=True)
class Pairs:
    """Coordinates of points in two sets.

    Attributes
    ----------
    ids : tuple of str
    first_m, second_m : ndarray, shape (n, 3)
        x, y, z of the reference and of what is judged.
    """

    ids: tuple[str, ...]
    first_m: Array
    second_m: Array


def read_pairs(path: Path) -> Pairs:
    """Read a table: id, then x, y, z of the reference, then x, y, z of what is judged; the first line names the columns.

    Raises
    ------
    CaptureError
        It cannot be read, or a line is not so.
    """
    ids: list[str] = []
    values = []
    expected = "expected a line of 7 names (id, x, y, z, x, y, z) and a line for each point below it"
    try:
        with open_text(path) as file:
            table = table_of(file, str(path), 7, CaptureError, expected)
            for number, row in table.rows():
                ids.append(row[0].strip())
                values.append(_numbers(row[1:]))
                if not (np.abs(values[-1]) <= _FARTHEST_M).all():
                    raise CaptureError(f"{path}: line {number}: {table.blame(row, 'an id and six numbers')}")
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not ids:
        raise CaptureError(f"{path}: holds no points, {expected}")
    doubled = next((name for name, count in Counter(ids).items() if count > 1), None)
    if doubled is not None:
        raise CaptureError(f"{path}: point {doubled!r} stands there twice, expected each once")
    both = np.array(values)
    return Pairs(tuple(ids), both[:, :3], both[:, 3:])


def _numbers(words: list[str]) -> Array:
    """Words as numbers, not a number where one is none."""
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        return np.full(len(words), np.nan)
