"""Lidar packets to shots in the sensor frame: exact times and azimuths, both returns, range gates, field of view.

The arithmetic of one firing lives here, in numba kernels that `georeference` shares, so that what `swath decode` shows is what
`swath process` places in the world. Source: HDL-32E user's manual, and the facts in `flightlog.hdl32e`.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import hdl32e
from flightlog.errors import PacketError
from flightlog.hdl32e import BLOCKS, ELEVATION_DEG, FIRING_NS, LASER_NS, LASERS, RANGE_LSB_M, ReturnMode

Array = npt.NDArray[np.float64]

_BLOCK_BYTES: Final = hdl32e.BLOCK_DTYPE.itemsize
AZIMUTH_TURN: Final = float(hdl32e.AZIMUTH_STEPS)
"""A full turn [0.01 deg]."""
STEP_RAD: Final = 2.0 * np.pi / AZIMUTH_TURN
LASER_FRACTION: Final = LASER_NS / FIRING_NS
"""Part of a firing's azimuth step that passes from one laser to the next."""
_LARGEST_STEP: Final = 200.0
"""Azimuth steps of 0.01 deg in a firing that no rotor reaches (20 Hz: 33); beyond it the packet's azimuths are not understood."""

SINGLE_RETURN: Final = 0x11
"""LAS 1.4 byte of return numbers: return 1 (low half) of 1 (high half)."""
FIRST_OF_TWO: Final = 0x21
SECOND_OF_TWO: Final = 0x22


@dataclass(frozen=True, slots=True)
class Gate:
    """Which shots are let through.

    Attributes
    ----------
    fov_start_deg, fov_end_deg : float
        Azimuth window, clockwise from start to end, both included, for example 255 to 105 through straight ahead. Equal modulo
        360: the full circle.
    min_range_m, max_range_m : float
        Inclusive range gate [m].
    """

    fov_start_deg: float = 0.0
    fov_end_deg: float = 360.0
    min_range_m: float = 0.0
    max_range_m: float = 200.0

    def steps(self) -> tuple[float, float, int, int]:
        """Window start and width [0.01 deg], least and largest range [2 mm], as the kernels want them."""
        start = (self.fov_start_deg % 360.0) * 100.0
        width = ((self.fov_end_deg - self.fov_start_deg) % 360.0) * 100.0
        low = max(1, int(np.ceil(self.min_range_m / RANGE_LSB_M - 1e-6)))
        high = min(65535, int(np.floor(self.max_range_m / RANGE_LSB_M + 1e-6)))
        return start, width if width > 0.0 else AZIMUTH_TURN, low, high


@dataclass(frozen=True, slots=True)
class LaserTable:
    """What is known of the 32 lasers: elevations, and corrections of their ranges.

    Attributes
    ----------
    elevation_rad : ndarray, shape (32,)
    range_offset_m : ndarray, shape (32,)
        Added to each range.
    """

    elevation_rad: Array
    range_offset_m: Array

    @classmethod
    def nominal(cls) -> "LaserTable":
        """The manual's elevations and no corrections."""
        return cls(np.deg2rad(ELEVATION_DEG), np.zeros(LASERS))


@dataclass(frozen=True, slots=True)
class Shots:
    """Returns of the lidar, in the order they were received.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        Lidar time [ns].
    xyz_m : ndarray of float32, shape (n, 3)
        Position in the sensor frame: x right, y forward, z up.
    azimuth_cdeg : ndarray of float32, shape (n,)
        Azimuth at the laser's own instant [0.01 deg], 0 to 36000.
    range_steps : ndarray of uint16, shape (n,)
        Range as measured [2 mm].
    intensity, laser : ndarray of uint8, shape (n,)
    returns : ndarray of uint8, shape (n,)
        Return number (low half, nearest first) and number of returns (high half).
    """

    time_ns: npt.NDArray[np.int64]
    xyz_m: npt.NDArray[np.float32]
    azimuth_cdeg: npt.NDArray[np.float32]
    range_steps: npt.NDArray[np.uint16]
    intensity: npt.NDArray[np.uint8]
    laser: npt.NDArray[np.uint8]
    returns: npt.NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.time_ns)


def raw_bytes(packets: npt.NDArray[np.void]) -> tuple[npt.NDArray[np.uint8], int]:
    """View DATA_DTYPE or SCAN_PACKET_DTYPE packets, shape (n,), as bytes, without a copy.

    Returns
    -------
    raw : ndarray of uint8, shape (n, itemsize)
        Whole elements, and so contiguous: the kernels are an eighth slower on a view with gaps.
    head : int
        Where in an element the 1206 bytes of the sensor begin.
    """
    head = 0 if packets.dtype.fields is None or "data" not in packets.dtype.fields else packets.dtype.fields["data"][1]
    return packets.view(np.uint8).reshape(len(packets), packets.dtype.itemsize), head


def is_dual(packets: npt.NDArray[np.void]) -> bool:
    """Whether packets of DATA_DTYPE are in dual return mode.

    Raises
    ------
    PacketError
        The mode changes within them: cut there first.
    """
    dual = packets["return_mode"] == ReturnMode.DUAL
    if dual.any() and not dual.all():
        raise PacketError("lidar packets: single and dual return mode in one batch, expected one mode")
    return bool(len(dual) and dual[0])


