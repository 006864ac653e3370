"""An inertial unit on the grid of a path, with what has been found of its clock and its axes so far."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.errors import CoverageError
from groundproc.estimation.observations.rows import H
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.motion import ImuTrack, near, on_grid
from groundproc.estimation.odometry.spline import Path
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]

LEAST_TURN: Final = 0.4
"""Of what a gyro's samples scatter: its noise is not taken to be below that. Most of the scatter is vibration, which it follows."""
LEAST_FORCE: Final = 1.0
"""The same of an accelerometer. What shakes it is over between two samples, and as bad as noise. Residuals do not
reveal it: the lidar knows a slice's place to a centimetre, which over a tenth of a second is some m/s^2, so the path
follows the accelerometer and not the lidar."""
FEWEST_HELD: Final = 30
"""Slices that the lidar has to hold for residuals to tell a unit's noise: three seconds."""


@dataclass(slots=True)
class Unit:
    """An inertial unit with what is estimated of it; its rates and forces are on the path's grid.

    Attributes
    ----------
    name : str
        Prefix of its globals.
    rate_rad_s, force_m_s2 : ndarray, shape (n STEPS, 3)
        As measured, in the sensor frame by the nominal mount.
    known, force_known : ndarray of bool, shape (n STEPS,)
    values : dict of str to ndarray
        bias [rad/s], scale, shear, turn [rad], delay [s], accel_bias [m/s^2], accel_scale, accel_shear, accel_turn [rad],
        lever [m], drift of the delay [s/s]: what has been taken off so far. The delay is that in the middle of the path.
    sigma_turn_rad, sigma_force_m_s2 : float
        Noise of an increment over a slice; of the mean force about a knot.
    """

    name: str
    rate_rad_s: Array
    force_m_s2: Array
    known: npt.NDArray[np.bool_]
    force_known: npt.NDArray[np.bool_]
    values: dict[str, Array]
    sigma_turn_rad: float
    sigma_force_m_s2: float

    def true_rate(self) -> Array:
        """Rates with bias, scale and misalignment taken off; the delay is in the grid already."""
        gain = np.diag(1.0 + self.values["scale"]) + sheared(self.values["shear"])
        rate = (self.rate_rad_s - self.values["bias"]) @ np.linalg.inv(gain)
        return np.asarray(rate @ frames.mat_from_quat(frames.quat_exp(self.values["turn"][None]))[0].T)


def sheared(shear: Array) -> Array:
    """Symmetric matrix, shape (3, 3), of what a sensor feels of the two other axes: yz, zx, xy."""
    yz, zx, xy = shear
    return np.array([[0.0, xy, zx], [xy, 0.0, yz], [zx, yz, 0.0]])


def shearing(values: Array) -> Array:
    """What the three numbers of `sheared` do to vectors: matrices, shape (n, 3, 3), for values of shape (n, 3)."""
    x, y, z = values.T
    none = np.zeros_like(x)
    return np.stack([none, z, y, z, none, x, y, x, none], axis=1).reshape(-1, 3, 3)


def place_on_grid(unit: Unit, track: ImuTrack, path: Path) -> None:
    """Rates and forces of a unit on the path's grid, with its delay and what that drifts by taken off the stamps.

    Raises
    ------
    CoverageError
        With them its samples would not follow each other.
    """
    steps = path.intervals * STEPS
    some = near(track.time_ns, path.start_ns, steps)
    stamps_ns, rate, force = track.time_ns[some], track.rate_rad_s[some], track.force_m_s2[some]
    since_middle_ns = stamps_ns - (path.start_ns + steps * STEP_NS // 2)
    late_ns = 1e9 * float(unit.values["delay"][0]) + float(unit.values["drift"][0]) * since_middle_ns
    time_ns = stamps_ns - np.rint(late_ns).astype(np.int64)
    if not (np.diff(time_ns) > 0).all():
        drift = float(unit.values["drift"][0])
        raise CoverageError(
            f"{unit.name}: a drift of its clock by {drift:.2g} s in a second came out of the adjustment, which cannot be; is the flight "
            "long enough, and do positions and poses given beside it belong to it?"
        )
    unit.rate_rad_s, unit.known = on_grid(time_ns, rate, path.start_ns, steps)
    unit.force_m_s2, unit.force_known = on_grid(time_ns, np.nan_to_num(force), path.start_ns, steps)
    if not np.isfinite(force).all():
        unit.force_known[:] = False


def make_unit(name: str, track: ImuTrack, path: Path, bias: Array, lever: Array) -> Unit:
    """A unit with nothing estimated yet but its gyro's bias."""
    values = {
        "bias": bias.copy(), "scale": np.zeros(3), "shear": np.zeros(3), "turn": np.zeros(3), "delay": np.zeros(1),
        "drift": np.zeros(1), "accel_bias": np.zeros(3), "accel_scale": np.zeros(3), "accel_shear": np.zeros(3),
        "accel_turn": np.zeros(3), "lever": lever.copy(),
    }  # fmt: skip
    none = np.zeros((0, 3))
    unit = Unit(
        name, none, none, np.zeros(0, np.bool_), np.zeros(0, np.bool_), values, track.rate_density() * np.sqrt(H),
        track.force_density() * np.sqrt(2.0 / 3.0 / H),
    )  # fmt: skip
    place_on_grid(unit, track, path)
    return unit


def learnt_sigma(residual: Array, held: npt.NDArray[np.bool_], scatter: float, least: float) -> float:
    """Noise of a unit by its residuals where the lidar holds the path, from the median absolute deviation.

    Where nothing else holds the path, it is the unit's own and leaves no residuals.

    Parameters
    ----------
    residual : ndarray, shape (n, 3)
    held : ndarray of bool, shape (n,)
    scatter : float
        What the unit's samples scatter, vibration included: what goes where too few residuals are held.
    least : float
        Share of it that the noise is not below.
    """
    rows = residual[held]
    if len(rows) < FEWEST_HELD:
        return scatter
    return max(robust.sigma(rows, np.median(rows, axis=0)), least * scatter)
