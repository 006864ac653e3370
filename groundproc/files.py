"""Products appear whole or not at all: written under another name beside, then renamed."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from flightlog.errors import SourceError, SwathError


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Give a name beside `path` to write to; on leaving it becomes `path`, on an error it is removed.

    Folders above it that are missing are made, and go again where nothing came of it.

    Raises
    ------
    SourceError
        The place cannot be written to.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    made = [folder for folder in path.parents if not folder.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield aside
        aside.replace(path)
        made = []
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None
    except SwathError as error:
        if str(aside) not in str(error):
            raise
        raise type(error)(str(error).replace(str(aside), str(path))) from None
    finally:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
            for folder in made:
                folder.rmdir()


@contextlib.contextmanager
def removed(path: Path) -> Iterator[Path]:
    """A file that is there for the time of the work."""
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def made_folder(path: Path) -> Iterator[None]:
    """Make a folder for what is written inside; one that was not there before goes again if nothing came of it.

    Raises
    ------
    SourceError
        It cannot be made or written to.
    """
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    make_folder(path)
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for folder in made:
                folder.rmdir()
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
