"""What systems do differently: locks, processes, links. All else of the ground tool is the same on each of them."""

import contextlib
import ctypes
import errno
import importlib
import importlib.util
import mmap
import os
import shutil
import sys
import threading
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

THREADS: Final = "NUMBA_NUM_THREADS"
"""The variable of the environment that says how many threads kernels may take; ours follow it."""
LIMITED: Final = os.name == "posix" and importlib.util.find_spec("resource") is not None
"""Whether a process can be started that has limits and shares memory by a descriptor."""
_PUNCH_HOLE_KEEP_SIZE: Final = 3
"""Of Linux' fallocate."""
_mapped: "Final[weakref.WeakSet[mmap.mmap]]" = weakref.WeakSet()
_mapping: Final = threading.Lock()
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
"""Of glibc's mallopt."""
_LARGE_BLOCK: Final = 4 << 20
_FREE_OF_HEAP: Final = 8 << 20, 64 << 20
"""What glibc keeps free at the end of each thread's heap: while large blocks go back, and what it has come to by itself otherwise."""
_LARGEST_OF_HEAP: Final = 32 << 20
"""What glibc takes from its heap at most, on 64 bits."""
_QUERY: Final = 0x1000
_STILL_ACTIVE: Final = 259
"""Of Windows: PROCESS_QUERY_LIMITED_INFORMATION, and the exit code of what runs."""


@contextlib.contextmanager
def without(*names: str) -> Iterator[None]:
    """Import libraries as if some packages were not installed that they would load if they can, and that nothing here uses."""
    hidden = [name for name in names if name not in sys.modules]
    # a name that stands for None raises ImportError (the import system's own rule), which typeshed's dict of modules does not know
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in hidden:
            sys.modules.pop(name, None)


def give_back_memory() -> None:
    """Give what is free to the system, where the C library keeps it: it takes glibc 10 ms, and is 100 MB and more after many threads.

    With it what of files is in memory that are mapped to be read now and then.
    """
    let_go()
    with contextlib.suppress(OSError, AttributeError, TypeError):  # other C libraries, and none by that way
        ctypes.CDLL(None).malloc_trim(0)


def read_now_and_then(room: mmap.mmap) -> mmap.mmap:
    """A file mapped into memory as one of which `let_go` leaves nothing there until it is read again."""
    with _mapping:
        _mapped.add(room)
    return room


def let_go() -> None:
    """Have nothing of such files in memory, where the system can do so."""
    if hasattr(mmap, "MADV_DONTNEED"):
        with _mapping:
            rooms = list(_mapped)
        for room in rooms:
            with contextlib.suppress(OSError):  # pages that are locked in memory stay there
                room.madvise(mmap.MADV_DONTNEED)


@contextlib.contextmanager
def large_blocks_given_back() -> Iterator[None]:
    """Have what is large go back to the system when it is freed, where the C library is glibc.

    By itself glibc takes blocks up to 32 MB from its heap as soon as one of that size was freed, and the heap keeps the holes, and twice as
    much at its end, of each thread. Afterwards they are, for fresh memory takes as long to come as to fill: that is for who works on
    millions of rows, and not for who streams.
    """
    _set_heap(_LARGE_BLOCK, _FREE_OF_HEAP[0])
    try:
        yield
    finally:
        _set_heap(_LARGEST_OF_HEAP, _FREE_OF_HEAP[1])


def _set_heap(least_apart: int, most_free: int) -> None:
    with contextlib.suppress(OSError, AttributeError, TypeError):  # as above
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, least_apart)
        library.mallopt(_M_TRIM_THRESHOLD, most_free)


def give_back_disk(file: int, begin: int, size: int) -> None:
    """Give the room of bytes that are needed no more to the system, where it can make a hole in a file (Linux); they are read as 0 then."""
    with contextlib.suppress(
        OSError, AttributeError, TypeError
    ):  # other systems, and C libraries that are found in no such way
        punch = ctypes.CDLL(None).fallocate
        punch.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)
        punch(file, _PUNCH_HOLE_KEEP_SIZE, begin, size)


def take_disk(file: int, size: int) -> None:
    """Make an open file so large, with its room on the disk taken now where the system can do so.

    A file with holes that is mapped into memory finds out of a full disk when it is written to: by a signal that kills the process.

    Raises
    ------
    OSError
        There is no room.
    """
    take = getattr(os, "posix_fallocate", None)  # not on macOS and Windows
    if take is not None and size > 0:
        try:
            take(file, 0, size)
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # the file system cannot do it
                raise
    os.truncate(file, size)


def choose_threads_of_blas() -> None:
    """Have numpy's and scipy's linear algebra take one thread, unless the environment says otherwise: to be called before they are loaded.

    Matrices here are small, and between two of them OpenBLAS's other threads turn round for 20 ms: they took two of five parts of the
    time of an adjustment, from the cores that kernels have use for.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def cores() -> int:
    """Processors that this process may use: those that the system gives it, or fewer where it was told so."""
    given = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    told = os.environ.get(THREADS, "")
    return min(given, int(told)) if told.isdecimal() and int(told) else given


def alive(pid: int) -> bool:
    """Whether a process runs."""
    if os.name == "nt":  # there a signal of 0 would end it
        return _alive_on_windows(pid)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _alive_on_windows(pid: int) -> bool:
    kernel: Any = getattr(ctypes, "windll").kernel32  # noqa: B009 - it is there on Windows only
    handle = kernel.OpenProcess(_QUERY, False, pid)
    if not handle:
        return False
    code = ctypes.c_ulong()
    kernel.GetExitCodeProcess(handle, ctypes.byref(code))
    kernel.CloseHandle(handle)
    return code.value == _STILL_ACTIVE


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder; the system lets go when this process ends, however it ends.

    Raises
    ------
    BlockingIOError
        Another process holds it.
    """
    if importlib.util.find_spec("fcntl") is not None:
        import fcntl

        place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield
        finally:
            os.close(place)
        return
    if importlib.util.find_spec("msvcrt") is None:  # a system without locks of either kind
        yield
        return
    windows: Any = importlib.import_module("msvcrt")
    with (folder / ".lock").open("ab") as file:
        try:
            windows.locking(file.fileno(), windows.LK_NBLCK, 1)
        except OSError:
            raise BlockingIOError from None
        yield


def linked(link: Path, target: Path) -> None:
    """Another name for a file: a link, or a copy where the user may make none."""
    try:
        link.symlink_to(target.resolve())
    except (OSError, NotImplementedError):
        shutil.copyfile(target, link)
