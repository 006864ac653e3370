"""The one way in for text files of other programs: any mark, line ends and packing; and tables with any of the usual separators.

A spreadsheet of another country writes semicolons between columns and commas in numbers. The first is taken; the second is refused, for
nobody can tell 1,234 from 1.234.
"""

import csv
import io
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TextIO

from flightlog.errors import SwathError
from flightlog.text import HEAD_BYTES, decode, encoding_of
from flightlog.words import clean
from groundproc import packed

_SEPARATORS: Final = (",", ";", "\t", "|")
_DECIMAL_COMMA: Final = re.compile(r"[+-]?[0-9]+,[0-9]+(?:[eE][+-]?[0-9]+)?")
_LONGEST_LINE: Final = 1 << 20
_SHOWN: Final = 80


@contextmanager
def open_text(path: Path, encoding: str | None = None) -> Iterator[TextIO]:
    """Open a text file, compressed or not, whatever its byte-order mark and line ends; what is no text is replaced.

    Parameters
    ----------
    path : Path
    encoding : str, optional
        Where it has no mark. Default: UTF-8.

    Raises
    ------
    OSError
        It cannot be opened.
    CaptureError
        It unpacks without end.
    """
    with path.open("rb") as file:
        plain, _ = packed.opened(file, str(path))
        found = encoding_of(plain.peek(HEAD_BYTES)[:HEAD_BYTES])
        if found == "utf-8" and encoding is not None:
            found = encoding
        yield io.TextIOWrapper(plain, encoding=found, errors="replace", newline=None)


def head_of(path: Path, size: int) -> bytes:
    """The first bytes of a file, of what is in it where it is compressed; a text in UTF-16, or with a mark, as plain UTF-8.

    Raises
    ------
    OSError
        It cannot be opened.
    """
    with path.open("rb") as file:
        plain, _ = packed.opened(file, str(path))
        head = plain.read(size)
    return head if encoding_of(head) == "utf-8" else decode(head, "replace").encode()


def is_plain(path: Path) -> bool:
    """Whether another program can read a text file as it is: no compression, no mark, no UTF-16, line ends with a line feed."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    return not packed.packing(head) and encoding_of(head) == "utf-8" and (b"\n" in head or b"\r" not in head)


def make_plain(path: Path, copy: Path) -> None:
    """Write a text file as any program can read it."""
    with open_text(path) as source, copy.open("w", encoding="utf-8", newline="\n") as target:
        for line in source:
            target.write(line)


# tables ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Table:
    """A table with a line of names.

    Attributes
    ----------
    names : list of str
    separator : str or None
        None: white space.
    place : str
        Name of the file, for errors.
    error : type
        What is raised.
    """

    names: list[str]
    separator: str | None
    place: str
    error: type[SwathError]
    _file: TextIO
    _first: int

    def rows(self, *, short: bool = False) -> Iterator[tuple[int, list[str]]]:
        """Number and words of each line that is not empty; with `short`, lines may end before the last columns.

        Raises
        ------
        SwathError
            A line has another number of words than there are names.
        """
        return self.of(self._file, short=short)

    def of(self, lines: Iterable[str], *, short: bool = False) -> Iterator[tuple[int, list[str]]]:
        """The same of lines that follow the names."""
        for number, line in enumerate(lines, self._first + 1):
            if not line.strip():
                continue
            words = _split(line.rstrip("\n"), self.separator)
            if len(words) > len(self.names) or (len(words) < len(self.names) and not short):
                raise self.error(f"{self.place}: line {number}: {self.blame(words, 'as many as there are names')}")
            yield number, words

    def blame(self, words: Sequence[str], expected: str) -> str:
        """What is wrong with the words of a line: decimal commas where there are any."""
        if comma := decimal_comma(words):
            return comma
        count, named = len(words), len(self.names)
        if count != named:
            hint = "; are its decimals commas? write them as points" if self.separator == "," and count > named else ""
            return f"{count} values found for {named} columns, expected {expected}{hint}"
        return f"{_shown(words)} found, expected {expected}"


def table_of(
    file: TextIO, place: str, wanted: str | Collection[str] | int, error: type[SwathError], expected: str
) -> Table:
    """The line of names of a table; its rows follow.

    Parameters
    ----------
    file : TextIO
        At its beginning.
    place : str
        Name of the file, for errors.
    wanted : str, collection of str, or int
        A column that must be there, or one of several, or how many columns: the separator is the one that finds it.
    error : type of SwathError
        What to raise.
    expected : str
        What such a table has, for the sentence where it is none.

    Raises
    ------
    SwathError
        The first line has no such column.
    """
    number = 0
    for number, raw in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), 1):
        line = raw.strip("\r\n").lstrip("\ufeff")
        if not line.strip() or line.lower().startswith("sep="):  # a spreadsheet's hint to itself
            continue
        if (found := names_of(line, wanted)) is not None:
            return Table(found[0], found[1], place, error, file, number)
        break
    if isinstance(wanted, int):
        raise error(f"{place}: the first line does not name {wanted} columns; {expected}")
    named = wanted if isinstance(wanted, str) else next(iter(wanted))
    raise error(f"{place}: the first line has no column {named}; {expected}")


def names_of(line: str, wanted: str | Collection[str] | int) -> tuple[list[str], str | None] | None:
    """Names in the first line of a table, and its separator; None where what is wanted is not among them."""
    for separator in (*_SEPARATORS, None):
        names = [name.strip().lstrip("#").strip() for name in _split(line, separator)]
        if isinstance(wanted, int):
            found = len(names) == wanted
        else:
            several = {wanted} if isinstance(wanted, str) else set(wanted)
            found = not several.isdisjoint(names) or not several.isdisjoint(name.lower() for name in names)
        if found:
            return names, separator
    return None


def decimal_comma(words: Sequence[str]) -> str:
    """A sentence on the first word that is a number with a decimal comma; empty where none is."""
    word = next((word.strip() for word in words if _DECIMAL_COMMA.fullmatch(word.strip())), None)
    return "" if word is None else f"{_shown([word])} has a decimal comma, expected a decimal point"


def _split(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    if '"' in line:
        try:
            return [word.strip() for word in next(csv.reader([line], delimiter=separator))]
        except (csv.Error, StopIteration):
            return line.split(separator)
    return line.split(separator)


def _shown(words: Sequence[str]) -> str:
    return repr(clean(" ".join(words), _SHOWN))
