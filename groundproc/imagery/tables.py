"""Tables of measured image points and of control points, and the table of adjusted points."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.files import written_aside
from groundproc.imagery.poses import quoted
from groundproc.text import Table, open_text, table_of

Array = npt.NDArray[np.float64]

SIGMA_PX: Final = 1.0
"""Of an image point whose table states none."""
MARK_COLUMNS: Final = ("image", "point", "x_px", "y_px")
CONTROL_COLUMNS: Final = ("name", "x", "y", "z", "sigma")
_USES: Final = {"": False, "control": False, "check": True}
_FARTHEST: Final = 1e8


@dataclass(frozen=True, slots=True)
class Marks:
    """Image points measured by others.

    Attributes
    ----------
    image, point : tuple of str
        Names.
    pixel : ndarray, shape (n, 2)
    sigma_px : ndarray, shape (n,)
    """

    image: tuple[str, ...]
    point: tuple[str, ...]
    pixel: Array
    sigma_px: Array


@dataclass(frozen=True, slots=True)
class Control:
    """Surveyed points.

    Attributes
    ----------
    name : tuple of str
    place_m : ndarray, shape (n, 3)
        Easting, northing, height.
    sigma_m : ndarray, shape (n, 3)
    check : ndarray of bool, shape (n,)
        Only compared.
    """

    name: tuple[str, ...]
    place_m: Array
    sigma_m: Array
    check: npt.NDArray[np.bool_]


def read_marks(path: Path) -> Marks:
    """Read image,point,x_px,y_px[,sigma].

    Raises
    ------
    CaptureError
        It cannot be read, a column is missing, or a line is not what the columns say.
    """
    images: list[str] = []
    points: list[str] = []
    values: list[list[float]] = []
    seen: set[tuple[str, str]] = set()
    try:
        with open_text(path) as file:
            table = _table(file, path, "x_px", MARK_COLUMNS, "image points")
            place = {name: table.names.index(name) for name in table.names}
            for number, words in table.rows(short=True):
                row = _floats(words, [place["x_px"], place["y_px"]], place.get("sigma"), SIGMA_PX)
                if row is None or not words[place["image"]] or not words[place["point"]] or row[2] <= 0.0:
                    expected = "a name of an image, a name of a point, x_px, y_px and a sigma above 0"
                    raise CaptureError(f"{path}: line {number}: {table.blame(words, expected)}")
                key = words[place["image"]], words[place["point"]]
                if key in seen:
                    raise CaptureError(f"{path}: line {number}: point {key[1]} is measured twice in image {key[0]}")
                seen.add(key)
                images.append(key[0])
                points.append(key[1])
                values.append(row)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not images:
        raise CaptureError(f"{path}: holds no image points")
    array = np.array(values)
    return Marks(tuple(images), tuple(points), array[:, :2], array[:, 2])


def read_control(path: Path) -> Control:
    """Read name,x,y,z,sigma[,sigma_z],use.

    Raises
    ------
    CaptureError
        It cannot be read, a column is missing, or a line is not what the columns say.
    """
    names: list[str] = []
    values: list[list[float]] = []
    check: list[bool] = []
    try:
        with open_text(path) as file:
            table = _table(file, path, "sigma", CONTROL_COLUMNS, "control points")
            place = {name: table.names.index(name) for name in table.names}
            for number, words in table.rows(short=True):
                row = _floats(words, [place[name] for name in CONTROL_COLUMNS[1:]], place.get("sigma_z"), np.nan)
                at = place.get("use", len(words))
                use = words[at].strip().lower() if at < len(words) else ""
                if row is None or not words[place["name"]] or use not in _USES or not _sound(row):
                    expected = "a name, x, y, z, a sigma above 0, and control or check as its use"
                    raise CaptureError(f"{path}: line {number}: {table.blame(words, expected)}")
                if words[place["name"]] in names:
                    raise CaptureError(f"{path}: line {number}: point {words[place['name']]} stands there twice")
                names.append(words[place["name"]])
                values.append([*row[:4], row[3], row[3] if np.isnan(row[4]) else row[4]])
                check.append(_USES[use])
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not names:
        raise CaptureError(f"{path}: holds no points")
    array = np.array(values)
    return Control(tuple(names), array[:, :3], array[:, 3:], np.array(check))


def _sound(row: Sequence[float]) -> bool:
    """Whether coordinates and sigmas can be."""
    sigmas = row[3:4] if np.isnan(row[4]) else row[3:]
    return all(abs(value) <= _FARTHEST for value in row[:3]) and all(0.0 < sigma <= _FARTHEST for sigma in sigmas)


def _table(file: object, path: Path, wanted: str, columns: Sequence[str], what: str) -> Table:
    expected = f"{what} have {', '.join(columns)}"
    table = table_of(file, str(path), wanted, CaptureError, expected)  # type: ignore[arg-type]
    missing = [name for name in columns if name not in table.names]
    if missing:
        raise CaptureError(f"{path}: column {missing[0]} is missing; {expected}")
    return table


def _floats(words: Sequence[str], places: Sequence[int], optional: int | None, default: float) -> list[float] | None:
    """Finite numbers of some columns and one that may be left out; None where one is no number."""
    try:
        row = [float(words[place]) for place in places]
        last = words[optional].strip() if optional is not None and optional < len(words) else ""
        extra = float(last) if last else default
    except (ValueError, IndexError):
        return None
    return [*row, extra] if np.isfinite(row).all() and (not last or np.isfinite(extra)) else None


def write_points(
    path: Path, names: Sequence[str], place_m: Array, sigma_m: Array, images: npt.NDArray[np.int64]
) -> None:
    """Write points.csv: id,x,y,z,sx,sy,sz,images.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    with written_aside(path) as aside, aside.open("w", encoding="utf-8", newline="\n") as file:
        file.write("id,x,y,z,sx,sy,sz,images\n")
        rows = np.concatenate([place_m, sigma_m], axis=1)
        for name, row, count in zip(names, rows.tolist(), images.tolist(), strict=True):
            values = ",".join([*(f"{value:.5f}" for value in row[:3]), *(f"{value:.5g}" for value in row[3:])])
            file.write(f"{quoted(str(name))},{values},{count}\n")
