"""From packets of twelve blocks to shots: the arithmetic of the firings, for every model that packs its returns so.

A model differs by a few numbers only: when each of a block's 32 returns was fired, and by which laser (`Firing`).
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.hdl32e import AZIMUTH_STEPS, BLOCK_DTYPE, BLOCKS, RANGE_LSB_M
from groundproc.sensors.blocks import Packets, Times, is_dual, limits, raw_bytes
from groundproc.sensors.shots import FIRST_OF_TWO, SINGLE_RETURN, Gate, Gated, LaserTable, Shots

RETURNS: Final = 32
"""In a block."""
_BLOCK_BYTES: Final = BLOCK_DTYPE.itemsize
_TURN: Final = float(AZIMUTH_STEPS)
"""A full turn [0.01 deg]."""
_STEP_RAD: Final = 2.0 * np.pi / _TURN
_LARGEST_STEP: Final = 200.0
"""Azimuth steps of 0.01 deg from block to block that no rotor reaches (20 Hz: 80); beyond it a packet's azimuths mean nothing."""


@dataclass(frozen=True, slots=True)
class Firing:
    """How a model fills a block.

    Attributes
    ----------
    block_ns : int
        From the begin of one block to that of the next in single return mode [ns].
    offset_ns : ndarray of int64, shape (32,)
        When each return of a block was fired, from the begin of the block.
    laser : ndarray of uint8, shape (32,)
        Which laser fired it.
    """

    block_ns: int
    offset_ns: npt.NDArray[np.int64]
    laser: npt.NDArray[np.uint8]


def decode(firing: Firing, packets: Packets, time_ns: Times, gate: Gate | None, lasers: LaserTable) -> Shots:
    """Turn packets into shots.

    Parameters
    ----------
    firing : Firing
    packets : ndarray of SCAN_PACKET_DTYPE or DATA_DTYPE, shape (n,)
        All of one return mode.
    time_ns : ndarray of int64, shape (n,)
        Time of each packet's stamp [ns]; that of its first firing.
    gate : Gate, optional
        Default: every return.
    lasers : LaserTable

    Raises
    ------
    PacketError
        The return mode changes within them.
    """
    raw, head = raw_bytes(packets)
    size = len(raw) * BLOCKS * RETURNS
    stamps, xyz, ranges = np.empty(size, np.int64), np.empty((size, 3), np.float32), np.empty(size, np.float32)
    intensity, laser, returns = np.empty(size, np.uint8), np.empty(size, np.uint8), np.empty(size, np.uint8)
    counters = np.zeros(3, np.int64)
    kernel = _decode_dual if is_dual(packets) else _decode_single
    table = np.ascontiguousarray(lasers.kernel_rows()[:, firing.laser])
    fraction = firing.offset_ns / firing.block_ns
    count = kernel(
        raw, head, time_ns, table, fraction, firing.offset_ns, firing.laser, firing.block_ns, *limits(gate or Gate()),
        (stamps, xyz, ranges, intensity, laser, returns), counters,
    )  # fmt: skip
    return Shots(
        stamps[:count],
        xyz[:count],
        ranges[:count],
        intensity[:count],
        laser[:count],
        returns[:count],
        lasers,
        Gated(*counters.tolist()),
    )


@njit(cache=True, nogil=True, inline="always")
def _u16(row: Any, offset: int) -> Any:
    """Little-endian 16-bit word of a packet."""
    return np.int64(row[offset]) | (np.int64(row[offset + 1]) << 8)


@njit(cache=True, nogil=True)
def _azimuth_step(row: Any, stride: int, steps: Any) -> float:
    """Azimuth step from block to block [0.01 deg]: the median over the packet, which a gap within the packet does not move.

    `stride` is 2 where two blocks share a firing. Source: the peers agree on the median (VeloView); mean end to end fails where the
    sensor's own field of view cuts the packet.
    """
    count = 0
    for block in range(stride, BLOCKS, stride):
        step = _u16(row, block * _BLOCK_BYTES + 2) - _u16(row, (block - stride) * _BLOCK_BYTES + 2)
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
def _directions(step: float, fraction: Any, lasers: Any, out: Any) -> None:
    """Horizontal direction of each return when the block's azimuth is 0: forward and right part, shape (2, 32).

    A block sweeps less than 2 deg: the series are exact to 1e-10.
    """
    for k in range(RETURNS):
        angle = step * fraction[k] * _STEP_RAD
        square = angle * angle
        out[0, k] = lasers[0, k] * (1.0 - square * (0.5 - square * (1.0 / 24.0)))
        out[1, k] = lasers[0, k] * angle * (1.0 - square * (1.0 / 6.0) * (1.0 - square * 0.05))


@njit(cache=True, nogil=True, inline="always")
def _is_inside(azimuth: float, step: float, start: float, width: float) -> bool:
    """Whether a block's whole sweep lies in the window, so that its shots need no look of their own."""
    return (azimuth - start) % _TURN + step <= width


@njit(cache=True, nogil=True, inline="always")
def _is_outside(azimuth: float, step: float, start: float, width: float) -> bool:
    """Whether none of a block's sweep lies in the window."""
    past_start = (azimuth - start) % _TURN
    return past_start > width and past_start + step < _TURN


