"""A child process whose words, time and files are bounded: what speaks through it is another machine."""

import os
import selectors
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

_READ_BYTES: Final = 1 << 16
_ERRORS_BYTES: Final = 1 << 16
"""Of standard error, the end is kept."""
_MEMORY_BYTES: Final = 2 << 30
"""Address space of a child that is given a limit for files too."""


class TooMuchError(Exception):
    """The child said more than it may; it was killed."""


class TooLateError(Exception):
    """The child was not done in time; it was killed."""


@dataclass(frozen=True, slots=True)
class Done:
    """What came of a child.

    Attributes
    ----------
    code : int
        Its exit code; negative: the signal that ended it.
    output : bytes
    errors : str
        The end of its standard error.
    """

    code: int
    output: bytes
    errors: str


def run(
    words: Sequence[str], *, most_bytes: int, seconds: float, file_bytes: int | None = None, shown: bool = False
) -> Done:
    """Run a command to its end.

    Parameters
    ----------
    words : sequence of str
    most_bytes : int
        Of its standard output.
    seconds : float
        How long it may take.
    file_bytes : int, optional
        No file that it writes may grow beyond this; then its memory is limited as well.
    shown : bool
        Its standard output goes to the terminal.

    Raises
    ------
    FileNotFoundError
        There is no such command.
    TooMuchError, TooLateError
    """
    child = subprocess.Popen(
        words,
        stdin=subprocess.DEVNULL,
        stdout=None if shown else subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=None if file_bytes is None else _limits(file_bytes),
    )
    try:
        output, errors = _read(child, most_bytes, time.monotonic() + seconds)
        return Done(child.wait(timeout=5.0), output, errors.decode("utf-8", errors="replace"))
    except subprocess.TimeoutExpired:
        raise TooLateError from None
    finally:
        with suppress(ProcessLookupError):
            child.kill()
        child.wait()
        for pipe in (child.stdout, child.stderr):
            if pipe is not None:
                pipe.close()


def _read(child: "subprocess.Popen[bytes]", most_bytes: int, end_s: float) -> tuple[bytes, bytes]:
    """Read both streams to their ends."""
    output, errors = bytearray(), bytearray()
    with selectors.DefaultSelector() as selector:
        for pipe, kept in ((child.stdout, output), (child.stderr, errors)):
            if pipe is not None:
                selector.register(pipe, selectors.EVENT_READ, kept)
        while selector.get_map():
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                raise TooLateError
            for key, _ in selector.select(left_s):
                piece = os.read(key.fd, _READ_BYTES)
                if not piece:
                    selector.unregister(key.fileobj)
                key.data.extend(piece)
            if len(output) > most_bytes:
                raise TooMuchError
            del errors[:-_ERRORS_BYTES]
    return bytes(output), bytes(errors)


def _limits(file_bytes: int) -> Callable[[], None]:
    """What sets the limits within the child, before the command begins."""
    import resource  # not on every system, and neither are ssh and rsync

    def apply() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))

    return apply
