"""The field of view: packets wholly outside are left out; in a packet across its edge, the blocks outside lose ranges.

What lies inside is never touched. A block does not have a single direction: its 32 shots sweep on from the block's
azimuth while the head turns, so a block stays if any of its shots lies inside.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flightlog.hdl32e import AZIMUTH_STEPS, FIRING_NS, LASER_NS, LASERS, ReturnMode

LARGEST_STEP: Final = 100
"""Upper bound on the azimuth from one firing to the next [0.01 deg]: three times the fastest head's (1200 rpm, 0.33 deg)."""

_INSIDE: Final = 1
_AHEAD: Final = 2
"""Just ahead of the window: a block there may turn into it."""
_LAST_SHOT_NS: Final = (LASERS - 1) * LASER_NS
"""When in a firing the last laser shoots [ns]."""


@dataclass(frozen=True, slots=True)
class Window:
    """The sector to keep, clockwise from start to end, both included [0.01 deg]; equal: the full circle."""

    start: int
    end: int

    @classmethod
    def from_degrees(cls, start_deg: float, end_deg: float) -> "Window":
        """Make a window from azimuths [deg]; 360 is 0."""
        return cls(round(start_deg * 100) % AZIMUTH_STEPS, round(end_deg * 100) % AZIMUTH_STEPS)

    @property
    def width(self) -> int:
        """From start to end [0.01 deg]; 0 for the full circle."""
        return (self.end - self.start) % AZIMUTH_STEPS


class Masked(NamedTuple):
    """What is kept, and how much was not."""

    packets: npt.NDArray[np.void]
    masked_packets: int
    masked_blocks: int


def apply(packets: npt.NDArray[np.void], window: Window) -> Masked:
    """Keep what lies in a window.

    Parameters
    ----------
    packets : ndarray of SCAN_PACKET_DTYPE, shape (n,)
        Left as they are; what is changed is a copy.
    window : Window

    Returns
    -------
    Masked
        packets, shape (m,); packets left out; blocks blanked (range 0, azimuth and intensity kept) in those that stay.
    """
    if window.width == 0:
        return Masked(packets, 0, 0)
    data = packets["data"]
    inside = blocks_inside(data["blocks"]["azimuth"], data["return_mode"], window)
    stays = np.asarray(inside.any(axis=1))
    kept = select(packets, stays)
    packet, block = np.nonzero(~inside[stays])
    if len(packet):
        ranges = kept["data"]["blocks"]["returns"]["range"]
        ranges[packet, block] = 0
    return Masked(kept, len(packets) - len(kept), len(packet))


def select(packets: npt.NDArray[np.void], which: npt.NDArray[np.bool_]) -> npt.NDArray[np.void]:
    """Copy some packets with every byte they have.

    numpy's own `packets[which]` copies field by field: forty times slower, and bytes that belong to no field are lost.
    """
    return packets.view(f"V{packets.dtype.itemsize}")[which].view(packets.dtype)


def blocks_inside(
    azimuth: npt.NDArray[np.uint16], return_mode: npt.NDArray[np.uint8], window: Window
) -> npt.NDArray[np.bool_]:
    """Which blocks have a shot inside the window.

    Parameters
    ----------
    azimuth : ndarray of uint16, shape (n, 12)
        Azimuths as sent [0.01 deg], 36000 included.
    return_mode : ndarray of uint8, shape (n,)
    window : Window

    Returns
    -------
    ndarray of bool, shape (n, 12)
    """
    where = np.take(_where(window), azimuth)
    inside = np.asarray(where == _INSIDE)
    ahead = where == _AHEAD
    if ahead.any():  # in few packets
        near = ahead.any(axis=1)
        start = azimuth[near].astype(np.int32)
        inside[near] |= _turns_in(start, return_mode[near], (start - window.start) % AZIMUTH_STEPS)
    return inside


@lru_cache(maxsize=1)
def _where(window: Window) -> npt.NDArray[np.uint8]:
    """Where each azimuth lies, shape (65536,): a table, because a remainder costs ten times as much as a look-up."""
    past = (np.arange(1 << 16) - window.start) % AZIMUTH_STEPS
    out = np.zeros(past.shape, np.uint8)
    out[past > AZIMUTH_STEPS - LARGEST_STEP - 1] = _AHEAD
    out[past <= window.width] = _INSIDE
    return out


def _turns_in(
    start: npt.NDArray[np.int32], return_mode: npt.NDArray[np.uint8], past: npt.NDArray[np.int32]
) -> npt.NDArray[np.bool_]:
    """Which blocks reach the start of the window with their last shot; `past` is how far past that start they begin."""
    step = azimuth_step(start, return_mode)[:, None]
    # The last shot's azimuth, start + step * _LAST_SHOT_NS / FIRING_NS, rounded to 0.01 deg as a decoder does, in whole numbers.
    last_past = past + (2 * _LAST_SHOT_NS * step + FIRING_NS) // (2 * FIRING_NS)
    return np.asarray(last_past >= AZIMUTH_STEPS)


def azimuth_step(azimuth: npt.NDArray[np.int32], return_mode: npt.NDArray[np.uint8]) -> npt.NDArray[np.int32]:
    """Azimuth from one firing to the next [0.01 deg], shape (n,).

    The median over the packet, so that the gap of a sensor that limits its own field of view does not count; the largest possible
    step where the azimuths make no sense. In dual return mode two blocks share a firing.
    """
    steps = np.diff(azimuth, axis=1) % AZIMUTH_STEPS
    step = np.sort(steps, axis=1)[:, steps.shape[1] // 2]
    dual = return_mode == ReturnMode.DUAL
    if dual.any():
        pairs = np.sort(np.diff(azimuth[dual, ::2], axis=1) % AZIMUTH_STEPS, axis=1)
        step[dual] = pairs[:, pairs.shape[1] // 2]
    return np.asarray(np.minimum(step, LARGEST_STEP))