def by_mode(
    packets: npt.NDArray[np.void], time_ns: npt.NDArray[np.int64]
) -> Iterator[tuple[npt.NDArray[np.void], npt.NDArray[np.int64]]]:
    """Cut SCAN_PACKET_DTYPE packets and their times where the return mode changes."""
    modes = packets["data"]["return_mode"] == ReturnMode.DUAL
    edges = [0, *(np.flatnonzero(modes[1:] != modes[:-1]) + 1).tolist(), len(packets)]
    for a, b in itertools.pairwise(edges):
        yield packets[a:b], time_ns[a:b]


def decode(
    packets: npt.NDArray[np.void],
    time_ns: npt.NDArray[np.int64],
    gate: Gate | None = None,
    lasers: LaserTable | None = None,
) -> Shots:
    """Turn data packets into shots.

    Parameters
    ----------
    packets : ndarray of SCAN_PACKET_DTYPE or DATA_DTYPE, shape (n,)
        All of one return mode.
    time_ns : ndarray of int64, shape (n,)
        Lidar time of each packet's stamp [ns], unwrapped.
    gate : Gate, optional
        Default: every return.
    lasers : LaserTable, optional
        Default: the manual's.
    """
    data = packets["data"] if packets.dtype.names and "data" in packets.dtype.names else packets
    (raw, head), dual = raw_bytes(packets), is_dual(data)
    lasers = lasers or LaserTable.nominal()
    size = len(raw) * BLOCKS * LASERS
    out = (
        np.empty(size, np.int64),
        np.empty((size, 3), np.float32),
        np.empty(size, np.float32),
        np.empty(size, np.uint16),
        np.empty(size, np.uint8),
        np.empty(size, np.uint8),
        np.empty(size, np.uint8),
    )
    elevation = np.stack([np.cos(lasers.elevation_rad), np.sin(lasers.elevation_rad), lasers.range_offset_m])
    kernel = _decode_dual if dual else _decode_single
    count = kernel(raw, head, time_ns, elevation, *(gate or Gate()).steps(), out)
    stamps, xyz, azimuth, ranges, intensity, laser, returns = out
    return Shots(
        stamps[:count],
        xyz[:count],
        azimuth[:count],
        ranges[:count],
        intensity[:count],
        laser[:count],
        returns[:count],
    )


@njit(cache=True, nogil=True, inline="always")
def u16(row: Any, offset: int) -> Any:
    """Little-endian 16-bit word of a packet."""
    return np.int64(row[offset]) | (np.int64(row[offset + 1]) << 8)