@njit(cache=True, nogil=True, inline="always")
def _pair(row: Any, last: int, other: int, low: int, high: int) -> Any:
    """The returns of one laser in dual return mode: place of the nearer, place of the farther, how many (0 to 2).

    The even block holds the last return at `last`, the odd one the strongest at `other`, or the second strongest where the
    strongest is also the last; two equal ones are one return. A return outside the range gate is none.
    """
    range_last, range_other = _u16(row, last), _u16(row, other)
    has_last = low <= range_last <= high
    has_other = low <= range_other <= high and not (range_other == range_last and row[other + 2] == row[last + 2])
    if has_last and has_other:
        if range_other <= range_last:
            return other, last, 2
        return last, other, 2
    if has_last:
        return last, last, 1
    return other, other, 1 if has_other else 0


@njit(cache=True, nogil=True, fastmath=True)
def _decode_single(
    raw: Any, head: int, time_ns: Any, lasers: Any, fraction: Any, offset_ns: Any, laser: Any, block_ns: int,
    start: float, width: float, low: int, high: int, out: Any, counters: Any,
) -> int:  # fmt: skip
    out_time, out_xyz, out_range, out_intensity, out_laser, out_returns = out
    count = 0
    steps, directions = np.empty(BLOCKS), np.empty((2, RETURNS))
    for packet in range(raw.shape[0]):
        row = raw[packet, head:]
        step = _azimuth_step(row, 1, steps)
        _directions(step, fraction, lasers, directions)
        for block in range(BLOCKS):
            azimuth = float(_u16(row, block * _BLOCK_BYTES + 2) % 36_000)
            if _is_outside(azimuth, step, start, width):
                counters[0] += RETURNS
                continue
            inside = _is_inside(azimuth, step, start, width)
            cosine, sine = np.cos(azimuth * _STEP_RAD), np.sin(azimuth * _STEP_RAD)
            block_time_ns = time_ns[packet] + block * block_ns
            at = block * _BLOCK_BYTES + 1
            for k in range(RETURNS):
                at += 3
                range_steps = _u16(row, at)
                if not inside and (azimuth + step * fraction[k] - start) % _TURN > width:
                    counters[0] += 1
                    continue
                if range_steps < low or range_steps > high:
                    counters[1 if range_steps == 0 else 2] += 1
                    continue
                range_m = range_steps * RANGE_LSB_M
                distance = range_m + lasers[2, k]
                out_time[count] = block_time_ns + offset_ns[k]
                out_xyz[count, 0] = distance * (cosine * directions[1, k] + sine * directions[0, k])
                out_xyz[count, 1] = distance * (cosine * directions[0, k] - sine * directions[1, k])
                out_xyz[count, 2] = distance * lasers[1, k] + lasers[3, k]
                out_range[count] = range_m
                out_intensity[count] = row[at + 2]
                out_laser[count] = laser[k]
                count += 1
    out_returns[:count] = SINGLE_RETURN
    return count


@njit(cache=True, nogil=True, fastmath=True)
def _decode_dual(
    raw: Any, head: int, time_ns: Any, lasers: Any, fraction: Any, offset_ns: Any, laser: Any, block_ns: int,
    start: float, width: float, low: int, high: int, out: Any, counters: Any,
) -> int:  # fmt: skip
    out_time, out_xyz, out_range, out_intensity, out_laser, out_returns = out
    count = 0
    steps, directions = np.empty(BLOCKS), np.empty((2, RETURNS))
    for packet in range(raw.shape[0]):
        row = raw[packet, head:]
        step = _azimuth_step(row, 2, steps)
        _directions(step, fraction, lasers, directions)
        for block in range(0, BLOCKS, 2):
            azimuth = float(_u16(row, block * _BLOCK_BYTES + 2) % 36_000)
            if _is_outside(azimuth, step, start, width):
                counters[0] += RETURNS
                continue
            inside = _is_inside(azimuth, step, start, width)
            cosine, sine = np.cos(azimuth * _STEP_RAD), np.sin(azimuth * _STEP_RAD)
            block_time_ns = time_ns[packet] + (block // 2) * block_ns
            for k in range(RETURNS):
                if not inside and (azimuth + step * fraction[k] - start) % _TURN > width:
                    counters[0] += 1
                    continue
                last = block * _BLOCK_BYTES + 4 + 3 * k
                first, second, returns = _pair(row, last, last + _BLOCK_BYTES, low, high)
                if returns == 0:
                    counters[2 if row[last] or row[last + 1] else 1] += 1
                for number in range(returns):
                    at = first if number == 0 else second
                    range_m = _u16(row, at) * RANGE_LSB_M
                    distance = range_m + lasers[2, k]
                    out_time[count] = block_time_ns + offset_ns[k]
                    out_xyz[count, 0] = distance * (cosine * directions[1, k] + sine * directions[0, k])
                    out_xyz[count, 1] = distance * (cosine * directions[0, k] - sine * directions[1, k])
                    out_xyz[count, 2] = distance * lasers[1, k] + lasers[3, k]
                    out_range[count] = range_m
                    out_intensity[count] = row[at + 2]
                    out_laser[count] = laser[k]
                    out_returns[count] = SINGLE_RETURN if returns == 1 else FIRST_OF_TWO + number
                    count += 1
    return count
