"""Lidar-inertial odometry: slice after slice against the planes of those before, an iterated error-state filter.

After Xu, Cai, He, Lin, Zhang, "FAST-LIO2" (2022), in its idea: inertial propagation, every return moved to the slice's end by it, and the
state corrected by distances to planes until it stands still. The measurements here are clusters, not returns.

State, and error state of 18: attitude (in the body), position, velocity, bias of the gyro, bias of the accelerometer, gravity.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.constants import STANDARD_GRAVITY_M_S2
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.motion import MotionGrid
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE, Clusterer, Slice
from groundproc.estimation.odometry.voxels import COUNT, FLATNESS, LEVEL, MEAN, NORMAL, SCATTER, TILT, PlaneMap, find
from groundproc.numerics.rotations import mat_of_quat, quat_difference, quat_turned, unit_vector
from groundproc.numerics.voxelhash import voxel_key

Array = npt.NDArray[np.float64]

STATES: Final = 18
STEP_S: Final = STEP_NS * 1e-9
ROTATION, POSITION, VELOCITY, GYRO, ACCEL, GRAVITY = (slice(3 * i, 3 * i + 3) for i in range(6))

RANGE_SIGMA_M: Final = 0.02
"""Noise of a return of the HDL-32E (its data sheet)."""
SURFACE_SIGMA_M: Final = 0.015
"""What real surfaces differ from the plane of their voxel, one sigma of a cluster."""
INFLATION: Final = 4.0
"""Neighbouring clusters share their errors: so much is taken off their information."""
GROUND: Final = 0.966
"""Cosine of the steepest slope of what counts as ground: 15 deg."""
GROUND_MEMORY: Final = 0.99
"""What is kept of the sum of the ground's normals from slice to slice: the mean normal is that of some ten seconds."""
FLAT: Final = 1e-3
"""Share of the information below which a direction counts as not observed."""
ROUNDS: Final = 4


@dataclass(slots=True)
class State:
    """Where the sensor is, on the map's axes, at the end of a slice.

    Attributes
    ----------
    quat : ndarray, shape (4,)
        Map from sensor.
    position_m, velocity_m_s, gyro_bias_rad_s, accel_bias_m_s2, gravity_m_s2 : ndarray, shape (3,)
    covariance : ndarray, shape (18, 18)
    """

    quat: Array
    position_m: Array
    velocity_m_s: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    gravity_m_s2: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class Step:
    """What one slice gave.

    Attributes
    ----------
    number : int
        Of the slice.
    quat, position_m : ndarray, shape (4,), (3,)
        At its end, corrected.
    gyro_bias_rad_s : ndarray, shape (3,)
    sigma : ndarray, shape (6,)
        Of attitude [rad] and position [m].
    clusters : ndarray of CLUSTER_DTYPE
        Of one laser each where the slice has them told apart.
    world_m : ndarray, shape (m, 3)
        Where the corrected pose places them.
    seen, matched : int
        Clusters of all lasers, and those that found a plane.
    residual_m : float
        RMS distance from it.
    """

    number: int
    quat: Array
    position_m: Array
    velocity_m_s: Array
    gyro_bias_rad_s: Array
    sigma: Array
    clusters: npt.NDArray[np.void]
    world_m: Array
    seen: int
    matched: int
    residual_m: float


