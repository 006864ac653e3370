"""Attitude of a kit that states none, from gyros, accelerometers and positions over a whole piece of flight.

The gyros give the attitude up to two unknowns: the rotation at the start of the piece, and their bias. Turned by this
attitude, the accelerometers must agree with the acceleration of the positions, gravity included. Second differences of
positions are compared with the force weighted by a triangle, so that neither a velocity nor a starting point is
needed. Source: Wu and Pan, *Velocity/position integration formula*, IEEE Trans. AES 49 (2013), in its position form;
Wahba's problem by the singular value decomposition. The heading needs a flight that turns or speeds up.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from flightlog.errors import LogError

Array = npt.NDArray[np.float64]

ARM_S: Final = 4.0
"""From the middle of a second difference to its ends: at 1 m/s^2 16 m, against positions to a metre or so."""
PIECE_S: Final = 60.0
"""So long one start and one bias hold."""
LARGEST_BIAS: Final = np.deg2rad(1.0)
"""One sigma of a gyro's bias [rad/s], to hold what the flight does not show."""
LEAST_HEADING_MS2: Final = 0.1
"""RMS of the horizontal acceleration below which a heading means nothing."""


def align(
    time_s: Array, rate_rad_s: Array, force_m_s2: Array, fix_s: Array, fix_m: Array, sigma_m: float, gravity_m_s2: float
) -> Array:
    """Attitudes at an IMU's samples.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
    rate_rad_s, force_m_s2 : ndarray, shape (n, 3)
        In the ins frame.
    fix_s : ndarray, shape (f,)
    fix_m : ndarray, shape (f, 3)
        East, north, up.
    sigma_m : float
        Of a position.
    gravity_m_s2 : float

    Returns
    -------
    ndarray, shape (n, 4)
        "local from ins", w first.

    Raises
    ------
    LogError
        Too short, or a flight so even that it shows no heading.
    """
    span = time_s[-1] - time_s[0]
    pieces = max(1, round(span / PIECE_S))
    edges = np.searchsorted(time_s, time_s[0] + span * np.arange(1, pieces) / pieces)
    found = []
    for part in np.split(np.arange(len(time_s)), edges):
        here = (fix_s >= time_s[part[0]]) & (fix_s <= time_s[part[-1]])
        found.append(
            _piece(time_s[part], rate_rad_s[part], force_m_s2[part], fix_s[here], fix_m[here], sigma_m, gravity_m_s2)
        )
    return np.concatenate(found)


def _piece(
    time_s: Array, rate: Array, force: Array, fix_s: Array, fix_m: Array, sigma_m: float, gravity: float
) -> Array:
    middle_s = fix_s[(fix_s >= fix_s[0] + ARM_S) & (fix_s <= fix_s[-1] - ARM_S)] if len(fix_s) > 2 else fix_s[:0]
    if len(middle_s) < 6:
        raise LogError(
            f"positions: {len(fix_s)} within {time_s[-1] - time_s[0]:.0f} s of IMU samples, too few to find an attitude by"
        )
    ends = [
        np.stack([np.interp(middle_s + shift, fix_s, axis) for axis in fix_m.T], axis=1)
        for shift in (-ARM_S, 0.0, ARM_S)
    ]
    felt = ends[0] - 2.0 * ends[1] + ends[2] + np.array([0.0, 0.0, gravity * ARM_S**2])
    if np.sqrt(np.square(felt[:, :2]).sum(axis=1).mean()) < LEAST_HEADING_MS2 * ARM_S**2:
        raise LogError("positions: the flight is so even that IMU and positions do not show its heading")
    weights = _triangles(time_s, middle_s)

    def left(bias: Array) -> Array:
        mat, measured = _start(time_s, rate - bias, force, weights, felt)
        return np.concatenate([((felt - measured @ mat.T) / (2.5 * sigma_m)).ravel(), bias / LARGEST_BIAS])

    bias = least_squares(left, np.zeros(3), x_scale=1e-3, loss="soft_l1").x
    mat, _ = _start(time_s, rate - bias, force, weights, felt)
    turned = Rotation.from_matrix(mat) * _turned(time_s, rate - bias)
    return np.roll(turned.as_quat(), 1, axis=1)


def _triangles(time_s: Array, middle_s: Array) -> Array:
    """Weights [s^2] that make a second difference of a sampled acceleration, shape (k, n)."""
    height = np.maximum(ARM_S - np.abs(time_s - middle_s[:, None]), 0.0)
    return height * np.gradient(time_s)


def _start(time_s: Array, rate: Array, force: Array, weights: Array, felt: Array) -> tuple[Array, Array]:
    """The start's attitude, shape (3, 3), and what the accelerometers felt in its frame, shape (k, 3)."""
    measured = weights @ _turned(time_s, rate).apply(force)
    u, _, vt = np.linalg.svd(felt.T @ measured)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt, measured


def _turned(time_s: Array, rate: Array) -> Rotation:
    """Attitudes from that of the first sample."""
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time_s)[:, None]
    quat = np.concatenate([[[0.0, 0.0, 0.0, 1.0]], Rotation.from_rotvec(steps).as_quat()])
    # products of all before each, in log2(n) rounds
    reach = 1
    while reach < len(quat):
        quat[reach:] = (Rotation.from_quat(quat[:-reach]) * Rotation.from_quat(quat[reach:])).as_quat()
        reach *= 2
    return Rotation.from_quat(quat)
