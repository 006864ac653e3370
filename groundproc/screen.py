"""What a command writes to the terminal, made harmless: no word of a file moves the cursor, rings, or hides a line.

Sentences and values are cleaned whole (`flightlog.words.clean`) where they are put together, so that none of them begins a line of its own.
This is the net below: whatever a command prints goes through it.
"""

import contextlib
import sys
from collections.abc import Iterable, Iterator
from typing import Any

from flightlog.words import clean_output


class Screen:
    """A text stream that cleans what is written to it; in all else the stream itself."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write text, cleaned."""
        self._stream.write(clean_output(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write several."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def cleaned() -> Iterator[None]:
    """Standard output and standard error cleaned, as long as this lasts."""
    screens: tuple[Any, Any] = (Screen(sys.stdout), Screen(sys.stderr))
    with contextlib.redirect_stdout(screens[0]), contextlib.redirect_stderr(screens[1]):
        yield
