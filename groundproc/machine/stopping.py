"""Signals that end a command, as exceptions: what is half-written is removed, whatever the reason to stop."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Final

_told: Final[list[int]] = []
"""Signals that came."""


class Stopped(KeyboardInterrupt):
    """SIGTERM, Ctrl-C, or SIGXCPU: the processor's time that the system allows is used up.

    Parameters
    ----------
    number : int
        Of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Have these signals raise it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGTERM]
    if hasattr(signal, "SIGXCPU"):  # not on every system
        numbers.append(signal.SIGXCPU)
    # in the background of a shell nobody hears of Ctrl-C
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        numbers.append(signal.SIGINT)
    before = [(number, signal.signal(number, _stop)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in before:
            # the system goes on to send it once a second
            signal.signal(number, signal.SIG_IGN if number in _told and _repeats(number) else handler)


@contextlib.contextmanager
def heard() -> Iterator[None]:
    """In place of an error inside, raise the exception of a signal that came inside.

    A library that calls back to write, as lazrs does, makes a failed write of such an exception.

    Raises
    ------
    Stopped
    """
    before = len(_told)
    try:
        yield
    except Exception:  # broad: whatever a library makes of the exception; without a signal it is raised again
        if len(_told) > before:
            raise Stopped(_told[-1]) from None
        raise


def _repeats(number: int) -> bool:
    return number == getattr(signal, "SIGXCPU", None)


def _stop(number: int, frame: FrameType | None) -> None:
    _told.append(number)
    raise Stopped(number)
