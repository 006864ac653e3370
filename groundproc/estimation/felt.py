"""Changes of velocity by an autopilot's accelerometers: a witness for positions and their velocities."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S, STANDARD_GRAVITY_M_S2
from groundproc.flight.autopilot import Boot

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

IMU_MESSAGES: Final = ("RAW_IMU", "SCALED_IMU", "HIGHRES_IMU")
LONGEST_GAP_S: Final = 0.3
"""Between two readings of forces or attitudes; beyond, the change of velocity is not known."""
UNKNOWN_M2_S2: Final = 1e6
FORCE_M_S2: Final = 0.2
"""What an acceleration is wrong by for seconds: a tilt that is one degree off, and a bias (1 sigma)."""


@dataclass(frozen=True, slots=True)
class Felt:
    """Velocities from forces, at the times asked for.

    Attributes
    ----------
    velocity_m_s : ndarray, shape (n, 3)
        East, north, up, less that at the first.
    unknown_m2_s2 : ndarray, shape (n,)
        Variance that silences of the sensors have added since the first.
    """

    velocity_m_s: Array
    unknown_m2_s2: Array


def autopilot_force(boot: Boot) -> tuple[str, Times, Array] | None:
    """Message, boot times [ns] and specific force in the ins frame [m/s^2] of an autopilot's accelerometers; None without any."""
    names = [name for name in IMU_MESSAGES if boot.has(name, 30)]
    if not names:
        return None
    name = max(names, key=lambda name: len(boot.tables[name]))
    table = boot.tables[name]
    unit = 1.0 if name == "HIGHRES_IMU" else 1e-3 * STANDARD_GRAVITY_M_S2
    frd = np.stack([table[f].astype(np.float64) for f in ("xacc", "yacc", "zacc")], axis=1) * unit
    if np.ptp(frd, axis=0).max() == 0.0:
        return None
    return name, boot.stamps_ns[name], np.asarray(frames.ins_from_frd(frd), np.float64)


def felt(time_ns: Times, force: tuple[Times, Array], attitude: tuple[Times, Array]) -> Felt | None:
    """Velocities from forces and the attitudes that the autopilot states; None where either comes too seldom.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (n,)
        Since boot.
    force : tuple of ndarray
        Times and specific force in the ins frame [m/s^2], shape (f,), (f, 3).
    attitude : tuple of ndarray
        Times and quaternions "local from ins", shape (a,), (a, 4).
    """
    (force_ns, force_m_s2), (attitude_ns, quat) = force, attitude
    if min(len(force_ns), len(attitude_ns)) < 2:
        return None
    if max(float(np.median(np.diff(each))) for each in (force_ns, attitude_ns)) > LONGEST_GAP_S * NS_PER_S:
        return None
    start_ns = int(time_ns[0])
    at, force_s, attitude_s = ((each - start_ns) / NS_PER_S for each in (time_ns, force_ns, attitude_ns))
    even = (
        quat
        * np.where(np.cumsum(np.concatenate([[0], (quat[1:] * quat[:-1]).sum(axis=1) < 0.0])) % 2, -1.0, 1.0)[:, None]
    )
    turned = np.stack([np.interp(force_s, attitude_s, part) for part in even.T], axis=1)
    mat = frames.mat_from_quat(turned / np.linalg.norm(turned, axis=1, keepdims=True))
    gained = np.einsum("nij,nj->ni", mat, force_m_s2) - np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
    passed = np.diff(force_s)
    velocity = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (gained[1:] + gained[:-1]) * passed[:, None], axis=0)])
    unknown = np.zeros(len(at))
    for times_s in (force_s, attitude_s):
        silent = np.flatnonzero(np.diff(times_s) > LONGEST_GAP_S)
        ends_s = np.sort(np.concatenate([times_s[silent], times_s[silent + 1]]))
        unknown += UNKNOWN_M2_S2 * np.searchsorted(ends_s, at)
        # before the first and after the last of them nothing is felt
        unknown += UNKNOWN_M2_S2 * np.cumsum((at < times_s[0]) | (at > times_s[-1]))
    return Felt(np.stack([np.interp(at, force_s, axis) for axis in velocity.T], axis=1), unknown)