class Odometry:
    """The filter and its map.

    Parameters
    ----------
    state : State
        At the start of slice `number`.
    motion : MotionGrid
    number : int
    voxel_m : float
        Edge of the map's voxels.
    """

    MOST: Final = 4000.0
    """Returns that a voxel of the map remembers."""
    REACH_M: Final = 250.0
    """The map forgets what lies farther away than this."""

    def __init__(self, state: State, motion: MotionGrid, number: int, voxel_m: float) -> None:
        self.state, self.number, self.voxel_m = state, number, voxel_m
        self._motion = motion
        self.map = PlaneMap(voxel_m)
        self._cluster = Clusterer(voxel_m)
        self._ground = np.zeros(3)
        density = 2.0 * max(motion.rate_density, 1e-6), 3.0 * max(motion.force_density, 1e-4)
        step = STEP_S
        self._noise = np.concatenate(
            [
                np.full(3, density[0] ** 2 * step), np.full(3, 1e-12), np.full(3, density[1] ** 2 * step),
                np.full(3, np.deg2rad(0.005) ** 2 * step), np.full(3, 0.002**2 * step), np.full(3, 1e-14),
            ]
        )  # fmt: skip

    def change_voxels(self, voxel_m: float) -> None:
        """Go on with voxels of another edge; the moments of the old ones go into the new."""
        before, self.voxel_m = self.map, voxel_m
        rows = before.voxels[: before.count]
        clusters = np.zeros(before.count, CLUSTER_DTYPE)
        clusters["count"], clusters["scatter"] = rows[:, COUNT], rows[:, SCATTER : SCATTER + 6]
        self.map, self._cluster = PlaneMap(voxel_m), Clusterer(voxel_m)
        for first in range(0, before.count, 10_000):
            part = slice(first, first + 10_000)
            self.map.insert(rows[part, MEAN : MEAN + 3].copy(), clusters[part], self.MOST)

    def propagate(self, to: int) -> tuple[Array, Array]:
        """Carry the state on to the end of slice `to`; poses on the grid over that slice, (STEPS + 1, 4) and (STEPS + 1, 3)."""
        quats, positions = np.empty((STEPS + 1, 4)), np.empty((STEPS + 1, 3))
        s = self.state
        while self.number <= to:
            first = self.number * STEPS
            part = slice(first, first + STEPS)
            rate, force = self._motion.rate_rad_s[part], self._motion.force_m_s2[part]
            if len(rate) < STEPS:
                raise IndexError(f"slice {self.number} lies beyond the inertial data")
            s.covariance = _propagate(
                rate, force, s.quat, s.position_m, s.velocity_m_s, s.gyro_bias_rad_s, s.accel_bias_m_s2, s.gravity_m_s2,
                s.covariance, self._noise, quats, positions,
            )  # fmt: skip
            self.number += 1
        return quats, positions

    def step(self, piece: Slice) -> Step:
        """Take the next slice: propagate, match, correct, and add it to the map."""
        quats, positions = self.propagate(piece.number)
        start_ns = self._motion.start_ns + piece.number * STEPS * STEP_NS
        clusters, world = self._cluster(piece, start_ns, quats, positions)
        s = self.state
        matched, residual = 0, float("nan")
        # in the body at the slice's end, where the prediction between the instants stands
        mat = np.empty((3, 3))
        mat_of_quat(s.quat, mat)
        before = mat.copy()
        body = (world - s.position_m) @ mat
        if self.map.count:
            matched, residual, s.covariance = _update(
                self.map.table, self.map.keys, self.map.voxels, self.voxel_m, body, clusters["count"], s.quat,
                s.position_m, s.velocity_m_s, s.gyro_bias_rad_s, s.accel_bias_m_s2, s.gravity_m_s2, s.covariance,
                self._ground,
            )  # fmt: skip
            mat_of_quat(s.quat, mat)
            world = body @ mat.T + s.position_m
        self.map.insert(world, clusters, self.MOST)
        seen = len(clusters)
        if piece.laser is not None:
            # these would weigh more in the filter, for each has a surface's roughness of its own
            clusters, world = self._cluster(piece, start_ns, quats, positions, apart=True)
            world = (world - positions[-1]) @ before @ mat.T + s.position_m
        if piece.number % 50 == 0:
            self.map.forget_beyond(s.position_m, self.REACH_M)
        return Step(
            piece.number, s.quat.copy(), s.position_m.copy(), s.velocity_m_s.copy(), s.gyro_bias_rad_s.copy(),
            np.sqrt(np.diag(s.covariance)[:6]), clusters, world, seen, matched, residual,
        )  # fmt: skip

    def position_fix(self, position_m: Array, sigma_m: Array) -> None:
        """Take a position of the sensor, shape (3,), with its sigmas."""
        s = self.state
        observed = np.zeros((3, STATES))
        observed[:, POSITION] = np.eye(3)
        innovation = observed @ s.covariance @ observed.T + np.diag(sigma_m**2)
        gain = np.linalg.solve(innovation, observed @ s.covariance).T
        self._correct(gain @ (position_m - s.position_m))
        keep = np.eye(STATES) - gain @ observed
        s.covariance = keep @ s.covariance @ keep.T + gain @ np.diag(sigma_m**2) @ gain.T

    def attitude_fix(self, quat: Array, sigma_rad: Array) -> None:
        """Take an attitude of the sensor, shape (4,), with its sigmas about the map's axes."""
        s = self.state
        mat = np.empty((3, 3))
        mat_of_quat(s.quat, mat)
        off = np.empty(3)
        quat_difference(s.quat, quat, off)  # in the body
        observed = np.zeros((3, STATES))
        observed[:, ROTATION] = mat
        innovation = observed @ s.covariance @ observed.T + np.diag(sigma_rad**2)
        gain = np.linalg.solve(innovation, observed @ s.covariance).T
        self._correct(gain @ (mat @ off))
        keep = np.eye(STATES) - gain @ observed
        s.covariance = keep @ s.covariance @ keep.T + gain @ np.diag(sigma_rad**2) @ gain.T

    def _correct(self, error: Array) -> None:
        s = self.state
        _apply(error, s.quat, s.position_m, s.velocity_m_s, s.gyro_bias_rad_s, s.accel_bias_m_s2, s.gravity_m_s2)


