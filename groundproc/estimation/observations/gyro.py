"""Gyros as rows of the adjustment: the turn over each slice, with bias, scale, cross-axis terms, misalignment and delay of the clock."""

from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.observations.rows import Errors, Factor, H, RowBuilder, Unknowns, cross, eye
from groundproc.estimation.observations.unit import Unit, shearing
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path, integrated

Array = npt.NDArray[np.float64]

NAMES: Final = ("bias", "scale", "shear", "turn")
PRIORS: Final[dict[str, float]] = {
    "lidar.bias": np.deg2rad(50.0), "lidar.scale": 0.01, "lidar.shear": 0.01, "lidar.turn": np.deg2rad(0.3),
    "ins.bias": np.deg2rad(5.0), "ins.scale": 0.015, "ins.shear": 0.01, "ins.turn": np.deg2rad(3.0),
}  # fmt: skip
"""What is known before, one sigma: bias [rad/s], scale, what an axis feels of the two others (scales of axes that lie askew in the
sensor's frame are of that kind), misalignment against the lidar's optics [rad]."""
RATE_STEPS: Final = 5


def knot_rates(path: Path) -> Array:
    """Body rates at the knots [rad/s], shape (intervals + 1, 3): means over `RATE_STEPS` grid steps to either side.

    At the ends, the mean is over one step. Elsewhere it must reach as far before a knot as behind it. A rate from
    before the knot correlates with the vibration in the turn that ends there, which produced false delays of 0.1 to
    0.6 ms.
    """
    knot = np.arange(0, len(path.quat), STEPS)
    around = np.full(len(knot), RATE_STEPS)
    around[[0, -1]] = 1
    first, last = np.maximum(knot - around, 0), np.minimum(knot + around, len(path.quat) - 1)
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(path.quat[first]), path.quat[last]))
    return np.asarray(turn / ((last - first) * STEP_NS * 1e-9)[:, None])


def turn_factor(unit: Unit, path: Path, unknowns: Unknowns, spin_rad: Array | None = None) -> Factor:
    """Turns over each slice as the unit's gyro has them against those of the path.

    `spin_rad`, shape (intervals + 1, 3), is what the path has at its knots and the gyro has not: the line of the spin.
    """
    rate = unit.true_rate()
    free = integrated(rate, np.array([1.0, 0.0, 0.0, 0.0]))[::STEPS]
    step = frames.quat_multiply(frames.quat_inverse(free[:-1]), free[1:])
    knots = path.quat[::STEPS]
    made = frames.quat_multiply(frames.quat_inverse(knots[:-1]), knots[1:])
    good = np.flatnonzero(unit.known.reshape(-1, STEPS).all(axis=1))
    residual = frames.quat_log(frames.quat_multiply(frames.quat_inverse(step), made))[good]
    back = np.swapaxes(frames.mat_from_quat(made[good]), 1, 2)
    if spin_rad is not None:
        residual -= spin_rad[good + 1] - np.einsum("nij,nj->ni", back, spin_rad[good])
    # scales act on the turn of the path: the unit's own has the noise of the very reading in it that it is to explain
    turned = frames.quat_log(made[good])
    builder = RowBuilder(3 * len(good), unknowns)
    row = 3 * np.arange(len(good))
    builder.at_knots(row, good + 1, 0, eye(len(good)))
    builder.at_knots(row, good, 0, -back)
    name = unit.name
    builder.by(row, f"{name}.bias", H * eye(len(good)))
    if f"{name}.scale" in unknowns.names:
        builder.by(row, f"{name}.scale", np.einsum("ni,ij->nij", turned, np.eye(3)))
    if f"{name}.shear" in unknowns.names:
        builder.by(row, f"{name}.shear", shearing(turned))
    if f"{name}.turn" in unknowns.names:
        builder.by(row, f"{name}.turn", cross(turned))
    if f"{name}.delay" in unknowns.names:
        later = -np.diff(knot_rates(path), axis=0)
        since_middle_s = H * (np.arange(len(later)) + 0.5 - 0.5 * path.intervals)
        builder.by(row, f"{name}.delay", later[good, :, None])
        if f"{name}.drift" in unknowns.names:
            builder.by(row, f"{name}.drift", (since_middle_s[:, None] * later)[good, :, None])
    sigma = np.full(3 * len(good), unit.sigma_turn_rad)
    return Factor(f"{name} gyro", residual.ravel(), builder.matrix(), sigma, errors=Errors.LASTING)
