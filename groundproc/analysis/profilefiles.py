"""Profiles as a table and as a drawing."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import SourceError
from groundproc.analysis.profile import Profile
from groundproc.vectors.dxf import Label, Line, write_dxf

Array = npt.NDArray[np.float64]

HEADER: Final = (
    "line", "source", "along_m", "easting", "northing", "height_m", "lowest_m", "highest_m", "sigma_m", "points",
)  # fmt: skip
_TEXT: Final = 0.012
"""Size of the text, as a share of the longer side of a drawing."""
_STEPS: Final = 8
"""Lines of the grid, about, each way."""


def write_csv(path: Path, profiles: Sequence[Profile]) -> None:
    """Write a row a station, in place (the caller writes aside); what is not known is left empty.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(HEADER)
            for each in profiles:
                line = each.line
                rest = (each.lowest_m, each.highest_m, each.sigma_m) if len(each.count) else ()
                columns = [
                    _texts(values, 4)
                    for values in (line.along_m, *(line.stations_m / line.unit.across).T, each.height_m, *rest)
                ]
                columns += [[""] * len(line.along_m)] * (7 - len(columns))
                counts = [str(n) for n in each.count.tolist()] or [""] * len(line.along_m)
                table.writerows(
                    zip([line.name] * len(counts), [each.source] * len(counts), *columns, counts, strict=True)
                )
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None


def _texts(values: Array, digits: int) -> list[str]:
    return [f"{value:.{digits}f}" if math.isfinite(value) else "" for value in values.tolist()]


def write_drawing(path: Path, profiles: Sequence[Profile], exaggeration: float) -> None:
    """Write a drawing, in place (the caller writes aside): way to the right, height upwards, one line below the other.

    Layers are PROFILE_1, PROFILE_2 and so on, one a source, PROFILE_GRID and PROFILE_TEXT.

    Parameters
    ----------
    path : Path
    profiles : sequence of Profile
    exaggeration : float
        Of heights.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    lines: list[Line] = []
    labels: list[Label] = []
    sources = list(dict.fromkeys(each.source for each in profiles))
    top = 0.0
    for name in dict.fromkeys(each.line.name for each in profiles):
        some = [each for each in profiles if each.line.name == name]
        heights = np.concatenate([each.height_m for each in some])
        heights = heights[np.isfinite(heights)]
        if not len(heights):
            continue
        length = float(some[0].line.along_m[-1])
        step = nice(float(np.ptp(heights)) / _STEPS)
        datum, ceiling = math.floor(heights.min() / step) * step, math.ceil(heights.max() / step) * step
        size = _TEXT * max(length, (ceiling - datum) * exaggeration)
        base = top - (ceiling - datum) * exaggeration - 6.0 * size
        _grid(lines, labels, (length, datum, ceiling, step), base, exaggeration, size)
        labels.append(
            _label(f"{name}: {', '.join(each.source for each in some)}", (0.5 * length, top - 1.5 * size), size)
        )
        for each in some:
            for part in _stretches(each.height_m):
                places = np.column_stack([each.line.along_m[part], base + (each.height_m[part] - datum) * exaggeration])
                lines.append(Line(places, f"PROFILE_{sources.index(each.source) + 1}"))
        top = base - 6.0 * size
    write_dxf(path, lines, labels)


def _grid(
    lines: list[Line],
    labels: list[Label],
    extent: tuple[float, float, float, float],
    base: float,
    scale: float,
    size: float,
) -> None:
    """Heights and ways at whole steps, with numbers."""
    length, datum, ceiling, step = extent
    for n in range(round((ceiling - datum) / step) + 1):
        y = base + n * step * scale
        lines.append(Line(np.array([[0.0, y], [length, y]]), "PROFILE_GRID"))
        labels.append(_label(f"{datum + n * step:g}", (-3.0 * size, y), size))
    across = nice(length / _STEPS)
    for n in range(int(length / across + 1e-9) + 1):
        x = n * across
        lines.append(Line(np.array([[x, base], [x, base + (ceiling - datum) * scale]]), "PROFILE_GRID"))
        labels.append(_label(f"{x:g}", (x, base - 2.0 * size), size))


def _label(text: str, place: tuple[float, float], size: float) -> Label:
    return Label(text, np.array([*place, 0.0]), 0.0, size, "PROFILE_TEXT")


def _stretches(heights: Array) -> list[npt.NDArray[np.int64]]:
    """Rows of what is known without a gap, two and more."""
    known = np.flatnonzero(np.isfinite(heights))
    parts = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    return [part for part in parts if len(part) > 1]


def nice(value: float) -> float:
    """The next larger of 1, 2 and 5 times a power of ten."""
    if not value > 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= value * (1.0 - 1e-9))