@njit(cache=True, nogil=True)
def _apply(d: Any, quat: Any, position: Any, velocity: Any, gyro_bias: Any, accel_bias: Any, gravity: Any) -> None:
    quat_turned(quat, d[0], d[1], d[2], quat)
    for i in range(3):
        position[i] += d[3 + i]
        velocity[i] += d[6 + i]
        gyro_bias[i] += d[9 + i]
        accel_bias[i] += d[12 + i]
        gravity[i] += d[15 + i]
    # its size is known
    scale = STANDARD_GRAVITY_M_S2 / np.sqrt(gravity[0] ** 2 + gravity[1] ** 2 + gravity[2] ** 2)
    for i in range(3):
        gravity[i] *= scale


@njit(cache=True, nogil=True)
def _propagate(
    rate: Any, force: Any, quat: Any, position: Any, velocity: Any, gyro_bias: Any, accel_bias: Any, gravity: Any,
    covariance: Any, noise: Any, quats: Any, positions: Any,
) -> Any:  # fmt: skip
    dt = STEP_S
    mat, change = np.empty((3, 3)), np.eye(STATES)
    quats[0], positions[0] = quat, position
    for k in range(len(rate)):
        wx, wy, wz = rate[k, 0] - gyro_bias[0], rate[k, 1] - gyro_bias[1], rate[k, 2] - gyro_bias[2]
        fx, fy, fz = force[k, 0] - accel_bias[0], force[k, 1] - accel_bias[1], force[k, 2] - accel_bias[2]
        # the force is felt half way through the step's turn
        half = quat.copy()
        quat_turned(quat, 0.5 * dt * wx, 0.5 * dt * wy, 0.5 * dt * wz, half)
        mat_of_quat(half, mat)
        change[:, :] = 0.0
        for i in range(STATES):
            change[i, i] = 1.0
        # theta' = (I - [w] dt) theta - dt dbg
        change[0, 1], change[0, 2] = wz * dt, -wy * dt
        change[1, 0], change[1, 2] = -wz * dt, wx * dt
        change[2, 0], change[2, 1] = wy * dt, -wx * dt
        for i in range(3):
            change[i, 9 + i] = -dt
            change[3 + i, 6 + i] = dt
            change[6 + i, 15 + i] = dt
            a = mat[i, 0] * fx + mat[i, 1] * fy + mat[i, 2] * fz + gravity[i]
            # v' = v - R [f] theta dt - R dt dba + dt dg
            change[6 + i, 0] = -dt * (mat[i, 1] * fz - mat[i, 2] * fy)
            change[6 + i, 1] = -dt * (mat[i, 2] * fx - mat[i, 0] * fz)
            change[6 + i, 2] = -dt * (mat[i, 0] * fy - mat[i, 1] * fx)
            for j in range(3):
                change[6 + i, 12 + j] = -dt * mat[i, j]
            position[i] += dt * velocity[i] + 0.5 * dt * dt * a
            velocity[i] += dt * a
        quat_turned(quat, dt * wx, dt * wy, dt * wz, quat)
        covariance = change @ covariance @ np.ascontiguousarray(change.T)
        for i in range(STATES):
            covariance[i, i] += noise[i]
        quats[k + 1], positions[k + 1] = quat, position
    return covariance


