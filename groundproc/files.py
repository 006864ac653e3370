"""Products appear whole or not at all: written under another name beside, then renamed."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from flightlog.errors import SourceError


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Give a name beside `path` to write to; on leaving it becomes `path`, on an error it is removed.

    Raises
    ------
    SourceError
        The place cannot be written to.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield aside
        aside.replace(path)
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)


@contextlib.contextmanager
def made_folder(path: Path) -> Iterator[None]:
    """Make a folder for what is written inside; one that was not there before goes again if nothing came of it.

    Raises
    ------
    SourceError
        It cannot be made or written to.
    """
    was_there = path.is_dir()
    make_folder(path)
    try:
        yield
    except BaseException:
        if not was_there:
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def make_folder(path: Path) -> None:
    """Make a folder with its parents and see that it can be written to.

    Raises
    ------
    SourceError
        It cannot.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise SourceError(f"{path}: is no folder that can be written to ({error.strerror})") from None
