"""A flag that a signal handler may set: asked to end, by SIGTERM or by Ctrl-C."""

from queue import Empty, SimpleQueue


class StopFlag:
    """What is set once to end a program.

    `threading.Event` will not do. Its lock is held for a moment whenever one waits for it. A handler runs in the main
    thread, between any two of its steps: if it sets the event just then, it waits for a lock that its own thread holds,
    and the program hangs. A `SimpleQueue` may be put into from anywhere.
    """

    def __init__(self) -> None:
        self._asked: SimpleQueue[None] = SimpleQueue()

    def set(self) -> None:
        """Ask for the end; any thread and any signal handler may, more than once."""
        self._asked.put(None)

    def is_set(self) -> bool:
        """Whether the end was asked for."""
        return not self._asked.empty()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the end is asked for, but no longer than `timeout_s` [s]; whether it was."""
        try:
            self._asked.get(timeout=timeout_s)
        except Empty:
            return False
        self._asked.put(None)
        return True