@njit(cache=True, nogil=True)
def observable(information: Any) -> Any:
    """Projection of a pose's correction, shape (6, 6), onto what planes really tell of it.

    Of directions that get less than `FLAT` of the information nothing is taken (after Zhang, Kaess, Singh 2016). Turns count by what
    they move at the mean distance.
    """
    turn = information[0, 0] + information[1, 1] + information[2, 2]
    shift = information[3, 3] + information[4, 4] + information[5, 5]
    arm = np.sqrt(max(turn, 1e-12) / max(shift, 1e-12))
    scaled = information.copy()
    scaled[:3, :] /= arm
    scaled[:, :3] /= arm
    values, vectors = np.linalg.eigh(scaled)
    known = np.zeros((6, 6))
    for i in range(6):
        if values[i] > FLAT * shift:
            for a in range(6):
                for b in range(6):
                    known[a, b] += vectors[a, i] * vectors[b, i]
    known[:3, 3:] /= arm
    known[3:, :3] *= arm
    return known


@njit(cache=True, nogil=True, inline="always")
def _row(mat: Any, body: Any, nx: float, ny: float, nz: float, out: Any) -> None:
    """How a distance along a normal changes with the pose of the slice's end: by rotation in the body, and by position."""
    p = nx * mat[0, 0] + ny * mat[1, 0] + nz * mat[2, 0]
    q = nx * mat[0, 1] + ny * mat[1, 1] + nz * mat[2, 1]
    r = nx * mat[0, 2] + ny * mat[1, 2] + nz * mat[2, 2]
    out[0], out[1], out[2] = body[1] * r - body[2] * q, body[2] * p - body[0] * r, body[0] * q - body[1] * p
    out[3], out[4], out[5] = nx, ny, nz


@njit(cache=True, nogil=True, inline="always")
def _add(row: Any, weight: float, residual: float, information: Any, pull: Any) -> None:
    """Add a row to the lower half of the information and to the pull."""
    for a in range(6):
        weighted = weight * row[a]
        pull[a] += weighted * residual
        for b in range(a + 1):
            information[a, b] += weighted * row[b]


@njit(cache=True, nogil=True)
def _matches(
    table: Any, keys: Any, voxels: Any, per_m: float, body: Any, counts: Any, mat: Any, position: Any, gate: float,
    row: Any, residual: Any, weight: Any, ground: Any,
) -> int:  # fmt: skip
    """Voxel of each cluster, -1 where it finds no plane, with distance and weight; the normals of ground, up, are added to `ground`."""
    matched = 0
    for n in range(len(body)):
        bx, by, bz = body[n, 0], body[n, 1], body[n, 2]
        x = mat[0, 0] * bx + mat[0, 1] * by + mat[0, 2] * bz + position[0]
        y = mat[1, 0] * bx + mat[1, 1] * by + mat[1, 2] * bz + position[1]
        z = mat[2, 0] * bx + mat[2, 1] * by + mat[2, 2] * bz + position[2]
        row[n] = find(table, keys, voxel_key(x, y, z, per_m))
        if row[n] < 0:
            continue
        v = voxels[row[n]]
        e = v[NORMAL] * x + v[NORMAL + 1] * y + v[NORMAL + 2] * z - v[LEVEL]
        if v[FLATNESS] < 0.0 or abs(e) > gate:
            row[n] = -1
            continue
        # a plane known from a few lines is uncertain away from them
        off = (x - v[MEAN]) ** 2 + (y - v[MEAN + 1]) ** 2 + (z - v[MEAN + 2]) ** 2
        variance = RANGE_SIGMA_M**2 / counts[n] + SURFACE_SIGMA_M**2 + 0.25 * v[FLATNESS] + v[TILT] * off
        weight[n] = min(1.0, 2.0 * np.sqrt(variance) / max(abs(e), 1e-9)) / (INFLATION * variance)
        residual[n] = e
        matched += 1
        if abs(v[NORMAL + 2]) > GROUND:
            signed = weight[n] if v[NORMAL + 2] > 0.0 else -weight[n]
            for c in range(3):
                ground[c] += signed * v[NORMAL + c]
    return matched


