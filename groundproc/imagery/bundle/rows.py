"""What one image point says: residual and derivatives by the pose, the camera and the point."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.imagery import lenses
from groundproc.imagery.bundle.block import LIDAR, Block
from groundproc.imagery.bundle.unknowns import OF_CAMERA, Unknowns

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_BORESIGHT = lenses.FREE
_LEVER = lenses.FREE + 3
_SHIFT = lenses.FREE + 6
_DELAY = lenses.FREE + 7
_LENS_FREE = lenses.FREE


class System(NamedTuple):
    """A block as the kernels take it."""

    kind: Ints
    lens: Array
    mat_cam_ins: Array
    lever_m: Array
    shift_s: Array
    delay_s: Array
    middle_px: Array
    place_m: Array
    mat_local_ins: Array
    velocity_m_s: Array
    rate_rad_s: Array
    lead: Ints
    camera: Ints
    station: Ints
    image: Ints
    point: Ints
    pixel: Array
    root_weight: Array
    row_point: Ints
    row_normal: Array
    row_target_m: Array
    row_root_weight: Array
    row_moves: Mask
    centre_m: Array
    moved: Array
    station_column: Ints
    camera_column: Ints
    common_column: Ints
    first: Ints
    first_row: Ints


def moves_with_poses(block: Block) -> Mask:
    """Which rows of points are planes of a cloud that is off as the trajectory is, shape (m,)."""
    common = block.priors.common
    return np.asarray((block.rows.source == LIDAR) & (common.cloud and common.covariance is not None))


def system_of(block: Block, unknowns: Unknowns) -> System:
    """The arrays of a block."""
    cameras, stations, measured, rows = block.rig.cameras, block.stations, block.measured, block.rows
    ends = np.arange(len(block.points_m) + 1)
    return System(
        np.array([one.camera.kind for one in cameras]),
        np.stack([one.camera.lens() for one in cameras]),
        np.stack([one.mat_cam_ins for one in cameras]),
        np.stack([one.lever_arm_m for one in cameras]),
        np.array([one.timeshift_s for one in cameras]),
        np.array([one.line_delay_s for one in cameras]),
        np.array([one.camera.middle_row_px for one in cameras]),
        stations.place_m,
        stations.mat_local_ins,
        stations.velocity_m_s,
        stations.rate_rad_s,
        stations.lead,
        block.camera,
        block.station,
        measured.image,
        measured.point,
        measured.pixel,
        np.sqrt(measured.weight) / measured.sigma_px,
        rows.point,
        rows.normal,
        rows.target_m,
        np.sqrt(rows.weight) / rows.sigma_m,
        moves_with_poses(block),
        block.priors.common.centre_m,
        block.priors.common.moved,
        unknowns.station,
        unknowns.camera,
        unknowns.common[1:],
        np.searchsorted(measured.point, ends),
        np.searchsorted(rows.point, ends),
    )


@njit(cache=True, nogil=True)
def ray_of(system: System, i: int, point: Array, ray: Array, mat: Array, away: Array) -> float:
    """Point in the camera frame of measurement i; also camera from local, the vector from the ins to it, and the time since the stamp."""
    image = system.image[i]
    camera, station = system.camera[image], system.station[image]
    since = system.shift_s[camera] - system.shift_s[system.lead[station]]
    since += (system.pixel[i, 1] - system.middle_px[camera]) * system.delay_s[camera]
    turn, local_ins = np.empty((3, 3)), np.empty((3, 3))
    _turned(system.rate_rad_s[station], since, turn)
    _times(system.mat_local_ins[station], turn, local_ins)
    inside = np.zeros(3)
    for k in range(3):
        away[k] = point[k] - system.place_m[station, k] - since * system.velocity_m_s[station, k]
    for k in range(3):
        inside[k] = -system.lever_m[camera, k]
        for j in range(3):
            inside[k] += local_ins[j, k] * away[j]
    for k in range(3):
        ray[k] = 0.0
        for j in range(3):
            ray[k] += system.mat_cam_ins[camera, k, j] * inside[j]
            mat[k, j] = 0.0
            for n in range(3):
                mat[k, j] += system.mat_cam_ins[camera, k, n] * local_ins[j, n]
    return float(since)


@njit(cache=True, nogil=True)
def _times(left: Array, right: Array, out: Array) -> None:
    """Product of two matrices (3, 3), written out: numpy's would take a second to compile for each kernel that calls it."""
    for j in range(3):
        for k in range(3):
            out[j, k] = left[j, 0] * right[0, k] + left[j, 1] * right[1, k] + left[j, 2] * right[2, k]


