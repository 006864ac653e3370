"""What Velodyne's packets of twelve blocks have in common, for the files of the single models: fields, modes, timing.

A data packet has 1206 bytes: twelve blocks of a flag, an azimuth in 0.01 deg and 32 returns of a range in 2 mm and an intensity; then a
stamp in microseconds past the hour, the return mode and the product. Sources: HDL-32E manual 63-9113, VLP-16 manual 63-9243.
"""

import itertools
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flightlog import hdl32e
from flightlog.constants import NS_PER_US
from flightlog.errors import PacketError
from flightlog.hdl32e import RANGE_LSB_M, ReturnMode
from groundproc.sensors.shots import Gate

Array = npt.NDArray[np.float64]
Packets = npt.NDArray[np.void]
Times = npt.NDArray[np.int64]

_FEWEST: Final = 8
"""Pairs of neighbouring packets that prove a block's period."""
_LONGEST_STEP_US: Final = 20_000
"""Between neighbouring packets; longer, and the sensor may have turned once more in between."""
_PERIOD_TOLERANCE: Final = 0.25


def data_of(packets: Packets) -> Packets:
    """The DATA_DTYPE packets within SCAN_PACKET_DTYPE ones; DATA_DTYPE as they are."""
    return packets["data"] if packets.dtype.names and "data" in packets.dtype.names else packets


def raw_bytes(packets: Packets) -> tuple[npt.NDArray[np.uint8], int]:
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


def is_dual(packets: Packets) -> bool:
    """Whether packets are in dual return mode.

    Raises
    ------
    PacketError
        The mode changes within them: cut there first.
    """
    dual = data_of(packets)["return_mode"] == ReturnMode.DUAL
    if dual.any() and not dual.all():
        raise PacketError("lidar packets: single and dual return mode in one batch, expected one mode")
    return bool(len(dual) and dual[0])


def by_mode(packets: Packets, time_ns: Times) -> Iterator[tuple[Packets, Times]]:
    """Cut packets and their times where the return mode changes between single and dual."""
    modes = data_of(packets)["return_mode"] == ReturnMode.DUAL
    edges = [0, *(np.flatnonzero(modes[1:] != modes[:-1]) + 1).tolist(), len(packets)]
    for a, b in itertools.pairwise(edges):
        if b > a:
            yield packets[a:b], time_ns[a:b]


class Limits(NamedTuple):
    """A `Gate` in the units of the packets.

    Attributes
    ----------
    start, width : float
        Of the azimuth window [0.01 deg].
    low, high : int
        Least and largest range [2 mm], both included.
    """

    start: float
    width: float
    low: int
    high: int


def limits(gate: Gate) -> Limits:
    """A gate as the kernels want it."""
    start, width = gate.window_deg()
    low = max(1, int(np.ceil(gate.min_range_m / RANGE_LSB_M - 1e-6)))
    high = min(65535, int(np.floor(gate.max_range_m / RANGE_LSB_M + 1e-6)))
    return Limits(start * 100.0, width * 100.0, low, high)


def block_period_ns(packets: Packets) -> float | None:
    """Time from one block to the next, by the sensor's own azimuths and stamps: the fingerprint of a model.

    The rate of turn comes from whole packets, the step from the blocks inside them, so that lost packets, a limited field of view
    and dual return (two blocks of one azimuth) do no harm.

    Parameters
    ----------
    packets : ndarray of hdl32e.DATA_DTYPE, shape (n,)
        In the order of reception.

    Returns
    -------
    float or None
        Median [ns]; None where fewer than 8 pairs of packets can be used, as with a sensor that does not turn.
    """
    azimuth = packets["blocks"]["azimuth"].astype(np.int64)
    stamp_us = packets["stamp_us"].astype(np.int64)
    steps = np.diff(azimuth, axis=1)[:-1] % hdl32e.AZIMUTH_STEPS
    turned = np.diff(azimuth[:, 0]) % hdl32e.AZIMUTH_STEPS
    passed_us = np.diff(stamp_us) % hdl32e.STAMP_WRAP_US
    # of the 11 steps in a packet of dual return 6 are zero: there the middle of the others
    step = np.median(steps, axis=1)
    step = np.where(step > 0, step, np.quantile(steps, 0.75, axis=1))
    usable = (passed_us > 0) & (passed_us < _LONGEST_STEP_US) & (turned > 0) & (step > 0)
    if np.count_nonzero(usable) < _FEWEST:
        return None
    return float(np.median(step[usable] * passed_us[usable] / turned[usable])) * NS_PER_US


def period_fits(period_ns: float | None, block_ns: int) -> bool:
    """Whether a period found is a model's; one that was not found proves nothing."""
    return period_ns is None or abs(period_ns / block_ns - 1.0) < _PERIOD_TOLERANCE
