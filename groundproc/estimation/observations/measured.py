"""What an observation is to the smoother: scalar rows about a reference, each of few states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.method import Given
from groundproc.estimation.observations.states import Model
from groundproc.flight.positions.fixes import OutsideFixes
from groundproc.flight.timeline import Leg

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

WIDTH: Final = 9
"""Most states in one row."""


@dataclass(frozen=True, slots=True)
class Stated:
    """What autopilot and others state of one leg. Times are seconds since `start_ns`.

    Attributes
    ----------
    start_ns : int
        UTC of the first node.
    step_ns : int
    nodes_s : ndarray, shape (n,)
    fix_s, fix_m, fix_sigma_m : ndarray, shape (f,), (f, 3), (f, 3)
        Positions of the antenna.
    fix_velocity_m_s : ndarray, shape (f, 3), or None
        NaN where one is not known.
    linked : bool
        Velocities are those of the stated positions: both have the same error.
    attitude_s, quat : ndarray, shape (a,), (a, 4)
        As the autopilot has it.
    baro_s, baro_m : ndarray, shape (b,)
        Height by the standard atmosphere.
    lever_m : ndarray, shape (3,)
        The antenna in the ins frame.
    outside : sequence of OutsideFixes
    gravity_m_s2 : float
    dropped_fixes : int
        Left out because the receiver had no fix.
    """

    start_ns: int
    step_ns: int
    nodes_s: Array
    fix_s: Array
    fix_m: Array
    fix_sigma_m: Array
    fix_velocity_m_s: Array | None
    linked: bool
    attitude_s: Array
    quat: Array
    baro_s: Array
    baro_m: Array
    lever_m: Array
    outside: Sequence[OutsideFixes]
    gravity_m_s2: float
    dropped_fixes: int


@dataclass(frozen=True, slots=True)
class Heard:
    """What the observations of one leg are made from.

    Attributes
    ----------
    stated : Stated
    stands : ndarray of bool, shape (n,)
        At which nodes the vehicle stands.
    driving : bool
        It goes where it points.
    given : Given, optional
        The flight, for kinds that bring something of their own; None where only readings are at hand.
    leg : Leg, optional
    """

    stated: Stated
    stands: Mask
    driving: bool
    given: Given | None = None
    leg: Leg | None = None


@dataclass(frozen=True, slots=True)
class Learnt:
    """White noise that the residuals of a kind of row tell.

    Attributes
    ----------
    field : str
        Of `Model`.
    least, most : float
    """

    field: str
    least: float
    most: float


@dataclass(frozen=True, slots=True)
class Reference:
    """What is linearised about.

    Attributes
    ----------
    position_m, velocity_m_s, quat : ndarray, shape (n, 3), (n, 3), (n, 4)
    """

    position_m: Array
    velocity_m_s: Array
    quat: Array


@dataclass(frozen=True, slots=True)
class Place:
    """The reference at times between nodes.

    Attributes
    ----------
    node : ndarray of int64, shape (m,)
        The nearest.
    position_m, velocity_m_s, quat, rate_rad_s : ndarray, shape (m, 3), (m, 3), (m, 4), (m, 3)
        Rates in the body.
    """

    node: Ints
    position_m: Array
    velocity_m_s: Array
    quat: Array
    rate_rad_s: Array


class Rows:
    """Collects rows about a reference.

    Parameters
    ----------
    reference : Reference
    rates : ndarray, shape (n - 1, 3)
        Body rate of each step [rad/s].
    model : Model
    nodes_s : ndarray, shape (n,)
    step_ns : int
    """

    def __init__(self, reference: Reference, rates: Array, model: Model, nodes_s: Array, step_ns: int) -> None:
        self.reference, self.rates, self.model = reference, rates, model
        self.nodes_s, self.step_ns = nodes_s, step_ns
        self.kinds: list[str] = []
        self._parts: list[tuple[Any, ...]] = []

    def at(self, time_s: Array) -> tuple[Place, Mask]:
        """The reference at times, and which of them lie within the nodes."""
        nodes = len(self.nodes_s)
        inside = (time_s >= 0.0) & (time_s <= self.nodes_s[-1])
        time_s = time_s[inside]
        node = np.clip(np.rint(time_s / (self.step_ns * 1e-9)).astype(np.int64), 0, nodes - 1)
        late = (time_s - self.nodes_s[node])[:, None]
        rate = self.rates[np.minimum(node, nodes - 2)]
        velocity = self.reference.velocity_m_s[node]
        quat = frames.quat_multiply(self.reference.quat[node], frames.quat_exp(rate * late))
        return Place(node, self.reference.position_m[node] + velocity * late, velocity, quat, rate), inside

    def add(self, kind: str, node: Any, columns: list[tuple[int, Any]], measured: Array, sigma: Any) -> None:
        """One row for each of `measured`, shape (m,): measured less reference; a column is a state and its coefficients."""
        rows = len(measured)
        index = np.zeros((rows, WIDTH), np.int64)
        value = np.zeros((rows, WIDTH))
        for place, (state, coefficients) in enumerate(columns):
            index[:, place], value[:, place] = state, coefficients
        variance = np.broadcast_to(np.square(np.asarray(sigma, np.float64)), (rows,))
        good = np.isfinite(measured)
        count = np.full(rows, len(columns))
        if kind not in self.kinds:
            self.kinds.append(kind)
        number = np.full(rows, self.kinds.index(kind), np.int8)
        self._parts.append(tuple(a[good] for a in (node, count, index, value, measured, variance, number)))

    def add_whitened(
        self, kind: str, node: Ints, covariance: Array, left: Array, blocks: list[tuple[int, Array | None]]
    ) -> None:
        """As many rows as `left`, shape (m, k), has values, made independent and of unit noise.

        A block is a state and its matrices, shape (m, k, 3); None: they are one. Where the covariance is not known there is no row.
        """
        known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(left).all(axis=1)
        white = np.linalg.inv(np.linalg.cholesky(covariance[known]))
        measured = np.einsum("nij,nj->ni", white, left[known])
        for axis in range(left.shape[1]):
            columns: list[tuple[int, Any]] = []
            for state, matrix in blocks:
                part = white[:, axis] if matrix is None else np.einsum("nj,njk->nk", white[:, axis], matrix[known])
                columns += [(state + i, part[:, i]) for i in range(3)]
            self.add(kind, node[known], columns, measured[:, axis], 1.0)

    def system(self) -> "System":
        """All rows in order."""
        node, count, index, value, measured, variance, kind = (
            np.concatenate(column) for column in zip(*self._parts, strict=True)
        )
        order = np.argsort(node, kind="stable")
        first = np.searchsorted(node[order], np.arange(len(self.nodes_s) + 1)).astype(np.int64)
        count, index, value, measured, variance, kind = (
            np.ascontiguousarray(a[order]) for a in (count, index, value, measured, variance, kind)
        )
        return System(first, count, index, value, measured, variance, kind, tuple(self.kinds))


@dataclass(frozen=True, slots=True)
class System:
    """Rows in the order of their nodes.

    Attributes
    ----------
    first : ndarray of int64, shape (nodes + 1,)
        First row of each node.
    count, index, value, measured, variance : ndarray
        Coefficients in use (m,), their states (m, WIDTH) and values (m, WIDTH), measured less reference (m,), variance of the noise (m,).
    kind : ndarray of int8, shape (m,)
        Number in `kinds`.
    kinds : tuple of str
    """

    first: Ints
    count: Ints
    index: Ints
    value: Array
    measured: Array
    variance: Array
    kind: npt.NDArray[np.int8]
    kinds: tuple[str, ...]

    def of(self, kind: str) -> Mask:
        """Which rows are of a kind, shape (m,)."""
        return np.asarray(self.kind == self.kinds.index(kind)) if kind in self.kinds else np.zeros(len(self.kind), bool)


class Measured(Protocol):
    """One source of knowledge about the states.

    Attributes
    ----------
    learnt : mapping of str to Learnt
        By the kind of row: noise that its residuals tell.
    """

    learnt: Mapping[str, Learnt]

    def rows(self, rows: Rows) -> None:
        """Add its rows, linear about the reference of `rows`."""
        ...


def turned_by(vector: Array) -> Array:
    """What vectors, shape (n, 3), change by with a small rotation a: matrices m with m @ a = a x vector, shape (n, 3, 3)."""
    x, y, z = vector.T
    zero = np.zeros(len(vector))
    return np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
