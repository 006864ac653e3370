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
from groundproc.adjustment.motion import Motion
from groundproc.adjustment.rotations import mat_of_quat, quat_difference, quat_turned
from groundproc.adjustment.scans import STEP_NS, STEPS, Clusterer, Slice, voxel_key
from groundproc.adjustment.voxels import FLATNESS, LEVEL, NORMAL, PlaneMap, find

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
    world_m : ndarray, shape (m, 3)
        Where the corrected pose places them.
    matched : int
        Clusters that found a plane.
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
    matched: int
    residual_m: float


class Odometry:
    """The filter and its map.

    Parameters
    ----------
    state : State
        At the start of slice `number`.
    motion : Motion
    number : int
    voxel_m : float
        Edge of the map's voxels.
    """

    MOST: Final = 4000.0
    """Returns that a voxel of the map remembers."""
    REACH_M: Final = 250.0
    """The map forgets what lies farther away than this."""

    def __init__(self, state: State, motion: Motion, number: int, voxel_m: float) -> None:
        self.state, self.number, self.voxel_m = state, number, voxel_m
        self._motion = motion
        self.map = PlaneMap(voxel_m)
        self._cluster = Clusterer(voxel_m)
        density = 2.0 * max(motion.rate_density, 1e-6), 3.0 * max(motion.force_density, 1e-4)
        step = STEP_S
        self._noise = np.concatenate(
            [
                np.full(3, density[0] ** 2 * step), np.full(3, 1e-12), np.full(3, density[1] ** 2 * step),
                np.full(3, np.deg2rad(0.005) ** 2 * step), np.full(3, 0.002**2 * step), np.full(3, 1e-14),
            ]
        )  # fmt: skip

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
        body = (world - s.position_m) @ mat
        if self.map.count:
            matched, residual, s.covariance = _update(
                self.map.table, self.map.keys, self.map.voxels, self.voxel_m, body, clusters["count"], s.quat,
                s.position_m, s.velocity_m_s, s.gyro_bias_rad_s, s.accel_bias_m_s2, s.gravity_m_s2, s.covariance,
            )  # fmt: skip
            mat_of_quat(s.quat, mat)
            world = body @ mat.T + s.position_m
        self.map.insert(world, clusters, self.MOST)
        if piece.number % 50 == 0:
            self.map.forget_beyond(s.position_m, self.REACH_M)
        return Step(
            piece.number, s.quat.copy(), s.position_m.copy(), s.velocity_m_s.copy(), s.gyro_bias_rad_s.copy(),
            np.sqrt(np.diag(s.covariance)[:6]), clusters, world, matched, residual,
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
def _update(
    table: Any, keys: Any, voxels: Any, voxel_m: float, body: Any, counts: Any, quat: Any, position: Any, velocity: Any,
    gyro_bias: Any, accel_bias: Any, gravity: Any, covariance: Any,
) -> Any:  # fmt: skip
    information = np.linalg.inv(covariance)
    total = np.zeros(STATES)  # correction so far: the prior pulls back to where it began
    mat, turn = np.empty((3, 3)), np.empty(3)
    before = quat.copy()
    per_m = 1.0 / voxel_m
    system, right = np.empty((STATES, STATES)), np.empty(STATES)
    j = np.empty(6)
    matched, squares, added = 0, 0.0, np.zeros((6, 6))
    for attempt in range(ROUNDS):
        mat_of_quat(quat, mat)
        added[:, :] = 0.0
        pull = np.zeros(6)
        matched, squares = 0, 0.0
        gate = 0.5 if attempt == 0 else 0.25
        for n in range(len(body)):
            bx, by, bz = body[n, 0], body[n, 1], body[n, 2]
            x = mat[0, 0] * bx + mat[0, 1] * by + mat[0, 2] * bz + position[0]
            y = mat[1, 0] * bx + mat[1, 1] * by + mat[1, 2] * bz + position[1]
            z = mat[2, 0] * bx + mat[2, 1] * by + mat[2, 2] * bz + position[2]
            row = find(table, keys, voxel_key(x, y, z, per_m))
            if row < 0:
                continue
            v = voxels[row]
            if v[FLATNESS] < 0.0:
                continue
            nx, ny, nz = v[NORMAL], v[NORMAL + 1], v[NORMAL + 2]
            e = nx * x + ny * y + nz * z - v[LEVEL]
            if abs(e) > gate:
                continue
            variance = RANGE_SIGMA_M**2 / counts[n] + SURFACE_SIGMA_M**2 + 0.25 * v[FLATNESS]
            sigma = np.sqrt(variance)
            weight = 1.0 / (INFLATION * variance)
            if abs(e) > 2.0 * sigma:
                weight *= 2.0 * sigma / abs(e)
            # normal in the body
            p = nx * mat[0, 0] + ny * mat[1, 0] + nz * mat[2, 0]
            q = nx * mat[0, 1] + ny * mat[1, 1] + nz * mat[2, 1]
            r = nx * mat[0, 2] + ny * mat[1, 2] + nz * mat[2, 2]
            j[0], j[1], j[2] = by * r - bz * q, bz * p - bx * r, bx * q - by * p
            j[3], j[4], j[5] = nx, ny, nz
            for a in range(6):
                wa = weight * j[a]
                pull[a] += wa * e
                for b in range(a + 1):
                    added[a, b] += wa * j[b]
            matched += 1
            squares += e * e
        for a in range(6):
            for b in range(a):
                added[b, a] = added[a, b]
        system[:, :] = information
        system[:6, :6] += added
        right[:] = -information @ total
        right[:6] -= pull
        change = np.linalg.solve(system, right)
        total += change
        _apply(change, quat, position, velocity, gyro_bias, accel_bias, gravity)
        # the attitude's correction as one rotation from the prediction
        quat_difference(before, quat, turn)
        total[:3] = turn
        if (
            abs(change[0]) + abs(change[1]) + abs(change[2]) < 1e-5
            and abs(change[3]) + abs(change[4]) + abs(change[5]) < 3e-4
        ):
            break
    return matched, np.sqrt(squares / max(matched, 1)), np.linalg.inv(system)
