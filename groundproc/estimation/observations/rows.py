"""Rows of the adjustment: observations linear in the corrections of the path and in what is common to the whole flight.

Each observation gives rows of one sparse matrix. The unknowns are the spline's coefficients (six for each knot: rotation in the body,
position) and then the globals, by name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from flightlog import frames
from flightlog.constants import STANDARD_GRAVITY_M_S2
from groundproc.estimation.odometry.grid import SLICE_NS

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

H: Final = SLICE_NS * 1e-9
"""Seconds of a slice, which is the spacing of the knots."""
GRAVITY: Final = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
"""Local frame, east, north, up [m/s^2]."""
_AT_KNOT: Final = np.array([1.0, 4.0, 1.0]) / 6.0


@dataclass(slots=True)
class Unknowns:
    """Where each unknown stands in the vector, what it is so far, and what was known of it before.

    Attributes
    ----------
    intervals : int
    names : dict of str to slice
        Globals.
    sigma : dict of str to ndarray
        Prior sigmas of the globals.
    value, expected : dict of str to ndarray
        What the globals are so far, and the mean of their prior.
    unit : dict of str to str
        Unit of each global in reports, as it ends a name: "m", "deg_s"; radians are told as degrees.
    """

    intervals: int
    names: dict[str, slice] = field(default_factory=dict)
    sigma: dict[str, Array] = field(default_factory=dict)
    value: dict[str, Array] = field(default_factory=dict)
    expected: dict[str, Array] = field(default_factory=dict)
    unit: dict[str, str] = field(default_factory=dict)

    @property
    def path_size(self) -> int:
        """Unknowns of the path."""
        return (self.intervals + 3) * 6

    @property
    def size(self) -> int:
        """All unknowns."""
        return self.path_size + sum(len(s) for s in self.sigma.values())

    def add(
        self, name: str, sigma: Array, value: Array | None = None, expected: Array | None = None, unit: str = ""
    ) -> None:
        """Add a global.

        Parameters
        ----------
        name : str
        sigma : ndarray, shape (m,)
            Of what was known before.
        value, expected : ndarray, shape (m,), optional
            What it is so far, and the mean of what was known before; zero where nothing else is said.
        unit : str
        """
        start = self.size
        self.names[name], self.sigma[name] = slice(start, start + len(sigma)), sigma
        self.value[name] = np.zeros(len(sigma)) if value is None else value
        self.expected[name] = np.zeros(len(sigma)) if expected is None else expected
        self.unit[name] = unit


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


class Errors(Enum):
    """How the errors of rows go together: their weights are those of independent rows, the solution's sigmas are not."""

    OWN = "own"
    """Independent, and of the size that is stated."""
    LASTING = "lasting"
    """Some last for seconds: what the model of an instrument lacks. Their size is that of the residuals."""
    ANCHOR = "anchor"
    """Independent after whitening, of rows that say where the whole lies."""


@dataclass(frozen=True, slots=True)
class Carrying:
    """Marks the rows of the gyro that carries the motion between knots: its noise is in the path there, not only in its rows.

    Attributes
    ----------
    interval : ndarray of int64, shape (n,)
        Of each three rows.
    walk_rad : float
        Noise of its turn over a grid step.
    """

    interval: Ints
    walk_rad: float


@dataclass(slots=True)
class Factor:
    """Rows of one kind: residual + matrix x should be noise of `sigma`.

    Attributes
    ----------
    name : str
    residual : ndarray, shape (m,)
    matrix : csr_matrix, shape (m, unknowns)
    sigma : ndarray, shape (m,)
    wide : bool
        Whether single rows touch much of the path: they are few, and kept out of the sparse normal matrix.
    errors : Errors
    carrying : Carrying, optional
    source : str
        Whose errors these are, where residuals judge how large they are stated: rows are three to a second, east, north, up.
    course : bool
        Whether rows are the whitened changes of such errors.
    weakened : float
        How many times larger than stated, east and north, the rows of a course take errors to be already.
    """

    name: str
    residual: Array
    matrix: sparse.csr_matrix
    sigma: Array
    wide: bool = False
    errors: Errors = Errors.OWN
    carrying: Carrying | None = None
    source: str = ""
    course: bool = False
    weakened: float = 1.0

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


def turned(vector: Array) -> Array:
    """Matrix of a rotation vector, shape (3, 3)."""
    return np.asarray(frames.mat_from_quat(frames.quat_exp(vector[None]))[0])


def whitened(
    name: str, residual: Array, matrix: sparse.csr_matrix, time_s: Array, sigma: Array, tau_s: Array, white: float,
    errors: Errors = Errors.OWN,
) -> Factor:  # fmt: skip
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
    return Factor(name, whiten @ residual.ravel(), (whiten @ matrix).tocsr(), deviation.ravel(), errors=errors)


PRIOR: Final = "prior"
HOLD_M: Final = 100.0
"""Of each coefficient of the path's position, one sigma: so weak that a bend which fixes alone know, over some hundred coefficients, is
theirs to tell in one step; firm enough for what moves the whole to stay in the turn and the shift of the whole."""
ENDS: Final = 3
END_M: Final = 5.0
"""Of so many coefficients at each end: values at the knots leave a ripple open there, and where the lidar does too nothing else ends it."""


def prior_factor(unknowns: Unknowns) -> Factor:
    """What was known of the globals, and a weak hold on the path's corrections."""
    size = unknowns.size
    sigma, residual = np.empty(size), np.zeros(size)
    coefficients = sigma[: unknowns.path_size].reshape(-1, 6)
    coefficients[:, :3], coefficients[:, 3:] = np.deg2rad(10.0), HOLD_M
    coefficients[:ENDS, 3:] = coefficients[-ENDS:, 3:] = END_M
    for name, place in unknowns.names.items():
        sigma[place] = unknowns.sigma[name]
        residual[place] = unknowns.value[name] - unknowns.expected[name]
    return Factor(PRIOR, residual, sparse.identity(size, format="csr"), sigma)


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
