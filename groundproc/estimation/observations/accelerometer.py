"""Accelerometers as rows of the adjustment: the mean force about each knot, with bias, misalignment against the gyro, and place."""

from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.observations.rows import GRAVITY, Errors, Factor, H, RowBuilder, Unknowns, cross, eye
from groundproc.estimation.observations.unit import Unit
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]

NAMES: Final = ("accel_bias", "accel_turn", "lever")
PRIORS: Final[dict[str, float]] = {
    "lidar.accel_bias": 0.5, "lidar.accel_turn": np.deg2rad(0.5), "lidar.lever": 0.15,
    "ins.accel_bias": 0.5, "ins.accel_turn": np.deg2rad(0.5), "ins.lever": 0.05,
}  # fmt: skip
"""What is known before, one sigma: bias [m/s^2], misalignment against the gyro [rad], place against the nominal one [m]."""
_HAT: Final = np.concatenate([np.arange(STEPS) + 0.5, np.arange(STEPS)[::-1] + 0.5]) / STEPS
"""Weight of each grid step in the second difference of positions about a knot."""


def force_factor(unit: Unit, path: Path, unknowns: Unknowns) -> Factor:
    """Second differences of position over two slices against the force between: hat(t) (R f + g) integrated, free of velocities."""
    mats = frames.mat_from_quat(path.quat)
    middle = 0.5 * (mats[:-1] + mats[1:])
    turn = frames.mat_from_quat(frames.quat_exp((unit.values["turn"] + unit.values["accel_turn"])[None]))[0]
    force = (unit.force_m_s2 - unit.values["accel_bias"]) @ turn.T
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
    builder.by(row, "world.turn", np.tile(-cross(GRAVITY[None])[0], (len(good), 1, 1)))
    if f"{unit.name}.lever" in unknowns.names:
        at = mats[::STEPS]
        builder.by(row, f"{unit.name}.lever", (at[2:] - 2.0 * at[1:-1] + at[:-2])[good] / H**2)
    sigma = np.full(3 * len(good), unit.sigma_force_m_s2)
    return Factor(f"{unit.name} accelerometer", residual.ravel(), builder.matrix(), sigma, errors=Errors.LASTING)
