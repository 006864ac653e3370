"""Accelerometers as rows of the adjustment: the mean force about each knot, with place, bias, scale, cross-axis terms, misalignment."""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from flightlog import frames
from groundproc.estimation.observations.rows import GRAVITY, Errors, Factor, H, RowBuilder, Unknowns, cross, eye
from groundproc.estimation.observations.unit import Unit, sheared, shearing
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

NAMES: Final = ("accel_bias", "accel_scale", "accel_shear", "accel_turn", "lever")
PRIORS: Final[dict[str, float]] = {
    "lidar.accel_bias": 0.5, "lidar.accel_scale": 0.015, "lidar.accel_shear": np.deg2rad(0.5), "lidar.accel_turn": np.deg2rad(0.5),
    "lidar.lever": 0.15,
    "ins.accel_bias": 0.15, "ins.accel_scale": 0.015, "ins.accel_shear": np.deg2rad(0.5), "ins.accel_turn": np.deg2rad(0.5),
    "ins.lever": 0.05,
}  # fmt: skip
"""What is known before, one sigma: bias [m/s^2], scale, what an axis feels of the two others, misalignment against the gyro [rad], place
against the nominal one [m]. MEMS as sold are within 3 % and 2 % across, and half of that and less once calibrated on six sides."""
STEADY_KNOTS: Final = 5.0
"""Scale and cross-axis terms act on the reading's Gaussian mean of so many knots, one sigma: of the reading itself they would explain the
noise that is in it, and come out too large."""
_HAT: Final = np.concatenate([np.arange(STEPS) + 0.5, np.arange(STEPS)[::-1] + 0.5]) / STEPS
"""Weight of each grid step in the second difference of positions about a knot."""


def steady_force(force_m_s2: Array) -> Array:
    """Mean force of each slice, smoothed, shape (slices, 3)."""
    return np.asarray(
        gaussian_filter1d(force_m_s2.reshape(-1, STEPS, 3).mean(axis=1), STEADY_KNOTS, axis=0, mode="nearest")
    )


def _add_scales(builder: RowBuilder, row: Ints, name: str, mat_local_unit: Array, force_m_s2: Array) -> None:
    """Columns of scale and cross-axis terms, which act on the axes of the unit."""
    if f"{name}.accel_scale" in builder.unknowns.names:
        builder.by(row, f"{name}.accel_scale", mat_local_unit * force_m_s2[:, None, :])
    if f"{name}.accel_shear" in builder.unknowns.names:
        builder.by(row, f"{name}.accel_shear", mat_local_unit @ shearing(force_m_s2))


def force_factor(unit: Unit, path: Path, unknowns: Unknowns) -> Factor:
    """Second differences of position over two slices against the force between: hat(t) (R f + g) integrated, free of velocities."""
    mats = frames.mat_from_quat(path.quat)
    middle = 0.5 * (mats[:-1] + mats[1:])
    turn = frames.mat_from_quat(frames.quat_exp((unit.values["turn"] + unit.values["accel_turn"])[None]))[0]
    gain = np.diag(1.0 + unit.values["accel_scale"]) + sheared(unit.values["accel_shear"])
    own = (unit.force_m_s2 - unit.values["accel_bias"]) @ np.linalg.inv(gain)
    force = own @ turn.T
    felt = np.einsum("nij,nj->ni", middle, force).reshape(-1, STEPS, 3)
    rising, falling = _HAT[:STEPS], _HAT[STEPS:]
    up, down = np.einsum("k,nkj->nj", rising, felt), np.einsum("k,nkj->nj", falling, felt)
    dt = STEP_NS * 1e-9
    lever = unit.values["lever"]
    position = path.position_m[::STEPS] + mats[::STEPS] @ lever
    second = position[2:] - 2.0 * position[1:-1] + position[:-2]
    # knots 1 to n - 1
    made = dt * H * (up[:-1] + down[1:]) + H * H * GRAVITY
    whole: npt.NDArray[np.bool_] = np.asarray(unit.force_known.reshape(-1, STEPS).all(axis=1))
    good = np.flatnonzero(whole[:-1] & whole[1:])
    knot = good + 1
    residual = (second - made)[good] / H**2
    mean_mat = mats[knot * STEPS]
    around = force.reshape(-1, STEPS, 3).mean(axis=1)
    mean_force = 0.5 * (around[good] + around[good + 1])
    builder = RowBuilder(3 * len(good), unknowns)
    row = 3 * np.arange(len(good))
    unit_mat = eye(len(good)) / H**2
    builder.at_knots(row, knot - 1, 3, unit_mat)
    builder.at_knots(row, knot, 3, -2.0 * unit_mat)
    builder.at_knots(row, knot + 1, 3, unit_mat)
    builder.at_knots(row, knot, 0, mean_mat @ cross(mean_force))
    builder.by(row, f"{unit.name}.accel_bias", mean_mat)
    for name in ("turn", "accel_turn"):
        builder.by(row, f"{unit.name}.{name}", mean_mat @ cross(mean_force))
    _add_scales(builder, row, unit.name, mean_mat @ turn, steady_force(own)[knot])
    builder.by(row, "world.turn", np.tile(-cross(GRAVITY[None])[0], (len(good), 1, 1)))
    if f"{unit.name}.lever" in unknowns.names:
        at = mats[::STEPS]
        builder.by(row, f"{unit.name}.lever", (at[2:] - 2.0 * at[1:-1] + at[:-2])[good] / H**2)
    sigma = np.full(3 * len(good), unit.sigma_force_m_s2)
    return Factor(f"{unit.name} accelerometer", residual.ravel(), builder.matrix(), sigma, errors=Errors.LASTING)
