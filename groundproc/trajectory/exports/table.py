"""trajectory.csv, of a trajectory that came in another format."""

from functools import partial
from pathlib import Path

from groundproc.trajectory.exports.source import Source
from groundproc.trajectory.table import write_trajectory


def writers(name: Path) -> dict[Path, partial[None]]:
    """The one file."""
    return {name: partial(_write)}


def _write(source: Source, path: Path) -> None:
    write_trajectory(path, source.trajectory)
