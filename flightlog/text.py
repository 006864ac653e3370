"""Text that other programs wrote, whatever mark it begins with: UTF-8 with and without byte-order mark, and UTF-16."""

import codecs
from typing import Final

_SIGNED: Final = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_LOOKED_AT: Final = 64
HEAD_BYTES: Final = _LOOKED_AT
"""First bytes by which `encoding_of` decides."""


def encoding_of(head: bytes) -> str:
    """The encoding of a text that begins so: by its byte-order mark, or by zeros in every second byte; else UTF-8."""
    for mark, name in _SIGNED:
        if head.startswith(mark):
            return name
    low, high = head[:_LOOKED_AT:2], head[1:_LOOKED_AT:2]
    if len(high) >= 4 and not any(high) and all(low):
        return "utf-16-le"
    if len(high) >= 4 and not any(low) and all(high):
        return "utf-16-be"
    return "utf-8"


def decode(data: bytes, errors: str = "strict") -> str:
    """A text without its byte-order mark.

    Raises
    ------
    UnicodeDecodeError
        It is no text; not with `errors` "replace".
    """
    return data.decode(encoding_of(data), errors)
