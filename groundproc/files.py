"""Products appear whole or not at all: written under another name beside, then renamed."""

import contextlib
import os
import shutil
from collections.abc import Collection, Iterator
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
def written_folder(folder: Path, last: str, before: Collection[str] = ()) -> Iterator[Path]:
    """Give a folder beside `folder` to write into; on leaving its files go there, on an error nothing does.

    Parameters
    ----------
    folder : Path
    last : str
        The file that names the others: it comes last.
    before : collection of str
        Files of the folder that go where they are not written anew.

    Raises
    ------
    SourceError
        The place cannot be written to.
    """
    aside = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        aside.mkdir(parents=True)
        yield aside
        folder.mkdir(parents=True, exist_ok=True)
        made = sorted(aside.iterdir(), key=lambda path: path.name == last)
        for path in made:
            path.replace(folder / path.name)
        for name in set(before) - {path.name for path in made}:
            (folder / name).unlink(missing_ok=True)
    except SwathError as error:
        raise type(error)(str(error).replace(str(aside), str(folder))) from None
    except OSError as error:
        raise SourceError(f"{folder}: cannot be written ({error.strerror or error})") from None
    finally:
        shutil.rmtree(aside, ignore_errors=True)


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
