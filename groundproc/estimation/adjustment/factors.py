"""What everything but the lidar says, linear in the corrections of the path and in what is common to the whole flight.

Each kind of observation gives rows of one sparse matrix. Its unknowns are the spline's coefficients (six for each knot: rotation in the
body, position) and then the globals, by name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from flightlog import frames
from flightlog.constants import STANDARD_GRAVITY_M_S2
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path, integrated
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

H: Final = SLICE_NS * 1e-9
"""Seconds of a slice, which is the spacing of the knots."""
GRAVITY: Final = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
_AT_KNOT: Final = np.array([1.0, 4.0, 1.0]) / 6.0


@dataclass(slots=True)
class Unknowns:
    """Where each unknown stands in the vector, and what was known of it before.

    Attributes
    ----------
    intervals : int
    names : dict of str to slice
        Globals.
    sigma : dict of str to ndarray
        Prior sigmas of the globals.
    """

    intervals: int
    names: dict[str, slice] = field(default_factory=dict)
    sigma: dict[str, Array] = field(default_factory=dict)

    @property
    def path_size(self) -> int:
        """Unknowns of the path."""
        return (self.intervals + 3) * 6

    @property
    def size(self) -> int:
        """All unknowns."""
        return self.path_size + sum(len(s) for s in self.sigma.values())

    def add(self, name: str, sigma: Array) -> None:
        """Add a global with its prior sigma, shape (m,)."""
        start = self.size
        self.names[name], self.sigma[name] = slice(start, start + len(sigma)), sigma


class RowBuilder:
    """Collects blocks of a sparse matrix: rows of equal shape at once."""

    def __init__(self, rows: int, unknowns: Unknowns) -> None:
        self.rows, self.unknowns = rows, unknowns
        self._row: list[Ints] = []
        self._column: list[Ints] = []
        self._value: list[Array] = []

    def at_knots(self, row: Ints, knot: Ints, offset: int, block: Array) -> None:
        """Blocks, shape (n, 3, 3), by the spline's value at knots: of rotation (offset 0) or position (3); `row` is each first row."""
        for j in range(3):
            self._blocks(row, (knot + j) * 6 + offset, _AT_KNOT[j] * block)

    def at_times(self, row: Ints, knot: Ints, weights: Array, offset: int, block: Array) -> None:
        """The same at any times: intervals and the four weights, shape (n, 4)."""
        for j in range(4):
            self._blocks(row, (knot + j) * 6 + offset, weights[:, j, None, None] * block)

    def by(self, row: Ints, name: str, block: Array) -> None:
        """Blocks, shape (n, 3, m), by a global of m values."""
        self._blocks(row, np.full(len(row), self.unknowns.names[name].start), block)

    def _blocks(self, row: Ints, column: Ints, block: Array) -> None:
        _, tall, wide = block.shape
        self._row.append(np.broadcast_to(row[:, None, None] + np.arange(tall)[:, None], block.shape).ravel())
        self._column.append(np.broadcast_to(column[:, None, None] + np.arange(wide), block.shape).ravel())
        self._value.append(np.ascontiguousarray(block).ravel())

    def matrix(self) -> sparse.csr_matrix:
        """The matrix, shape (rows, unknowns)."""
        if not self._row:
            return sparse.csr_matrix((self.rows, self.unknowns.size))
        return sparse.csr_matrix(
            (np.concatenate(self._value), (np.concatenate(self._row), np.concatenate(self._column))),
            shape=(self.rows, self.unknowns.size),
        )


@dataclass(slots=True)
class Factor:
    """Observations of one kind: residual + matrix x should be noise of `sigma`.

    Attributes
    ----------
    name : str
    residual : ndarray, shape (m,)
    matrix : csr_matrix, shape (m, unknowns)
    sigma : ndarray, shape (m,)
    wide : bool
        Whether single rows touch much of the path: they are few, and kept out of the sparse normal matrix.
    """

    name: str
    residual: Array
    matrix: sparse.csr_matrix
    sigma: Array
    wide: bool = False

    def rms(self) -> float:
        """Root mean square of the residuals in sigmas."""
        return float(np.sqrt(np.mean(np.square(self.residual / self.sigma)))) if len(self.residual) else 0.0


def cross(vector: Array) -> Array:
    """Matrices [v]x of vectors, shape (n, 3, 3)."""
    x, y, z = vector.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def eye(count: int) -> Array:
    """So many unit matrices, shape (n, 3, 3)."""
    return np.tile(np.eye(3), (count, 1, 1))


def robust_sigma(residual: Array, least: float) -> float:
    """Standard deviation from the median absolute deviation."""
    return max(robust.sigma(residual, np.median(residual, axis=0)), least) if len(residual) else least


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
        bias [rad/s], scale, shear, turn [rad], delay [s], accel_bias [m/s^2], accel_turn [rad], lever [m], drift
        of the delay [s/s]: what has been taken off so far. The delay is that in the middle of the path.
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


RATE_STEPS: Final = 5