@njit(cache=True, nogil=True)
def azimuth_step(row: Any, stride: int, steps: Any) -> float:
    """Azimuth step of one firing [0.01 deg]: the median over the packet, which a gap within the packet does not move.

    Source: the peers agree on the median (VeloView); mean end to end fails where the sensor's own field of view cuts the packet.
    """
    count = 0
    for block in range(stride, BLOCKS, stride):
        step = u16(row, block * _BLOCK_BYTES + 2) - u16(row, (block - stride) * _BLOCK_BYTES + 2)
        steps[count] = (step + 54_000) % 36_000 - 18_000
        count += 1
    for i in range(1, count):  # insertion sort: eleven numbers
        value = steps[i]
        j = i - 1
        while j >= 0 and steps[j] > value:
            steps[j + 1] = steps[j]
            j -= 1
        steps[j + 1] = value
    middle = steps[count // 2] if count % 2 else 0.5 * (steps[count // 2 - 1] + steps[count // 2])
    return middle if 0.0 <= middle <= _LARGEST_STEP else 0.0


@njit(cache=True, nogil=True)
def laser_directions(step: float, lasers: Any, directions: Any) -> None:
    """Horizontal direction of each laser when the block's azimuth is 0: forward and right part, shape (2, 32).

    A firing sweeps less than 2 deg from first to last laser: the series are exact to 1e-10.
    """
    for k in range(LASERS):
        angle = step * LASER_FRACTION * k * STEP_RAD
        square = angle * angle
        directions[0, k] = lasers[0, k] * (1.0 - square * (0.5 - square * (1.0 / 24.0)))
        directions[1, k] = lasers[0, k] * angle * (1.0 - square * (1.0 / 6.0) * (1.0 - square * 0.05))


@njit(cache=True, nogil=True, inline="always")
def block_is_inside(azimuth: float, step: float, start: float, width: float) -> bool:
    """Whether a block's whole sweep lies in the window, so that its shots need no look of their own."""
    return (azimuth - start) % AZIMUTH_TURN + step <= width


@njit(cache=True, nogil=True, inline="always")
def block_is_outside(azimuth: float, step: float, start: float, width: float) -> bool:
    """Whether none of a block's sweep lies in the window."""
    past_start = (azimuth - start) % AZIMUTH_TURN
    return past_start > width and past_start + step < AZIMUTH_TURN


@njit(cache=True, nogil=True, inline="always")
def pair_returns(row: Any, last: int, other: int, low: int, high: int) -> Any:
    """The returns of one laser in dual return mode: place of the nearer, place of the farther, how many (0 to 2).

    The even block holds the last return at `last`, the odd one the strongest at `other`, or the second strongest where the
    strongest is also the last; two equal ones are one return. A return outside the range gate is none.
    """
    range_last, range_other = u16(row, last), u16(row, other)
    has_last = low <= range_last <= high
    has_other = low <= range_other <= high and not (range_other == range_last and row[other + 2] == row[last + 2])
    if has_last and has_other:
        if range_other <= range_last:
            return other, last, 2
        return last, other, 2
    if has_last:
        return last, last, 1
    return other, other, 1 if has_other else 0


@njit(cache=True, nogil=True, inline="always")
def _put(
    out: Any, count: int, time_ns: int, x: float, y: float, z: float, azimuth: float, range_steps: Any, laser: int
) -> None:
    """Write what both return modes share of shot number `count`."""
    out[0][count] = time_ns
    out[1][count, 0] = x
    out[1][count, 1] = y
    out[1][count, 2] = z
    out[2][count] = azimuth
    out[3][count] = range_steps
    out[5][count] = laser


@njit(cache=True, nogil=True, fastmath=True)
def _decode_single(
    raw: Any, head: int, time_ns: Any, lasers: Any, start: float, width: float, low: int, high: int, out: Any
) -> int:
    count = 0
    steps, directions = np.empty(BLOCKS), np.empty((2, LASERS))
    for packet in range(raw.shape[0]):
        row = raw[packet, head:]
        step = azimuth_step(row, 1, steps)
        laser_directions(step, lasers, directions)
        for block in range(BLOCKS):
            azimuth = float(u16(row, block * _BLOCK_BYTES + 2) % 36_000)
            if block_is_outside(azimuth, step, start, width):
                continue
            inside = block_is_inside(azimuth, step, start, width)
            cosine, sine = np.cos(azimuth * STEP_RAD), np.sin(azimuth * STEP_RAD)
            firing_ns = time_ns[packet] + block * FIRING_NS
            at = block * _BLOCK_BYTES + 1
            for k in range(LASERS):
                at += 3
                range_steps = u16(row, at)
                laser_azimuth = azimuth + step * LASER_FRACTION * k
                if range_steps < low or range_steps > high:
                    continue
                if not inside and (laser_azimuth - start) % AZIMUTH_TURN > width:
                    continue
                distance = range_steps * RANGE_LSB_M + lasers[2, k]
                _put(
                    out,
                    count,
                    firing_ns + k * LASER_NS,
                    distance * (cosine * directions[1, k] + sine * directions[0, k]),
                    distance * (cosine * directions[0, k] - sine * directions[1, k]),
                    distance * lasers[1, k],
                    laser_azimuth if laser_azimuth < AZIMUTH_TURN else laser_azimuth - AZIMUTH_TURN,
                    range_steps,
                    k,
                )
                out[4][count] = row[at + 2]
                count += 1
    out[6][:count] = SINGLE_RETURN
    return count


@njit(cache=True, nogil=True, fastmath=True)
def _decode_dual(
    raw: Any, head: int, time_ns: Any, lasers: Any, start: float, width: float, low: int, high: int, out: Any
) -> int:
    count = 0
    steps, directions = np.empty(BLOCKS), np.empty((2, LASERS))
    for packet in range(raw.shape[0]):
        row = raw[packet, head:]
        step = azimuth_step(row, 2, steps)
        laser_directions(step, lasers, directions)
        for block in range(0, BLOCKS, 2):
            azimuth = float(u16(row, block * _BLOCK_BYTES + 2) % 36_000)
            if block_is_outside(azimuth, step, start, width):
                continue
            inside = block_is_inside(azimuth, step, start, width)
            cosine, sine = np.cos(azimuth * STEP_RAD), np.sin(azimuth * STEP_RAD)
            firing_ns = time_ns[packet] + (block // 2) * FIRING_NS
            for k in range(LASERS):
                laser_azimuth = azimuth + step * LASER_FRACTION * k
                if not inside and (laser_azimuth - start) % AZIMUTH_TURN > width:
                    continue
                last = block * _BLOCK_BYTES + 4 + 3 * k
                first, second, returns = pair_returns(row, last, last + _BLOCK_BYTES, low, high)
                for number in range(returns):
                    at = first if number == 0 else second
                    range_steps = u16(row, at)
                    distance = range_steps * RANGE_LSB_M + lasers[2, k]
                    _put(
                        out,
                        count,
                        firing_ns + k * LASER_NS,
                        distance * (cosine * directions[1, k] + sine * directions[0, k]),
                        distance * (cosine * directions[0, k] - sine * directions[1, k]),
                        distance * lasers[1, k],
                        laser_azimuth if laser_azimuth < AZIMUTH_TURN else laser_azimuth - AZIMUTH_TURN,
                        range_steps,
                        k,
                    )
                    out[4][count] = row[at + 2]
                    out[6][count] = SINGLE_RETURN if returns == 1 else FIRST_OF_TWO + number
                    count += 1
    return count