@njit(cache=True, nogil=True)
def _accumulate(
    voxels: Any, body: Any, mat: Any, row: Any, residual: Any, weight: Any, ground: Any, added: Any, pull: Any,
    level_added: Any, level_pull: Any,
) -> float:  # fmt: skip
    """Information and pull of all matches, and the same with the mean normal for all ground; gives the sum of squares."""
    j = np.empty(6)
    squares = 0.0
    added[:, :], level_added[:, :] = 0.0, 0.0
    pull[:], level_pull[:] = 0.0, 0.0
    for n in range(len(body)):
        if row[n] < 0:
            continue
        v, e = voxels[row[n]], residual[n]
        squares += e * e
        _row(mat, body[n], v[NORMAL], v[NORMAL + 1], v[NORMAL + 2], j)
        _add(j, weight[n], e, added, pull)
        if abs(v[NORMAL + 2]) > GROUND:
            side = 1.0 if v[NORMAL + 2] > 0.0 else -1.0
            _row(mat, body[n], side * ground[0], side * ground[1], side * ground[2], j)
        _add(j, weight[n], e, level_added, level_pull)
    for a in range(6):
        for b in range(a):
            added[b, a], level_added[b, a] = added[a, b], level_added[a, b]
    return squares


@njit(cache=True, nogil=True)
def _update(
    table: Any, keys: Any, voxels: Any, voxel_m: float, body: Any, counts: Any, quat: Any, position: Any, velocity: Any,
    gyro_bias: Any, accel_bias: Any, gravity: Any, covariance: Any, ground: Any,
) -> Any:  # fmt: skip
    to_pose, mine = np.ascontiguousarray(covariance[:, :6]), np.ascontiguousarray(covariance[:6, :6])
    total = np.zeros(STATES)  # correction so far: the prior pulls back to where it began
    mat, turn = np.empty((3, 3)), np.empty(3)
    before = quat.copy()
    added, pull, level_added, level_pull = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    factor, inner = np.zeros((6, 6)), np.eye(6)
    row, residual, weight = np.empty(len(body), np.int64), np.empty(len(body)), np.empty(len(body))
    normals, up = ground.copy(), ground.copy()
    matched, squares = 0, 0.0
    for attempt in range(ROUNDS):
        mat_of_quat(quat, mat)
        gate = 0.5 if attempt == 0 else 0.25
        ground[:] = GROUND_MEMORY * normals
        matched = _matches(
            table, keys, voxels, 1.0 / voxel_m, body, counts, mat, position, gate, row, residual, weight, ground
        )
        up[:] = ground
        unit_vector(up)
        squares = _accumulate(voxels, body, mat, row, residual, weight, up, added, pull, level_added, level_pull)
        if matched:
            # normals of flat ground have errors, and thousands of them would seem to hold a place along it: whether anything does is
            # judged with their mean for all of them, and where nothing does, that is also what counts. Not the vertical: the map
            # leans by what the start's tilt was off, and a turn about any other axis than the ground's own normal tilts it
            known = observable(level_added)
            if np.trace(known) < 5.5:
                pull = np.ascontiguousarray(known.T) @ level_pull
                added = np.ascontiguousarray(known.T) @ level_added @ np.ascontiguousarray(known)
        # (P^-1 + A)^-1 by Woodbury's formula: P itself may be too nearly singular to invert. With A = L L^T it stays a covariance
        values, vectors = np.linalg.eigh(added)
        root = np.sqrt(np.maximum(values, 1e-13 * values[5] + 1e-12))
        factor[:, :] = vectors * root
        inner[:, :] = np.linalg.inv(np.eye(6) + factor.T @ mine @ factor)
        change = to_pose @ (factor @ (inner @ (factor.T @ total[:6] - (vectors.T @ pull) / root))) - total
        total += change
        _apply(change, quat, position, velocity, gyro_bias, accel_bias, gravity)
        # the attitude's correction as one rotation from the prediction
        quat_difference(before, quat, turn)
        total[:3] = turn
        moved = np.abs(change[:6])
        if moved[0] + moved[1] + moved[2] < 1e-5 and moved[3] + moved[4] + moved[5] < 3e-4:
            break
    gain = to_pose @ factor
    left = covariance - gain @ (inner @ gain.T)
    return matched, np.sqrt(squares / max(matched, 1)), 0.5 * (left + left.T)