def knot_rates(path: Path) -> Array:
    """Body rates at the knots [rad/s], shape (intervals + 1, 3): means over `RATE_STEPS` grid steps to either side, over one at the ends.

    As much before a knot as behind it: a rate from before it goes along with the vibration in the turn that ends there, and a delay of
    0.1 to 0.6 ms came of it that was none.
    """
    knot = np.arange(0, len(path.quat), STEPS)
    around = np.full(len(knot), RATE_STEPS)
    around[[0, -1]] = 1
    first, last = np.maximum(knot - around, 0), np.minimum(knot + around, len(path.quat) - 1)
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(path.quat[first]), path.quat[last]))
    return np.asarray(turn / ((last - first) * STEP_NS * 1e-9)[:, None])


def turn_factor(unit: Unit, path: Path, unknowns: Unknowns) -> Factor:
    """Turns over each slice as the unit's gyro has them against those of the path."""
    rate = unit.true_rate()
    free = integrated(rate, np.array([1.0, 0.0, 0.0, 0.0]))[::STEPS]
    step = frames.quat_multiply(frames.quat_inverse(free[:-1]), free[1:])
    knots = path.quat[::STEPS]
    made = frames.quat_multiply(frames.quat_inverse(knots[:-1]), knots[1:])
    good = np.flatnonzero(unit.known.reshape(-1, STEPS).all(axis=1))
    residual = frames.quat_log(frames.quat_multiply(frames.quat_inverse(step), made))[good]
    back = np.swapaxes(frames.mat_from_quat(made[good]), 1, 2)
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
        x, y, z = turned.T
        none = np.zeros_like(x)
        builder.by(row, f"{name}.shear", np.stack([none, z, y, z, none, x, y, x, none], axis=1).reshape(-1, 3, 3))
    if f"{name}.turn" in unknowns.names:
        builder.by(row, f"{name}.turn", cross(turned))
    if f"{name}.delay" in unknowns.names:
        later = -np.diff(knot_rates(path), axis=0)
        since_middle_s = H * (np.arange(len(later)) + 0.5 - 0.5 * path.intervals)
        builder.by(row, f"{name}.delay", later[good, :, None])
        if f"{name}.drift" in unknowns.names:
            builder.by(row, f"{name}.drift", (since_middle_s[:, None] * later)[good, :, None])
    return Factor(f"{name} gyro", residual.ravel(), builder.matrix(), np.full(3 * len(good), unit.sigma_turn_rad))


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
    return Factor(
        f"{unit.name} accelerometer", residual.ravel(), builder.matrix(), np.full(3 * len(good), unit.sigma_force_m_s2)
    )


def whitened(
    name: str, residual: Array, matrix: sparse.csr_matrix, time_s: Array, sigma: Array, tau_s: Array, white: float
) -> Factor:
    """Observations whose errors are a Gauss-Markov process and a little white noise: differences that are nearly independent.

    Parameters
    ----------
    residual : ndarray, shape (n, m)
    matrix : csr_matrix, shape (n m, unknowns)
    time_s : ndarray, shape (n,)
    sigma : ndarray, shape (n, m)
        Of the process.
    tau_s : ndarray, shape (m,)
        Its time constants.
    white : float
        Sigma of the white part.
    """
    count, wide = residual.shape
    keep = np.exp(-np.diff(time_s)[:, None] / tau_s)
    now = np.arange(wide, count * wide)
    back = sparse.coo_matrix((keep.ravel(), (now, now - wide)), shape=(count * wide, count * wide))
    whiten = (sparse.identity(count * wide) - back).tocsr()
    deviation = np.empty((count, wide))
    deviation[0] = np.hypot(sigma[0], white)
    deviation[1:] = np.sqrt(sigma[1:] ** 2 * (1.0 - keep**2) + white**2 * (1.0 + keep**2))
    return Factor(name, whiten @ residual.ravel(), (whiten @ matrix).tocsr(), deviation.ravel())


def prior_factor(unknowns: Unknowns, values: dict[str, Array]) -> Factor:
    """What was known of the globals, and a weak hold on the path's corrections."""
    size = unknowns.size
    sigma, residual = np.empty(size), np.zeros(size)
    coefficients = sigma[: unknowns.path_size].reshape(-1, 6)
    coefficients[:, :3], coefficients[:, 3:] = np.deg2rad(10.0), 5.0
    for name, place in unknowns.names.items():
        sigma[place] = unknowns.sigma[name]
        residual[place] = values.get(name, np.zeros(place.stop - place.start))
    return Factor("prior", residual, sparse.identity(size, format="csr"), sigma)


def normal_equations(factors: Sequence[Factor]) -> tuple[sparse.csc_matrix, Array]:
    """Normal matrix of all factors but the wide ones, and half gradient of all."""
    size = factors[0].matrix.shape[1]
    total, gradient = sparse.csc_matrix((size, size)), np.zeros(size)
    for factor in factors:
        weighted = sparse.diags(1.0 / factor.sigma) @ factor.matrix
        if not factor.wide:
            total = total + (weighted.T @ weighted).tocsc()
        gradient += weighted.T @ (factor.residual / factor.sigma)
    return total, gradient
