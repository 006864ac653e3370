"""Where compiled kernels are kept: the user's cache folder, apart for every state of the sources that each is made from.

numba looks for a changed source in the file of the kernel alone. What it calls or takes a constant from in other files it
has compiled in, and does not look at again: after an update of one file of two, old machine code would go on running. And beside
the sources, where it keeps its cache by default, nobody may write in a proper installation. So numba is told to ask here
(https://numba.readthedocs.io/en/stable/reference/envvars.html, NUMBA_CACHE_LOCATOR_CLASSES).
"""

import atexit
import contextlib
import functools
import hashlib
import importlib.util
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, Final

FOLDER_VARIABLE: Final = "NUMBA_CACHE_DIR"
_LOCATORS_VARIABLE: Final = "NUMBA_CACHE_LOCATOR_CLASSES"
OPTIMISES_VARIABLE: Final = "NUMBA_OPT"
OPTIMISES: Final = "2"
"""How far LLVM optimises: kernels are as fast as by numba's own 3, and are compiled in a seventh less time."""
KEPT_S: Final = 30 * 86400
"""Kernels that were not used for so long are removed."""
_PREFIX: Final = "kernels-"
_PACKAGES: Final = ("groundproc", "flightlog", "simulator")
_ROOT: Final = Path(__file__).parents[2]
_IMPORT: Final = re.compile(
    rb"^(?:from ((?:%(p)s)[\w.]*) import (?:\(([^)]*)\)|(.*))|import ((?:%(p)s)[\w.]*).*)$"
    % {b"p": b"|".join(name.encode() for name in _PACKAGES)},
    re.MULTILINE,
)


class BySources:
    """Where numba keeps what it compiles of one function: asked through numba's own door, so the names are numba's.

    Parameters
    ----------
    function : callable
    source : str
        The file that it stands in.
    """

    def __init__(self, function: Callable[..., Any], source: str) -> None:
        self._py_file = source  # numba's warnings name it
        self._line = function.__code__.co_firstlineno
        self._stamp = stamp(Path(source))

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "BySources | None":
        """One for a function of a file; None for what was typed in."""
        return cls(py_func, py_file) if Path(py_file).is_file() else None

    def get_cache_path(self) -> str:
        """The folder of the file's kernels in the state that its sources have."""
        return str(_of_file(self._py_file, self._stamp))

    def ensure_cache_path(self) -> None:
        """Make the folder; numba asks for it just before it writes, so what follows is for one process at a time.

        Raises
        ------
        OSError
            If it cannot be made.
        """
        Path(self.get_cache_path()).mkdir(parents=True, exist_ok=True)
        _turn().take()

    def get_source_stamp(self) -> str:
        """What kernels of another state are told apart by."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Tells functions of one name in one file apart."""
        return str(self._line)


class _Turn:
    """A process's turn to write: from when numba asks for the folder until it lets go of its compiler lock.

    numba gives the code of one signature a number that is free in the index of the function, then writes both. Two
    processes that do so at once can take one number for two signatures: the next one would run code made for other arrays.
    """

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None

    def take(self) -> None:
        """Wait for it; where the system has no such locks, go on without."""
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            file = (folder() / ".lock").open("ab")
            fcntl.flock(file, fcntl.LOCK_EX)
            self._file = file

    def on_start(self, event: object) -> None:
        """Of the compiler lock: nothing to do."""

    def on_end(self, event: object) -> None:
        """The compiler lock is let go of, and so is the turn."""
        if self._file is not None:
            self._file.close()
            self._file = None


@functools.cache
def _turn() -> _Turn:
    """The one of this process, which numba tells of its compiler lock."""
    from numba.core import event

    class Listener(_Turn, event.Listener):
        """As numba wants it."""

    turn = Listener()
    event.register("numba:compiler_lock", turn)  # type: ignore[no-untyped-call]  # numba is not typed
    return turn


def takes_turns() -> bool:
    """Whether processes may compile at once: where the system has no such locks, two could take one number for two signatures."""
    return importlib.util.find_spec("fcntl") is not None


def choose() -> None:
    """Have numba ask `BySources`, and optimise as far as pays unless the user says otherwise; to be called before it is loaded."""
    os.environ.setdefault(OPTIMISES_VARIABLE, OPTIMISES)
    locators = f"{__name__}.{BySources.__name__}"
    os.environ[_LOCATORS_VARIABLE] = locators
    loaded = sys.modules.get("numba")
    if loaded is not None:
        loaded.config.CACHE_LOCATOR_CLASSES = locators


@functools.cache
def folder() -> Path:
    """What holds all kernels: the place that the user named, else the user's cache; where nobody may write, one of this process."""
    given = os.environ.get(FOLDER_VARIABLE)
    path = Path(given) if given else _user_folder()
    with contextlib.suppress(OSError):
        path.mkdir(parents=True, exist_ok=True)
        if os.access(path, os.W_OK | os.X_OK):
            return path
    own = tempfile.mkdtemp(prefix=f"swath-{_PREFIX}")
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return Path(own)


@functools.cache
def stamp(source: Path) -> str:
    """Hash of all that is compiled into the kernels of a file: itself and its `sources`."""
    digest = hashlib.sha256()
    for path in sorted(sources(source)):
        content = _content(path)
        name = path.relative_to(_ROOT) if path.is_relative_to(_ROOT) else path
        digest.update(f"{name.as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


def sources(source: Path) -> set[Path]:
    """The file, and what kernels of it can have compiled in, however far away: kernels, tuples of arrays and constants from other files."""
    found: set[Path] = set()
    waiting = [source]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting.extend(_imported(_content(path), _root(path)))
    return found


def remove_old(now_s: float) -> None:
    """Remove kernels that nobody has used for a long time."""
    for other in folder().glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            if other.stat().st_mtime < now_s - KEPT_S:
                shutil.rmtree(other)


def _imported(content: bytes, root: Path) -> Iterator[Path]:
    """Files of ours that a file takes kernels, tuples or constants from."""
    for module, several, one, whole in _IMPORT.findall(content):
        base = root.joinpath(*(module or whole).decode().split("."))
        names = re.findall(rb"\w+", several or one)
        for path in (base.with_suffix(".py"), base / "__init__.py"):
            if path.is_file() and (_is_compiled(path) or any(name.isupper() for name in names)):
                yield path
        yield from (path for name in names if (path := base / f"{name.decode()}.py").is_file())


def _is_compiled(path: Path) -> bool:
    content = _content(path)
    return b"njit" in content or b"NamedTuple" in content


def _root(path: Path) -> Path:
    """The folder that the packages lie in."""
    return next((parent.parent for parent in path.parents if parent.name in _PACKAGES), _ROOT)


@functools.cache
def _content(path: Path) -> bytes:
    return path.read_bytes()


@functools.cache
def _of_file(source: str, state: str) -> Path:
    """The folder of a file's kernels; that it was used is noted in its time."""
    path = folder() / f"{_PREFIX}{Path(source).stem}-{state}"
    with contextlib.suppress(OSError):
        os.utime(path)
    return path


def _user_folder() -> Path:
    """The user's folder for caches, by the XDG base directory specification."""
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    with contextlib.suppress(RuntimeError):  # a user without a home
        return (given if given.is_absolute() else Path("~/.cache").expanduser()) / "swath"
    return Path("/nonexistent")
