"""What is measured, as rows of a linear system about a reference: few states each, one scalar each."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.inertial.kalman import Rows
from groundproc.estimation.inertial.model import (
    ATTITUDE,
    BARO,
    COMPASS,
    COURSE,
    FIX_AGE,
    FIX_POSITION,
    FIX_VELOCITY,
    HEADING,
    POSITION,
    TILT,
    VELOCITY,
    Model,
)
from groundproc.estimation.inertial.readings import Readings
from groundproc.flight.sync.tracks import low_pass

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

WIDTH: Final = 8
"""Most states in one row."""
KINDS: Final = (
    "fix position",
    "fix velocity",
    "tilt",
    "heading",
    "barometer",
    "standing",
    "course",
    "outside position",
    "outside velocity",
    "outside attitude",
)
COURSE_HZ: Final = 2.0
STANDING_HZ: Final = 5.0


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
class System:
    """Rows in the order of their nodes.

    Attributes
    ----------
    first : ndarray of int64, shape (nodes + 1,)
        First row of each node.
    count, index, value, measured, variance : ndarray
        Coefficients in use (m,), their states (m, WIDTH) and values (m, WIDTH), measured less reference (m,), variance of the noise (m,).
    kind : ndarray of int8, shape (m,)
        Number in KINDS.
    """

    first: npt.NDArray[np.int64]
    count: npt.NDArray[np.int64]
    index: npt.NDArray[np.int64]
    value: Array
    measured: Array
    variance: Array
    kind: npt.NDArray[np.int8]

    def rows(self) -> Rows:
        """As the filter takes them."""
        return Rows(self.first, self.count, self.index, self.value, self.measured, self.variance)


@dataclass(slots=True)
class _Rows:
    parts: list[tuple[Any, ...]] = field(default_factory=list)

    def add(self, kind: str, node: Any, columns: list[tuple[int, Any]], measured: Array, sigma: Any) -> None:
        """One row for each of `measured`; a column is a state and its coefficients."""
        rows = len(measured)
        index = np.zeros((rows, WIDTH), np.int64)
        value = np.zeros((rows, WIDTH))
        for place, (state, coefficients) in enumerate(columns):
            index[:, place], value[:, place] = state, coefficients
        variance = np.broadcast_to(np.square(np.asarray(sigma, np.float64)), (rows,))
        good = np.isfinite(measured)
        count = np.full(rows, len(columns))
        number = np.full(rows, KINDS.index(kind), np.int8)
        self.parts.append(tuple(a[good] for a in (node, count, index, value, measured, variance, number)))

    def system(self, nodes: int) -> System:
        """All rows in order."""
        node, count, index, value, measured, variance, kind = (
            np.concatenate(column) for column in zip(*self.parts, strict=True)
        )
        order = np.argsort(node, kind="stable")
        first = np.searchsorted(node[order], np.arange(nodes + 1)).astype(np.int64)
        return System(first, *(np.ascontiguousarray(a[order]) for a in (count, index, value, measured, variance, kind)))


def _cross(vector: Array) -> Array:
    """Matrices with which `a x vector` is `matrix @ a`... of vectors (n, 3), negated: (n, 3, 3) such that m @ a = a x vector."""
    x, y, z = vector.T
    zero = np.zeros(len(vector))
    return np.stack(
        [
            np.stack([zero, z, -y], axis=1),
            np.stack([-z, zero, x], axis=1),
            np.stack([y, -x, zero], axis=1),
        ],
        axis=1,
    )


@dataclass(frozen=True, slots=True)
class _Place:
    """The reference at times between nodes."""

    node: npt.NDArray[np.int64]
    late_s: Array
    position_m: Array
    velocity_m_s: Array
    quat: Array
    rate_rad_s: Array


class Builder:
    """Makes the rows of one set of readings about any reference."""

    def __init__(self, readings: Readings, stands: Mask, driving: bool) -> None:
        self._readings, self._stands, self._driving = readings, stands, driving
        self._lever = readings.lever_m

    def _at(self, time_s: Array, reference: Reference, rates: Array) -> tuple[_Place, Mask]:
        """The reference at times, and which of them lie within the nodes."""
        step_s = self._readings.step_ns * 1e-9
        nodes = len(self._readings.nodes_s)
        inside = (time_s >= 0.0) & (time_s <= self._readings.nodes_s[-1])
        time_s = time_s[inside]
        node = np.clip(np.rint(time_s / step_s).astype(np.int64), 0, nodes - 1)
        late = (time_s - self._readings.nodes_s[node])[:, None]
        rate = rates[np.minimum(node, nodes - 2)]
        velocity = reference.velocity_m_s[node]
        quat = frames.quat_multiply(reference.quat[node], frames.quat_exp(rate * late))
        return _Place(node, late[:, 0], reference.position_m[node] + velocity * late, velocity, quat, rate), inside

    def system(self, reference: Reference, rates: Array, model: Model) -> System:
        """Rows about a reference.

        Parameters
        ----------
        reference : Reference
        rates : ndarray, shape (n - 1, 3)
            Body rate of each step [rad/s].
        model : Model
        """
        rows = _Rows()
        self._fixes(rows, reference, rates, model)
        self._attitudes(rows, reference, rates, model)
        self._heights(rows, reference, rates, model)
        self._still(rows, reference, model)
        if self._driving:
            self._course(rows, reference, rates, model)
        self._outside(rows, reference, rates)
        return rows.system(len(self._readings.nodes_s))

    def _fixes(self, rows: _Rows, reference: Reference, rates: Array, model: Model) -> None:
        r = self._readings
        place, inside = self._at(r.fix_s, reference, rates)
        mat = frames.mat_from_quat(place.quat)
        arm = mat @ self._lever
        turned = _cross(arm)
        left = r.fix_m[inside] - place.position_m - arm
        for axis in range(3):
            columns = [(POSITION + axis, 1.0), (FIX_POSITION + axis, 1.0), (FIX_AGE, -place.velocity_m_s[:, axis])]
            if self._lever.any():
                columns += [(ATTITUDE + i, turned[:, axis, i]) for i in range(3)]
            rows.add("fix position", place.node, columns, left[:, axis], model.fix_noise_m)
        if r.fix_velocity_m_s is None:
            return
        swing = np.einsum("nij,nj->ni", mat, np.cross(place.rate_rad_s, self._lever))
        left = r.fix_velocity_m_s[inside] - place.velocity_m_s - swing
        step_s = r.step_ns * 1e-9
        gaining = np.gradient(low_pass(reference.velocity_m_s, 1.0, 1.0 / step_s), step_s, axis=0)[place.node]
        for axis in range(3):
            columns = [(VELOCITY + axis, 1.0), (FIX_VELOCITY + axis, 1.0), (FIX_AGE, -gaining[:, axis])]
            if (
                r.linked
            ):  # the error of a position's own velocity is how fast the position's error changes, its decay included
                columns.append((FIX_POSITION + axis, -1.0 / model.fix_tau_s))
            rows.add("fix velocity", place.node, columns, left[:, axis], model.fix_velocity_noise_m_s)

    def _attitudes(self, rows: _Rows, reference: Reference, rates: Array, model: Model) -> None:
        r = self._readings
        place, inside = self._at(r.attitude_s, reference, rates)
        left = frames.quat_log(frames.quat_multiply(r.quat[inside], frames.quat_inverse(place.quat)))
        heading, _, _ = frames.attitude_of(frames.mat_from_quat(place.quat))
        sine, cosine = np.sin(heading), np.cos(heading)
        for number, (east, north) in enumerate(((cosine, -sine), (sine, cosine))):
            tilted = [(ATTITUDE, east), (ATTITUDE + 1, north), (TILT + number, 1.0)]
            rows.add("tilt", place.node, tilted, left[:, 0] * east + left[:, 1] * north, model.tilt_noise_rad)
        curve: list[Any] = [np.ones(len(heading)), sine, cosine, np.sin(2 * heading), np.cos(2 * heading)]
        # headings count clockwise, rotations about the upward axis the other way
        columns: list[tuple[int, Any]] = [(ATTITUDE + 2, 1.0), (HEADING, -1.0)]
        columns += [(COMPASS + i, -np.asarray(term)) for i, term in enumerate(curve)]
        rows.add("heading", place.node, columns, left[:, 2], model.heading_noise_rad)

    def _heights(self, rows: _Rows, reference: Reference, rates: Array, model: Model) -> None:
        r = self._readings
        if not len(r.baro_s):
            return
        place, inside = self._at(r.baro_s, reference, rates)
        offset = np.median(r.baro_m) - np.median(reference.position_m[:, 2])
        left = r.baro_m[inside] - offset - place.position_m[:, 2]
        rows.add("barometer", place.node, [(POSITION + 2, 1.0), (BARO, 1.0)], left, model.baro_noise_m)

    def _still(self, rows: _Rows, reference: Reference, model: Model) -> None:
        every = max(round(1e9 / STANDING_HZ / self._readings.step_ns), 1)
        node = np.flatnonzero(self._stands)
        node = node[node % every == 0]
        for axis in range(3):
            left = -reference.velocity_m_s[node, axis]
            rows.add("standing", node, [(VELOCITY + axis, 1.0)], left, model.standing_m_s)

    def _course(self, rows: _Rows, reference: Reference, rates: Array, model: Model) -> None:
        r = self._readings
        every = max(round(1e9 / COURSE_HZ / r.step_ns), 1)
        node = np.arange(0, len(r.nodes_s) - 1, every)
        velocity = reference.velocity_m_s[node]
        turning = low_pass(rates, 0.5, 1e9 / r.step_ns)[node]
        # in a turn only the rear axle goes where the car points
        straight = (np.hypot(*velocity[:, :2].T) > 1.5) & (np.linalg.norm(turning, axis=1) < np.deg2rad(4.0))
        heading, _, _ = frames.attitude_of(frames.mat_from_quat(reference.quat[node]))
        right, ahead = np.stack([np.cos(heading), -np.sin(heading)]), np.stack([np.sin(heading), np.cos(heading)])
        sideways, speed = (right.T * velocity[:, :2]).sum(axis=1), (ahead.T * velocity[:, :2]).sum(axis=1)
        # a turn to the left by an angle lets the same velocity be more to the right
        columns = [(VELOCITY, right[0]), (VELOCITY + 1, right[1]), (ATTITUDE + 2, speed), (COURSE, speed)]
        # those of turns stay, and count for nothing: the rows are the same ones in every iteration
        rows.add("course", node, columns, -sideways, np.where(straight, model.sideways_m_s, 1e3))

    def _outside(self, rows: _Rows, reference: Reference, rates: Array) -> None:
        for fixes in self._readings.outside:
            time_s: Array = (fixes.time_ns - self._readings.start_ns).astype(np.float64) * 1e-9
            place, inside = self._at(time_s, reference, rates)
            mat = frames.mat_from_quat(place.quat)
            arm = mat @ fixes.lever_arm_m
            turned = _cross(arm)
            _whitened(
                rows,
                "outside position",
                place.node,
                fixes.covariance_m2[inside],
                fixes.position_m[inside] - place.position_m - arm,
                [(POSITION, None), (ATTITUDE, turned)],
            )
            if fixes.velocity_m_s is not None and fixes.velocity_covariance_m2_s2 is not None:
                swing = np.einsum("nij,nj->ni", mat, np.cross(place.rate_rad_s, fixes.lever_arm_m))
                left = fixes.velocity_m_s[inside] - place.velocity_m_s - swing
                covariance = fixes.velocity_covariance_m2_s2[inside]
                _whitened(rows, "outside velocity", place.node, covariance, left, [(VELOCITY, None)])
            if fixes.quat_local_ins_wxyz is not None and fixes.attitude_covariance_rad2 is not None:
                stated = fixes.quat_local_ins_wxyz[inside]
                left = frames.quat_log(frames.quat_multiply(stated, frames.quat_inverse(place.quat)))
                covariance = fixes.attitude_covariance_rad2[inside]
                _whitened(rows, "outside attitude", place.node, covariance, left, [(ATTITUDE, None)])


def _whitened(
    rows: _Rows,
    kind: str,
    node: npt.NDArray[np.int64],
    covariance: Array,
    left: Array,
    blocks: list[tuple[int, Array | None]],
) -> None:
    """Three rows for each of `left`, shape (n, 3), made independent and of unit noise; a block is a state and its matrices (None: one)."""
    known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(left).all(axis=1)
    white = np.linalg.inv(np.linalg.cholesky(covariance[known]))
    measured = np.einsum("nij,nj->ni", white, left[known])
    for axis in range(3):
        columns: list[tuple[int, Any]] = []
        for state, matrix in blocks:
            part = white[:, axis] if matrix is None else np.einsum("nj,njk->nk", white[:, axis], matrix[known])
            columns += [(state + i, part[:, i]) for i in range(3)]
        rows.add(kind, node[known], columns, measured[:, axis], 1.0)
