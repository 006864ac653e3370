"""Files here and elsewhere: a path, or a URL of anything that fsspec knows (s3://, sftp://, https://, memory://, ...)."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from flightlog.errors import SourceError, UsageError

_MARK: Final = "://"


def is_remote(place: str) -> bool:
    """Whether it is a URL."""
    return _MARK in place


def beside(base: Path, place: str) -> str:
    """A place named in a file: a URL as it stands, a path as seen from the folder of that file."""
    return place if is_remote(place) else str((base.parent / Path(place).expanduser()).resolve())


def fetch(place: str, folder: Path) -> Path:
    """A file as a path: itself where it is here, else a copy of the same name in a folder.

    Raises
    ------
    SourceError
        It is not there, or cannot be read.
    """
    if not is_remote(place):
        return Path(place)
    with _told(place, "read"):
        system, path = _system(place)
        target = folder / path.rsplit("/", 1)[-1]
        with system.open(path, "rb") as source, target.open("wb") as copy:
            shutil.copyfileobj(source, copy, 1 << 22)
    return target


def state(place: str) -> str:
    """What tells two states of a file elsewhere apart: size, and entity tag or time of change."""
    with _told(place, "read"):
        system, path = _system(place)
        system.invalidate_cache()
        info = system.info(path)
    return " ".join(str(info.get(key, "")) for key in ("size", "ETag", "LastModified", "mtime", "created"))


def read_text(place: str) -> str | None:
    """A small text of elsewhere; None where there is none."""
    try:
        with _told(place, "read"):
            system, path = _system(place)
            system.invalidate_cache()
            return bytes(system.cat_file(path)).decode("utf-8")
    except SourceError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return None
        raise


def deliver(folder: Path, place: str, last: str) -> None:
    """Put all files of a folder elsewhere; the one named `last` when all others are there, so that who finds it finds all.

    Raises
    ------
    SourceError
    """
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    with _told(place, "written"):
        system, base = _system(place)
        system.makedirs(base, exist_ok=True)
        if system.exists(f"{base}/{last}"):
            system.rm_file(f"{base}/{last}")
        for path in sorted(files, key=lambda path: path.name == last):
            name = path.relative_to(folder).as_posix()
            if "/" in name:
                system.makedirs(f"{base}/{name.rsplit('/', 1)[0]}", exist_ok=True)
            system.put_file(str(path), f"{base}/{name}")


def _system(place: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it."""
    try:
        import fsspec
    except ModuleNotFoundError:
        raise UsageError(
            f"{place}: files elsewhere need fsspec, which is not installed; pip install 'swath[cluster]'"
        ) from None
    system, path = fsspec.core.url_to_fs(place)
    return system, str(path)


@contextmanager
def _told(place: str, what: str) -> Iterator[None]:
    """Errors of any file system as one sentence that names the place."""
    try:
        yield
    except (SourceError, UsageError):
        raise
    except ImportError as error:
        raise UsageError(f"{place}: {error}") from None
    except FileNotFoundError as error:
        raise SourceError(f"{place}: is not there") from error
    except Exception as error:  # broad: each file system has errors of its own, and all become one sentence here
        words = " ".join(str(error).split()) or type(error).__name__
        raise SourceError(f"{place}: cannot be {what} ({words})") from error