@njit(cache=True, nogil=True)
def _turned(rate: Array, seconds: float, out: Array) -> None:
    """Matrix of a rotation vector by Rodrigues' formula."""
    x, y, z = rate[0] * seconds, rate[1] * seconds, rate[2] * seconds
    angle = np.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        sine, cosine = 1.0, 0.5
    else:
        sine, cosine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / (angle * angle)
    out[0, 0], out[0, 1], out[0, 2] = (
        1.0 - cosine * (y * y + z * z),
        cosine * x * y - sine * z,
        cosine * x * z + sine * y,
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        cosine * x * y + sine * z,
        1.0 - cosine * (x * x + z * z),
        cosine * y * z - sine * x,
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        cosine * x * z - sine * y,
        cosine * y * z + sine * x,
        1.0 - cosine * (x * x + y * y),
    )


@njit(cache=True, nogil=True)
def residuals(system: System, points: Array, out: Array, reached: Mask) -> None:
    """Residual of every measurement [px], shape (n, 2), whatever its weight."""
    ray, mat, away = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    by_ray, by_lens = np.zeros((2, 3)), np.zeros((2, _LENS_FREE))
    for i in range(len(system.image)):
        ray_of(system, i, points[system.point[i]], ray, mat, away)
        camera = system.camera[system.image[i]]
        reached[i] = lenses.compared(
            system.kind[camera], system.lens[camera], ray, system.pixel[i], out[i], by_ray, by_lens
        )


@njit(cache=True, nogil=True)
def row_of(
    system: System, i: int, point: Array, residual: Array, by_pose: Array, by_point: Array, by_camera: Array
) -> bool:
    """Weighted residual of measurement i, shape (2,), by pose (2, 6), point (2, 3) and camera (2, OF_CAMERA); False: it says nothing."""
    weight = system.root_weight[i]
    if weight == 0.0:
        return False
    ray, mat, away = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    ray_of(system, i, point, ray, mat, away)
    image = system.image[i]
    camera, station = system.camera[image], system.station[image]
    by_ray, by_lens = np.zeros((2, 3)), np.zeros((2, _LENS_FREE))
    if not lenses.compared(system.kind[camera], system.lens[camera], ray, system.pixel[i], residual, by_ray, by_lens):
        return False
    velocity = system.velocity_m_s[station]
    turning, turned = np.zeros(3), np.zeros(3)
    for j in range(3):
        for k in range(3):
            turning[j] += system.mat_local_ins[station, j, k] * system.rate_rad_s[station, k]
    turned[0] = away[1] * turning[2] - away[2] * turning[1]
    turned[1] = away[2] * turning[0] - away[0] * turning[2]
    turned[2] = away[0] * turning[1] - away[1] * turning[0]
    for a in range(2):
        residual[a] *= weight
        for j in range(_LENS_FREE):
            by_camera[a, j] = weight * by_lens[a, j]
        for j in range(3):
            value, lever = 0.0, 0.0
            for k in range(3):
                value += by_ray[a, k] * mat[k, j]
                lever += by_ray[a, k] * system.mat_cam_ins[camera, k, j]
            by_point[a, j] = weight * value
            by_pose[a, j] = -weight * value
            by_camera[a, _LEVER + j] = -weight * lever
        x, y, z = by_point[a, 0], by_point[a, 1], by_point[a, 2]
        # row times the cross matrix of `away`
        by_pose[a, 3] = y * away[2] - z * away[1]
        by_pose[a, 4] = z * away[0] - x * away[2]
        by_pose[a, 5] = x * away[1] - y * away[0]
        u, v, w = weight * by_ray[a, 0], weight * by_ray[a, 1], weight * by_ray[a, 2]
        by_camera[a, _BORESIGHT] = w * ray[1] - v * ray[2]
        by_camera[a, _BORESIGHT + 1] = u * ray[2] - w * ray[0]
        by_camera[a, _BORESIGHT + 2] = v * ray[0] - u * ray[1]
        pace = 0.0
        for k in range(3):
            pace += by_point[a, k] * (turned[k] - velocity[k])
        by_camera[a, _SHIFT] = 0.0  # it moves the station: a row of the observed pose
        by_camera[a, _DELAY] = pace * (system.pixel[i, 1] - system.middle_px[camera])
    return True


__all__ = ["OF_CAMERA", "System", "ray_of", "residuals", "row_of", "system_of"]
