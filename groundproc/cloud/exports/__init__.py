"""Formats that a cloud can be written in: one file here for each, and one line in `FORMATS`.

Each has `write(cloud, path, progress)`, which writes in place (the caller writes aside) and is told of points done.
"""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Final

from flightlog.errors import UsageError
from groundproc.cloud.reader import Cloud

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
