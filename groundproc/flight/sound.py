"""Which messages of an autopilot hold values that can be: the door through which its numbers come into everything else.

A float of a message may be any 32 bits: no number, infinite, or 1e30 after a fault of memory; a place may be none on Earth. Such a message
is left out whole and counted, so that nothing behind this door need ask again.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

_TURN: Final = 2.0 * np.pi + 0.01
RATE_RAD_S: Final = 200.0
"""Gyros of autopilots measure a fifth of this."""
FORCE_M_S2: Final = 5_000.0
_DEG_E7: Final = {"lat": 90e7, "lon": 180e7}
_HEIGHT_MM: Final = 1e8
_LATEST_US: Final = 4_102_444_800e6
"""The year 2100."""
_UNIT: Final = 0.1
"""A quaternion's length may be off 1 by this."""

_ATTITUDE: Final = dict.fromkeys(("roll", "pitch", "yaw"), _TURN)
_RATES: Final = dict.fromkeys(("rollspeed", "pitchspeed", "yawspeed"), RATE_RAD_S)
LARGEST: Final[Mapping[str, Mapping[str, float]]] = {
    "ATTITUDE": _ATTITUDE | _RATES,
    "ATTITUDE_QUATERNION": _RATES,
    "AHRS2": _ATTITUDE,
    "HIGHRES_IMU": dict.fromkeys(("xgyro", "ygyro", "zgyro"), RATE_RAD_S)
    | dict.fromkeys(("xacc", "yacc", "zacc"), FORCE_M_S2),
    "GLOBAL_POSITION_INT": _DEG_E7 | dict.fromkeys(("alt", "relative_alt"), _HEIGHT_MM),
    "GPS_RAW_INT": _DEG_E7 | dict.fromkeys(("alt", "alt_ellipsoid"), _HEIGHT_MM),
    "SCALED_PRESSURE": {"press_abs": 2_000.0},
    "SYSTEM_TIME": {"time_unix_usec": _LATEST_US},
}
"""Magnitudes that fields of a message cannot exceed, in its own units; only fields that are used."""


def possible(table: npt.NDArray[np.void], name: str) -> npt.NDArray[np.bool_]:
    """Which messages hold values that can be, shape (n,).

    Parameters
    ----------
    table : structured ndarray, shape (n,)
        Messages of one kind with their fields, as `mavlink.table` gives them.
    name : str
        Of the message.
    """
    good = np.ones(len(table), np.bool_)
    for field, most in LARGEST.get(name, {}).items():
        if field not in (table.dtype.names or ()):  # boards' own logs do not have all
            continue
        # compared as floats: the least whole number has no positive counterpart
        good &= np.abs(table[field].astype(np.float64)) <= most
    if name == "ATTITUDE_QUATERNION":
        parts = np.stack([table[field].astype(np.float64) for field in ("q1", "q2", "q3", "q4")])
        with np.errstate(over="ignore"):
            good &= np.abs(np.sqrt(np.square(parts).sum(axis=0)) - 1.0) <= _UNIT
    return good
