"""MAVLink 2 signatures: who holds the key said it, and said it now (mavlink.io, "Message Signing").

A signed frame ends in 13 bytes: link id, time in units of 10 us since 2015 (48 bits), and the first 48 bits of SHA-256 over the key, the
frame and these two. A frame is old that is not later than the one before of the same sender and link, or, of a new one, a minute
behind the latest that was believed.
"""

import hashlib
import hmac
from enum import Enum
from pathlib import Path
from typing import Final

from flightlog.errors import ConfigError
from flightlog.mavlink import Frame

KEY_BYTES: Final = 32
SIGNATURE_BYTES: Final = 13
_SIGNED: Final = 0x01
_DIGEST_BYTES: Final = 6
_MINUTE: Final = 60 * 100_000
EPOCH_S: Final = 1_420_070_400
"""2015-01-01 in Unix time."""
_MOST_STREAMS: Final = 64
"""Senders and links that are kept track of."""
_LARGEST_FILE: Final = 4096


class Word(Enum):
    """What a signature says of a frame."""

    GOOD = "good"
    UNSIGNED = "unsigned"
    WRONG = "wrong"
    """Made with another key, or changed."""
    OLD = "old"
    """Said before: it may have been recorded and sent again."""


def is_signed(frame: Frame) -> bool:
    """Whether a frame carries a signature, right or wrong."""
    return frame.version == 2 and bool(frame.data[2] & _SIGNED)


def time_of(unix_ns: int) -> int:
    """Time of a signature of a Unix time [ns]; 0 for a clock that has not been set."""
    return max(0, (unix_ns - EPOCH_S * 1_000_000_000) // 10_000)


class Checker:
    """Checks the frames of one link.

    Parameters
    ----------
    key : bytes
        32 of them.

    Attributes
    ----------
    newest : int
        Time of the latest frame that was believed; what is sent must be later.
    counts : dict of Word to int
    """

    def __init__(self, key: bytes) -> None:
        assert len(key) == KEY_BYTES
        self._key = key
        self._streams: dict[tuple[int, int, int], int] = {}
        self.newest = 0
        self.counts = dict.fromkeys(Word, 0)

    def check(self, frame: Frame) -> Word:
        """What is to be thought of a frame whose checksum is right; it is counted."""
        word = self._word(frame)
        self.counts[word] += 1
        return word

    def _word(self, frame: Frame) -> Word:
        if not is_signed(frame):
            return Word.UNSIGNED
        digest = hashlib.sha256(self._key + frame.data[:-_DIGEST_BYTES]).digest()[:_DIGEST_BYTES]
        if not hmac.compare_digest(digest, frame.data[-_DIGEST_BYTES:]):
            return Word.WRONG
        link, stamp = frame.data[-SIGNATURE_BYTES], int.from_bytes(frame.data[-12:-6], "little")
        stream = (frame.system, frame.component, link)
        before = self._streams.get(stream, self.newest - _MINUTE - 1)
        if stamp <= before:
            return Word.OLD
        if stream not in self._streams and len(self._streams) >= _MOST_STREAMS:
            del self._streams[min(self._streams, key=self._streams.__getitem__)]
        self._streams[stream] = stamp
        self.newest = max(self.newest, stamp)
        return Word.GOOD


def read_key(path: Path) -> bytes:
    """The key in a file: 64 hexadecimal digits, or a passphrase, whose SHA-256 is the key as ground stations make it.

    Raises
    ------
    ConfigError
        It cannot be read, or is empty.
    """
    try:
        with path.open("rb") as file:
            text = file.read(_LARGEST_FILE + 1)
    except OSError as error:
        raise ConfigError(f"{path}: the key cannot be read ({error.strerror})") from None
    words = text.strip()
    if not words or len(text) > _LARGEST_FILE or b"\n" in words:
        raise ConfigError(
            f"{path}: {len(text)} bytes found, expected 64 hexadecimal digits or a passphrase on one line"
        )
    try:
        key = bytes.fromhex(words.decode("ascii"))
    except ValueError:
        return hashlib.sha256(words).digest()
    return key if len(key) == KEY_BYTES else hashlib.sha256(words).digest()
