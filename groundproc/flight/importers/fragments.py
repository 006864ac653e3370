"""Datagrams that came in pieces, put together again (RFC 791, RFC 8200 section 4.5)."""

from dataclasses import dataclass, field
from typing import Final

Key = tuple[bytes, bytes]
"""Identification, and addresses of sender and receiver."""

_MOST_WAITING: Final = 64
_LARGEST: Final = 65_535
"""Bytes of a datagram."""


@dataclass(slots=True)
class _Datagram:
    pieces: dict[int, bytes] = field(default_factory=dict)
    """By their place [bytes]."""
    size: int = 0
    """Bytes in them."""
    end: int | None = None
    """Where the last piece ends; None before it came."""


@dataclass(slots=True)
class Fragments:
    """Gathers pieces; of the datagrams that wait for one, the 64 youngest.

    Attributes
    ----------
    whole : int
        Datagrams that were put together.
    left_out : int
        Pieces of datagrams that were given up.
    """

    whole: int = 0
    left_out: int = 0
    _open: dict[Key, _Datagram] = field(default_factory=dict)

    @property
    def waiting(self) -> int:
        """Pieces of datagrams that are not whole."""
        return sum(len(each.pieces) for each in self._open.values())

    def add(self, key: Key, place: int, piece: bytes, *, more: bool) -> bytes | None:
        """Take the piece that begins at `place`; gives what the datagram holds where that makes it whole.

        Pieces that overlap contradict each other or are an attack: all of the datagram is left out, as RFC 5722 wants it.
        """
        found = self._open.setdefault(key, _Datagram())
        if found.pieces.get(place) == piece:  # captured twice
            return None
        end = place + len(piece)
        contradicts = place in found.pieces or end > _LARGEST or (found.end is not None and not more)
        if contradicts or (more and len(piece) % 8):
            self._give_up(key, 1)
            return None
        found.pieces[place] = piece
        found.size += len(piece)
        found.end = found.end if more else end
        if found.end is not None and found.size >= found.end:
            return self._joined(key, found)
        if len(self._open) > _MOST_WAITING:
            self._give_up(next(iter(self._open)), 0)
        return None

    def _joined(self, key: Key, found: _Datagram) -> bytes | None:
        places = sorted(found.pieces)
        data = b"".join(found.pieces[place] for place in places)
        at = 0
        for place in places:
            if place != at:
                self._give_up(key, 0)
                return None
            at += len(found.pieces[place])
        del self._open[key]
        self.whole += 1
        return data

    def _give_up(self, key: Key, more: int) -> None:
        self.left_out += len(self._open.pop(key).pieces) + more
