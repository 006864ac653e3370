"""Which UDP ports belong to what, and what was found on others."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from flightlog import hdl32e
from flightlog.mavlink import FrameParser

MAVLINK_PORTS: Final = (14550, 14555)
"""Where ground stations listen, and where vehicles do."""
_BLOCK: Final = hdl32e.BLOCK_FLAG.to_bytes(2, "little")
_ZEROS: Final = bytes(14)
_PROBED: Final = 16
"""Datagrams of a port that are looked at for MAVLink; what follows on it is taken to be of the same kind."""


@dataclass(frozen=True, slots=True)
class Ports:
    """UDP ports; those of the lidar are destinations, those of MAVLink at either end.

    Attributes
    ----------
    lidar, position : int
    mavlink : tuple of int
    given : frozenset of str
        Names of those that the user stated: there nobody is told that other ports look better.
    """

    lidar: int = hdl32e.DATA_PORT
    position: int = hdl32e.POSITION_PORT
    mavlink: tuple[int, ...] = MAVLINK_PORTS
    given: frozenset[str] = frozenset()


@dataclass(slots=True)
class Elsewhere:
    """What looks like the lidar's or an autopilot's on ports that nobody asked for: datagrams by port."""

    data: Counter[int] = field(default_factory=Counter)
    position: Counter[int] = field(default_factory=Counter)
    mavlink: Counter[int] = field(default_factory=Counter)
    _looked_at: Counter[int] = field(default_factory=Counter)

    def add(self, port: int, payload: bytes) -> None:
        """Look at a datagram."""
        if len(payload) == hdl32e.DATA_BYTES and payload.startswith(_BLOCK):
            self.data[port] += 1
        elif len(payload) == hdl32e.POSITION_BYTES and payload.startswith(_ZEROS):
            self.position[port] += 1
        elif payload[:1] in (b"\xfe", b"\xfd") and self._is_mavlink(port, payload):
            self.mavlink[port] += 1

    def _is_mavlink(self, port: int, payload: bytes) -> bool:
        """Whether a datagram holds a good frame, or comes after some that did."""
        if self._looked_at[port] >= _PROBED:
            return self.mavlink[port] > 0
        self._looked_at[port] += 1
        parser = FrameParser()
        return any(frame.known for frame in parser.feed(0, payload) + parser.finish())

    def update(self, other: "Elsewhere") -> None:
        """Add what was found in another capture."""
        self.data.update(other.data)
        self.position.update(other.position)
        self.mavlink.update(other.mavlink)
