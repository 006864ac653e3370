"""Names that a command is to write: of the right kind, and not of what is there already, unless the user says --force.

Folders above a name that are missing are made, by every command, when it writes (`groundproc.files`).
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

_OCTREE: Final = ".copc.laz"


def add_force(parser: argparse.ArgumentParser) -> None:
    """Declare the one option by which what is there is written over."""
    parser.add_argument("--force", action="store_true", help="overwrite existing files")


def claim_file(path: Path, suffixes: Sequence[str], force: bool, inputs: Iterable[Path] = ()) -> None:
    """See that a file may be written.

    Parameters
    ----------
    path : Path
    suffixes : sequence of str
        Of which its name must have one, such as ".laz": other programs go by it.
    force : bool
        Write over what is there.
    inputs : iterable of Path
        What is read; never written over.

    Raises
    ------
    UsageError
    """
    from flightlog.errors import UsageError

    if path.is_dir():
        raise UsageError(
            f"{path}: is a folder, expected the name of a file to write, such as {path / f'NAME{suffixes[0]}'}"
        )
    if any(path.resolve() == other.resolve() for other in inputs):
        raise UsageError(f"{path}: is an input and cannot be the output too")
    if path.suffix.lower() not in suffixes:
        raise UsageError(
            f"{path}: ends in {path.suffix or 'nothing'}, expected a name that ends in {' or '.join(suffixes)}, such as "
            f"{path.with_suffix(suffixes[0]) if path.name else f'NAME{suffixes[0]}'}"
        )
    if path.name.lower().endswith(_OCTREE) and _OCTREE not in suffixes:
        plain = path.with_name(path.name[: -len(_OCTREE)] + ".laz")
        raise UsageError(
            f"{path}: ends in {_OCTREE}, but this command writes no octree; expected {plain.name}: `swath export` makes a COPC of it"
        )
    _refuse(path, force)


def claim_folder(folder: Path, names: Iterable[str], force: bool) -> None:
    """See that some files may be written into a folder; it need not be there.

    Raises
    ------
    UsageError
    """
    from flightlog.errors import UsageError

    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is a file, expected a folder to write into")
    for name in names:
        _refuse(folder / name, force)


def _refuse(path: Path, force: bool) -> None:
    from flightlog.errors import UsageError

    if path.exists() and not force:
        raise UsageError(f"{path}: exists already; give another name, or --force to write over it")


def write_json(path: Path, told: Mapping[str, Any]) -> None:
    """Write figures, aside and then renamed.

    Raises
    ------
    SourceError
    """
    import json

    from groundproc.files import written_aside

    with written_aside(path) as aside:
        aside.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
