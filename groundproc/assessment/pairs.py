"""Two sets of coordinates of the same points, by id, in one table."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError

Array = npt.NDArray[np.float64]


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
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if any(word.strip() for word in row)]
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, csv.Error):
        raise CaptureError(f"{path}: is no table of text") from None
    if len(rows) < 2 or len(rows[0]) != 7:
        raise CaptureError(
            f"{path}: expected a line of 7 names (id, x, y, z, x, y, z) and a line for each point below it"
        )
    ids, values = [], []
    for number, row in enumerate(rows[1:], 2):
        try:
            numbers = [float(word) for word in row[1:]]
        except ValueError:
            numbers = []
        if len(numbers) != 6 or not np.isfinite(numbers).all():
            raise CaptureError(f"{path}: row {number}: {','.join(row)!r} found, expected an id and six numbers")
        ids.append(row[0].strip())
        values.append(numbers)
    doubled = next((name for name in ids if ids.count(name) > 1), None)
    if doubled is not None:
        raise CaptureError(f"{path}: point {doubled!r} stands there twice, expected each once")
    both = np.array(values)
    return Pairs(tuple(ids), both[:, :3], both[:, 3:])
