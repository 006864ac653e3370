"""What a command writes to the terminal, made harmless: no word of a file moves the cursor, rings, or hides a line.

Sentences and values are cleaned whole (`flightlog.words.clean`) where they are put together, so that none of them begins a line of its own.
This is the net below: whatever a command prints goes through it. Tables and verdicts have lines and colours on a terminal, and are plain
text elsewhere.
"""

import contextlib
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

from flightlog.words import clean, clean_output

_COLOURS: Final = {"good": "green", "doubtful": "yellow", "bad": "red", "failed": "red"}
"""Of verdicts, on a terminal that has colours and where NO_COLOR is unset."""


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


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table to standard output: the first column to the left, figures to the right.

    Parameters
    ----------
    columns : sequence of str
        Headings, with units.
    rows : sequence of sequences of str
        A text a column; one that is the name of a verdict is coloured on a terminal.
    """
    shown = [[clean(text) for text in row] for row in rows]
    console = _console()
    if console is None:
        widths = [max(map(len, column)) for column in zip(columns, *shown, strict=True)]
        for row in (columns, *shown):
            first, *rest = (
                text.ljust(w) if i == 0 else text.rjust(w) for i, (text, w) in enumerate(zip(row, widths, strict=True))
            )
            sys.stdout.write("  ".join([first, *rest]).rstrip() + "\n")
        return
    from rich import box
    from rich.table import Table
    from rich.text import Text

    made = Table(box=box.SIMPLE_HEAD, header_style="bold")
    for number, name in enumerate(columns):
        made.add_column(Text(name), justify="left" if number == 0 else "right")
    for row in shown:
        made.add_row(*(Text(text, style=_COLOURS.get(text, "")) for text in row))
    console.print(made)


def summary(rows: Sequence[tuple[str, str]]) -> None:
    """Print sentences to standard output, each with a word for what it is about, which a terminal shows beside it."""
    console = _console()
    if console is None:
        for _, text in rows:
            sys.stdout.write(text + "\n")
        return
    from rich.table import Table
    from rich.text import Text

    made = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    made.add_column(style="bold", no_wrap=True)
    made.add_column(overflow="fold")
    for name, text in rows:
        made.add_row(Text(name), Text(clean(text, _LONGEST)))
    console.print(made)


def verdict(line: str, grade: str) -> None:
    """Print a verdict to standard output, in its colour on a terminal."""
    console = _console()
    if console is None:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()
        return
    from rich.text import Text

    console.print(Text(clean(line, _LONGEST), style=f"bold {_COLOURS.get(grade, '')}".strip()), soft_wrap=True)


_LONGEST: Final = 4000
"""Characters of a sentence."""


def _console() -> Any:
    """Rich's console on standard output where that is a terminal; it writes past `Screen`, so that texts are cleaned before."""
    stream = getattr(sys.stdout, "_stream", sys.stdout)
    if not stream.isatty():
        return None
    from rich.console import Console

    sys.stdout.flush()
    return Console(file=stream, highlight=False)
