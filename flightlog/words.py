"""Text from outside, made harmless before it reaches a terminal, a journal, a pilot's screen or a file.

A GPS sentence, the name of a parameter or a file, or the output of another machine's shell may hold escapes that move
the cursor, or forge or hide a line. Every string from outside goes through `clean` before it is shown.
"""

import unicodedata
from typing import Final

_SHOWN_AS_TEXT: Final = frozenset(("Ll", "Lu", "Lt", "Lm", "Lo", "Mn", "Mc", "Nd", "Nl", "No", "Sm", "Sc", "Sk", "So"))
_MOST: Final = 2000
_LAYOUT: Final = "\n\t\r"


def clean(text: str, most: int = _MOST) -> str:
    r"""The text in one line, without anything that a terminal or a log would act on.

    Controls (C0, C1, DEL, line and paragraph separators), invisible and direction-changing characters, and surrogates become the
    escapes that Python writes: ESC is \x1b, a line feed \n. Letters of all scripts stay, and so do plain spaces.

    Parameters
    ----------
    text : str
    most : int
        Characters that are kept; a longer text ends in "...".
    """
    if len(text) > most:
        text = text[:most] + "..."
    if text.isascii() and text.isprintable():
        return text
    return "".join(character if _is_harmless(character) else _escaped(character) for character in text)


def clean_output(text: str) -> str:
    """Text on its way to a terminal: as `clean`, but uncut, and with line feeds, tabs, and the carriage returns of progress bars."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(one if one in _LAYOUT or _is_harmless(one) else _escaped(one) for one in text)


def clean_bytes(raw: bytes, most: int = _MOST) -> str:
    """The ASCII text before the first zero byte, cleaned; bytes beyond ASCII show as escapes."""
    return clean(raw.split(b"\x00")[0].decode("ascii", errors="backslashreplace").strip(), most)


def clean_lines(text: str, most: int = 20) -> list[str]:
    """The lines of a text, each cleaned; no more than so many, the last ones."""
    return [clean(line) for line in text.splitlines()[-most:]]


def _is_harmless(character: str) -> bool:
    category = unicodedata.category(character)
    return category in _SHOWN_AS_TEXT or category.startswith("P") or character == " "


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
