"""Which lidar a recording is of, where the product byte does not say: a VLP-16 prototype calls itself 0x21 too.

The proof is in the timing: a block of an HDL-32E is one firing, 46.08 us; one of a VLP-16 holds two of 55.296 us, 110.592 us
(HDL-32E manual 63-9113 p. 9, VLP-16 manual 63-9243).
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_US
from flightlog.errors import WrongSensorError
from flightlog.hdl32e import AZIMUTH_STEPS, FIRING_NS, STAMP_WRAP_US

VLP16_BLOCK_NS: Final = 110_592
_FEWEST: Final = 8
"""Pairs of neighbouring packets that make a proof."""
_LONGEST_STEP_US: Final = 20_000
"""Between neighbouring packets; longer, and the sensor may have turned once more in between."""


def block_period_ns(packets: npt.NDArray[np.void]) -> float | None:
    """Time from one firing's block to the next, by the sensor's own azimuths and stamps.

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
    steps = np.diff(azimuth, axis=1)[:-1] % AZIMUTH_STEPS
    turned = np.diff(azimuth[:, 0]) % AZIMUTH_STEPS
    passed_us = np.diff(stamp_us) % STAMP_WRAP_US
    # of the 11 steps in a packet of dual return 6 are zero: there the middle of the others
    step = np.median(steps, axis=1)
    step = np.where(step > 0, step, np.quantile(steps, 0.75, axis=1))
    usable = (passed_us > 0) & (passed_us < _LONGEST_STEP_US) & (turned > 0) & (step > 0)
    if np.count_nonzero(usable) < _FEWEST:
        return None
    return float(np.median(step[usable] * passed_us[usable] / turned[usable])) * NS_PER_US


def refuse_other_models(packets: npt.NDArray[np.void], place: str) -> None:
    """Refuse a sensor whose firings are not those of an HDL-32E, whatever its product byte says.

    Parameters
    ----------
    packets : ndarray of hdl32e.DATA_DTYPE, shape (n,)
        A few dozen, in the order of reception.
    place : str
        Name of the recording, for the error.

    Raises
    ------
    WrongSensorError
        The blocks follow each other as those of a VLP-16 do, or as those of no sensor known.
    """
    period_ns = block_period_ns(packets)
    if period_ns is None or abs(period_ns / FIRING_NS - 1.0) < 0.25:
        return
    name = "a VLP-16" if abs(period_ns / VLP16_BLOCK_NS - 1.0) < 0.25 else "no sensor known here"
    raise WrongSensorError(
        f"{place}: its blocks are {period_ns / NS_PER_US:.1f} us apart, which is {name}; "
        f"an HDL-32E ({FIRING_NS / NS_PER_US:.2f} us) is needed"
    )
