"""State of the odometry and its propagation by the inertial data.

The error state has 18 components: attitude (in the body), position, velocity, bias of the gyro, bias of the
accelerometer, gravity.
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.constants import STANDARD_GRAVITY_M_S2
from groundproc.estimation.odometry.grid import STEP_NS
from groundproc.numerics.rotations import mat_of_quat, quat_turned

Array = npt.NDArray[np.float64]

STATES: Final = 18
STEP_S: Final = STEP_NS * 1e-9
ROTATION, POSITION, VELOCITY, GYRO, ACCEL, GRAVITY = (slice(3 * i, 3 * i + 3) for i in range(6))


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

    @property
    def arrays(self) -> "StateArrays":
        """What the kernels take, and change in place; all but the covariance."""
        return StateArrays(
            self.quat, self.position_m, self.velocity_m_s, self.gyro_bias_rad_s, self.accel_bias_m_s2, self.gravity_m_s2
        )


class StateArrays(NamedTuple):
    """A `State` as kernels take it, without its covariance; the fields stand there."""

    quat: Array
    position_m: Array
    velocity_m_s: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    gravity_m_s2: Array


@njit(cache=True, nogil=True)
def apply(d: Array, state: StateArrays) -> None:
    """Correct a state by an error state, shape (STATES,)."""
    quat, position, velocity, gyro_bias, accel_bias, gravity = state
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
def propagate(
    rate: Array, force: Array, state: StateArrays, covariance: Array, noise: Array, poses: tuple[Array, Array]
) -> Any:
    """Carry a state on over some grid steps; gives its covariance, and fills in quaternions and positions of the grid."""
    quat, position, velocity, gyro_bias, accel_bias, gravity = state
    quats, positions = poses
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
