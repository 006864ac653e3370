"""Work done by a second thread: the next piece of a stream is made while the last one is used, and short works beside a long one.

That gains time where the work is in kernels and libraries that leave the interpreter to others meanwhile: reading, decoding, placing,
compressing.
"""

import contextlib
import importlib
import queue
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, TypeVar

from groundproc.machine.system import cores

T = TypeVar("T")
U = TypeVar("U")

_DEPTH: Final = 1
"""Pieces that wait: one is used, one waits, one is being made."""


def _closed(items: Iterator[T]) -> Iterator[T]:
    """The items; the iterator is closed when this is left."""
    try:
        yield from items
    finally:
        if isinstance(items, Generator):
            items.close()


class _End:
    """Behind the last item: why there are no more."""

    def __init__(self, error: BaseException | None) -> None:
        self.error = error


def ahead(
    items: Iterator[T], lock: "contextlib.AbstractContextManager[object] | None" = None
) -> Generator[T, None, None]:
    """The items of an iterator, made by a thread of its own that begins with the first one asked for; on one core by the same one.

    An error of the iterator comes where the item would have come. Left before the end, it is to be closed: then the thread has ended.

    Parameters
    ----------
    items : iterator
        Used by that thread only, and closed by it.
    lock : context manager, optional
        Held while an item is made: iterators that share something share one.
    """
    if cores() == 1:  # nothing is gained, and flights that share a computer are not to take more than their part
        yield from _closed(items)
        return
    made: queue.SimpleQueue[T | _End] = queue.SimpleQueue()
    room, over = threading.Semaphore(_DEPTH), threading.Event()
    held = lock or contextlib.nullcontext()

    def work() -> None:
        error: BaseException | None = None
        try:
            while not over.is_set():
                with held:
                    item = next(items)
                made.put(item)
                del item  # it is the other thread's alone, which may drop it
                room.acquire()
        except StopIteration:
            pass
        except BaseException as raised:  # whatever it is, it is told where the item was wanted
            error = raised
        finally:
            if isinstance(items, Generator):
                with contextlib.suppress(Exception), held:
                    items.close()
            made.put(_End(error))

    thread = threading.Thread(target=work, name="ahead", daemon=True)
    thread.start()
    try:
        while not isinstance(item := made.get(), _End):
            yield item
            del item  # before the next one is waited for
            room.release()
        if item.error is not None:
            raise item.error
    finally:
        over.set()
        room.release()
        thread.join()


def beside(works: Sequence[Callable[[], object]]) -> None:
    """Do some works that do not need each other: the first here, the others in their order by one thread beside it; on one core all here.

    The longest one is to be the first: an interrupt ends it at once, and the others after the one that is being done. An error of the first
    goes before one of the others.
    """
    if cores() == 1 or len(works) < 2:
        for work in works:
            work()
        return
    errors: list[BaseException] = []
    over = threading.Event()

    def do_others() -> None:
        try:
            for work in works[1:]:
                if not over.is_set():
                    work()
        except BaseException as raised:  # whatever it is, it is told by the other thread
            errors.append(raised)

    thread = threading.Thread(target=do_others, name="beside", daemon=True)
    thread.start()
    try:
        works[0]()
        thread.join()
    finally:
        over.set()
        thread.join()
    if errors:
        raise errors[0]


class InOrder:
    """Works done one after the other by a thread of its own while others go on; each at once where it is given, on one core.

    It is used by one thread. A work's error comes where it is waited for, or where a later one is given.
    """

    def __init__(self) -> None:
        self._pool = None if cores() == 1 else ThreadPoolExecutor(1, "in order")
        self._given: deque[Future[None]] = deque()

    def do(self, work: Callable[[], None]) -> "Future[None] | None":
        """Have a work done after those before it, and what tells when it is done: None where it is already."""
        if self._pool is None:
            work()
            return None
        while self._given and self._given[0].done():
            self._given.popleft().result()
        self._given.append(self._pool.submit(work))
        return self._given[-1]

    def wait(self) -> None:
        """Until all are done."""
        while self._given:
            self._given.popleft().result()


def both(first: Callable[[], T], second: Callable[[], U]) -> tuple[T, U]:
    """What two works give that do not need each other; the second is done by a thread beside the first, on one core after it."""
    found: list[U] = []
    made: list[T] = []
    beside([lambda: made.append(first()), lambda: found.append(second())])
    return made[0], found[0]


def imported_meanwhile(modules: Sequence[str]) -> None:
    """Import modules that will be wanted, by a thread; on one core nothing is gained, and they are imported when they are used.

    What fails is left for then to be told.
    """
    if cores() == 1:
        return

    def load() -> None:
        with contextlib.suppress(ImportError):
            for name in modules:
                importlib.import_module(name)

    threading.Thread(target=load, name="imports", daemon=True).start()
