"""Formats that a trajectory can be written in: one file here for each, and one line in `FORMATS`.

Each has `write(source, path, name)`, which writes to `path` in place (the caller writes aside) what will be called `name`, and
`beside(name)`: the second file that goes with it, if any, and what writes that. docs/estimate.md describes the conventions.
"""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Final

from groundproc.trajectory.exports.source import Source

Writer = Callable[[Source, Path], None]

FORMATS: Final = {".tum": "tum", ".kitti": "kitti", ".sbet": "sbet", ".out": "sbet", ".pos": "pos", ".csv": "table"}
"""Suffixes of names and their modules."""


def writers(name: Path) -> dict[Path, Writer]:
    """The files that make up a trajectory of a name whose suffix is one of `FORMATS`, and what writes each."""
    module = importlib.import_module(f"{__name__}.{FORMATS[name.suffix.lower()]}")
    found: dict[Path, Writer] = module.writers(name)
    return found
