"""Formats that a cloud can be written in: one file here for each, and one line in `FORMATS`.

Each has `write(cloud, path, progress)`, which writes in place (the caller writes aside) and is told of points done.
"""

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import UsageError
from groundproc.cloud.reader import Chunk, Cloud, chunks, opened

Progress = Callable[[int], object]

FORMATS: Final = {".copc.laz": "copc", ".laz": "laz", ".las": "las", ".ply": "ply", ".e57": "e57", ".csv": "csv"}
"""Endings of names and their modules; longer endings come first."""


def write(cloud: Cloud, path: Path, aside: Path, progress: Progress) -> None:
    """Write a cloud in the format that the name of `path` asks for, to `aside`.

    Raises
    ------
    UsageError
        No format has such a name.
    """
    module = importlib.import_module(f"{__name__}.{format_of(path)}")
    module.write(cloud, aside, progress)


def format_of(path: Path) -> str:
    """The module of a name.

    Raises
    ------
    UsageError
        No format has such a name.
    """
    for ending, module in FORMATS.items():
        if path.name.lower().endswith(ending):
            return module
    raise UsageError(f"-o {path}: expected a name that ends in {', '.join(FORMATS)}")


COLOURS: Final = ("red", "green", "blue")
_BYTE: Final = 255


def colour_bits(cloud: Cloud) -> int:
    """How far colours are shifted to fit into one byte.

    LAS means them to fill two, and many programs put the one byte of a photograph there as it is: all of their colours are 255 at most.
    """
    if "red" not in cloud.columns:
        return 0
    for chunk in chunks(cloud, columns=COLOURS):
        if any(int(chunk.points[name].max(initial=0)) > _BYTE for name in COLOURS):
            return 8
    return 0


class Theirs:
    """Extra bytes of a cloud that the table of dimensions does not know, as columns of numbers.

    Parameters
    ----------
    cloud : Cloud
    taken : sequence of str
        Names of columns that there are already.
    """

    def __init__(self, cloud: Cloud, taken: Sequence[str]) -> None:
        with opened(cloud.path) as reader:
            found = [each for each in reader.header.point_format.extra_dimensions if each.name not in cloud.columns]
        self.names: list[str] = []
        self.scales: list[float | None] = []
        self.types: list[np.dtype[Any]] = []
        self._parts: list[tuple[str, int | None]] = []
        for each in found:
            parts = [None] if each.num_elements == 1 else range(each.num_elements)
            for part in parts:
                name = _one_word(each.name if part is None else f"{each.name}_{part}")
                self.names.append(_apart(name, [*taken, *self.names]))
                self._parts.append((each.name, part))
                scale = None if each.scales is None else float(each.scales[part or 0])
                self.scales.append(scale)
                self.types.append(np.dtype(np.float64) if scale is not None else each.dtype.base)

    def values(self, chunk: Chunk) -> list[npt.NDArray[Any]]:
        """Of each column, shape (n,)."""
        return [
            np.asarray(chunk.record[name]) if part is None else np.asarray(chunk.record[name])[:, part]
            for name, part in self._parts
        ]


def _one_word(name: str) -> str:
    """A name that neither spaces nor commas end."""
    return "".join(letter if letter.isprintable() and letter not in " ,;\"'" else "_" for letter in name) or "_"


def _apart(name: str, taken: Sequence[str]) -> str:
    """A name that is not there yet."""
    number, found = 2, name
    while found in taken:
        found, number = f"{name}_{number}", number + 1
    return found
