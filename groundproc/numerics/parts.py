"""A kernel's work shared out between cores: threads of Python, for kernels leave the interpreter to others while they run.

numba's own parallel loops take longer to compile (3.4 CPU-seconds in place of 2.0 for products of rows), and their threads turn round while
they wait for more: of products with a pause between them each took 14 ms, of 8 that it works.
"""

import threading
from collections.abc import Callable

from numba import config


def at_once(work: Callable[[int], object], count: int) -> None:
    """Do `work` of 0 to `count` - 1, each once, by as many threads as kernels may take: the first here, and all where that is one."""
    threads = max(min(config.NUMBA_NUM_THREADS, count), 1)  # type: ignore[attr-defined] # numba sets it when it is imported
    errors: list[BaseException] = []

    def do(first: int) -> None:
        try:
            for number in range(first, count, threads):
                if not errors:
                    work(number)
        except BaseException as raised:  # whatever it is, it is told when all have ended
            errors.append(raised)

    others = [threading.Thread(target=do, args=(first,), name="at once", daemon=True) for first in range(1, threads)]
    for each in others:
        each.start()
    do(0)
    for each in others:
        each.join()
    if errors:
        raise errors[0]
