"""From packets of twelve blocks to shots: the arithmetic of the firings, for every model that packs its returns so.

A model differs by a few numbers only: when each of a block's 32 returns was fired, and by which laser (`Firing`).
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.hdl32e import AZIMUTH_STEPS, BLOCK_DTYPE, BLOCKS, RANGE_LSB_M
from groundproc.numerics.layout import to_read
from groundproc.numerics.memory import Pool
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
_FINE_STEPS: Final = 100
_FINE: Final = np.exp(1j * np.arange(_FINE_STEPS) * _STEP_RAD)
"""Cosine and sine, as a complex number, of each azimuth below one degree."""
_COARSE: Final = np.exp(1j * np.arange(0, AZIMUTH_STEPS, _FINE_STEPS) * _STEP_RAD)
"""The same of each whole degree. The product of the two takes a fifth of the time of computing cosine and sine."""
_MEMORY: Final = Pool()


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
    out = _columns(len(raw) * BLOCKS * RETURNS)
    counters = np.zeros(3, np.int64)
    kernel = _decode_dual if is_dual(packets) else _decode_single
    table = np.ascontiguousarray(lasers.kernel_rows()[:, firing.laser])
    timing = _Timing(firing.block_ns, firing.offset_ns, firing.offset_ns / firing.block_ns, firing.laser)
    count = kernel(to_read(raw), head, to_read(time_ns), table, timing, limits(gate or Gate()), out, counters)
    return Shots(
        out.time_ns[:count],
        out.xyz_m[:count],
        out.range_m[:count],
        out.intensity[:count],
        out.laser[:count],
        out.returns[:count],
        lasers,
        Gated(*counters.tolist()),
    )


class _Timing(NamedTuple):
    """What the kernels want to know of a `Firing`.

    Attributes
    ----------
    block_ns : int
    offset_ns : ndarray of int64, shape (32,)
    fraction : ndarray, shape (32,)
        Part of the block's azimuth step that has passed when each return is fired.
    laser : ndarray of uint8, shape (32,)
    """

    block_ns: int
    offset_ns: npt.NDArray[np.int64]
    fraction: npt.NDArray[np.float64]
    laser: npt.NDArray[np.uint8]


class _Columns(NamedTuple):
    """The arrays of `Shots` that the kernels fill, in its order."""

    time_ns: npt.NDArray[np.int64]
    xyz_m: npt.NDArray[np.float32]
    range_m: npt.NDArray[np.float32]
    intensity: npt.NDArray[np.uint8]
    laser: npt.NDArray[np.uint8]
    returns: npt.NDArray[np.uint8]


def _columns(size: int) -> _Columns:
    """Room for so many shots."""
    return _Columns(
        _MEMORY.empty(size, np.int64),
        _MEMORY.empty((size, 3), np.float32),
        _MEMORY.empty(size, np.float32),
        _MEMORY.empty(size, np.uint8),
        _MEMORY.empty(size, np.uint8),
        _MEMORY.empty(size, np.uint8),
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
    middle = steps[count // 2]  # of eleven, or five
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


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _turn(directions: Any, azimuth: int, out: Any) -> None:
    """Turn the directions of a block to its azimuth [0.01 deg]: part along y and part along x, shape (2, 32)."""
    degree = np.uint64(azimuth) // np.uint64(_FINE_STEPS)
    direction = _COARSE[degree] * _FINE[np.uint64(azimuth) - degree * np.uint64(_FINE_STEPS)]
    cosine, sine = direction.real, direction.imag
    for k in range(RETURNS):
        out[0, k] = cosine * directions[0, k] - sine * directions[1, k]
        out[1, k] = cosine * directions[1, k] + sine * directions[0, k]


@njit(cache=True, nogil=True, inline="always")
def _past(azimuth: float, start: float) -> float:
    """How far an azimuth lies past the start of the window, 0 to a turn, both being less than two turns apart. `%` takes far longer."""
    past = azimuth - start
    if past < 0.0:
        past += _TURN
    return past - _TURN if past >= _TURN else past


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
    raw: Any, head: int, time_ns: Any, lasers: Any, timing: Any, limit: Any, out: Any, counters: Any
) -> int:
    """Fill the columns with the shots of packets in single return mode, and count the others as `Gated` does; how many shots."""
    # names of their own and unsigned numbers: no index is negative then, and nothing is looked up again in the loop
    out_time, out_xyz, out_range, out_intensity, out_laser = (
        out.time_ns,
        out.xyz_m,
        out.range_m,
        out.intensity,
        out.laser,
    )
    offset_ns, fraction, laser = timing.offset_ns, timing.fraction, timing.laser
    start, width, low, high = limit.start, limit.width, limit.low, limit.high
    count, outside, nothing, beyond = np.uint64(0), 0, 0, 0
    steps, directions, turned = np.empty(BLOCKS), np.empty((2, RETURNS)), np.empty((2, RETURNS))
    for packet in range(raw.shape[0]):
        row = raw[packet, head:]
        step = _azimuth_step(row, 1, steps)
        _directions(step, fraction, lasers, directions)
        for block in range(BLOCKS):
            azimuth = _u16(row, block * _BLOCK_BYTES + 2) % AZIMUTH_STEPS
            past = _past(float(azimuth), start)
            if past > width and past + step < _TURN:  # the whole sweep of the block
                outside += RETURNS
                continue
            inside = past + step <= width
            _turn(directions, azimuth, turned)
            block_time_ns = time_ns[packet] + block * timing.block_ns
            returns = row[block * _BLOCK_BYTES + 4 : (block + 1) * _BLOCK_BYTES]
            for k in range(RETURNS):
                range_steps = _u16(returns, 3 * k)
                if not inside and _past(azimuth + step * fraction[k], start) > width:
                    outside += 1
                    continue
                if range_steps < low or range_steps > high:
                    if range_steps == 0:
                        nothing += 1
                    else:
                        beyond += 1
                    continue
                range_m = range_steps * RANGE_LSB_M
                distance = range_m + lasers[2, k]
                out_time[count] = block_time_ns + offset_ns[k]
                out_xyz[count, 0] = distance * turned[1, k]
                out_xyz[count, 1] = distance * turned[0, k]
                out_xyz[count, 2] = distance * lasers[1, k] + lasers[3, k]
                out_range[count] = range_m
                out_intensity[count] = returns[3 * k + 2]
                out_laser[count] = laser[k]
                count += np.uint64(1)
    out.returns[: int(count)] = SINGLE_RETURN
    counters[0], counters[1], counters[2] = outside, nothing, beyond
    return int(count)


@njit(cache=True, nogil=True, fastmath=True)
def _decode_dual(
    raw: Any, head: int, time_ns: Any, lasers: Any, timing: Any, limit: Any, out: Any, counters: Any
) -> int:
    """As `_decode_single`, in dual return mode: two blocks are one firing."""
    out_time, out_xyz, out_range, out_intensity, out_laser = (
        out.time_ns,
        out.xyz_m,
        out.range_m,
        out.intensity,
        out.laser,
    )
    out_returns, offset_ns, fraction, laser = out.returns, timing.offset_ns, timing.fraction, timing.laser
    start, width, low, high = limit.start, limit.width, limit.low, limit.high
    count, outside, nothing, beyond = np.uint64(0), 0, 0, 0
    steps, directions, turned = np.empty(BLOCKS), np.empty((2, RETURNS)), np.empty((2, RETURNS))
    for packet in range(raw.shape[0]):
        row = raw[packet, head:]
        step = _azimuth_step(row, 2, steps)
        _directions(step, fraction, lasers, directions)
        for block in range(0, BLOCKS, 2):
            azimuth = _u16(row, block * _BLOCK_BYTES + 2) % AZIMUTH_STEPS
            past = _past(float(azimuth), start)
            if past > width and past + step < _TURN:
                outside += RETURNS
                continue
            inside = past + step <= width
            _turn(directions, azimuth, turned)
            block_time_ns = time_ns[packet] + (block // 2) * timing.block_ns
            for k in range(RETURNS):
                if not inside and _past(azimuth + step * fraction[k], start) > width:
                    outside += 1
                    continue
                last = block * _BLOCK_BYTES + 4 + 3 * k
                first, second, returns = _pair(row, last, last + _BLOCK_BYTES, low, high)
                if returns == 0:
                    if _u16(row, last) or _u16(row, last + _BLOCK_BYTES):
                        beyond += 1
                    else:
                        nothing += 1
                for number in range(returns):
                    at = first if number == 0 else second
                    range_m = _u16(row, at) * RANGE_LSB_M
                    distance = range_m + lasers[2, k]
                    out_time[count] = block_time_ns + offset_ns[k]
                    out_xyz[count, 0] = distance * turned[1, k]
                    out_xyz[count, 1] = distance * turned[0, k]
                    out_xyz[count, 2] = distance * lasers[1, k] + lasers[3, k]
                    out_range[count] = range_m
                    out_intensity[count] = row[at + 2]
                    out_laser[count] = laser[k]
                    out_returns[count] = SINGLE_RETURN if returns == 1 else FIRST_OF_TWO + number
                    count += np.uint64(1)
    counters[0], counters[1], counters[2] = outside, nothing, beyond
    return int(count)
