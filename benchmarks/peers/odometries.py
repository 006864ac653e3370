"""KISS-ICP and small_gicp as peers: each is given the scans of a log and gives back poses of the lidar at their ends."""

from collections.abc import Callable, Iterable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from peers.motion import ConstantVelocity, Gyros, Motion, Pose
from peers.scans import Scan

Array = npt.NDArray[np.float64]

VOXEL_M: Final = 0.5
DOWNSAMPLING_M: Final = 0.25
THREADS: Final = 2


def kiss_icp(scans: Iterable[Scan], motion: Gyros) -> list[Pose]:
    """KISS-ICP with its own defaults (voxels of 1 m) and its own deskewing.

    It brings the times of a scan to 0 to 1 by its first and last point and moves them by the whole step from scan to scan; with a
    field of view of 210 deg that is 1.7 times too much. That is how it comes, and how it is measured.
    """
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    del motion
    odometry = KissICP(load_config(None))
    found = []
    for scan in scans:
        odometry.register_frame(scan.points_m, (scan.time_ns - scan.time_ns[0]) * 1e-9)
        pose = np.array(odometry.last_pose)
        found.append(Pose(scan.end_ns, pose[:3, :3], pose[:3, 3]))
    return found


def vgicp(scans: Iterable[Scan], motion: Gyros) -> list[Pose]:
    """VGICP of small_gicp from scan to a map of 0.5 m voxels; prediction and deskewing by constant velocity."""
    del motion
    return _scan_to_map(scans, ConstantVelocity())


def vgicp_gyro(scans: Iterable[Scan], motion: Gyros) -> list[Pose]:
    """The same with the rotation predicted and deskewed by the gyros."""
    return _scan_to_map(scans, motion)


def _scan_to_map(scans: Iterable[Scan], motion: Motion) -> list[Pose]:
    import small_gicp

    voxels = small_gicp.GaussianVoxelMap(VOXEL_M)

    def match(scan: Array, guess: Array) -> Array:
        cloud, _ = small_gicp.preprocess_points(scan, DOWNSAMPLING_M, num_threads=THREADS)
        if not voxels.size():
            voxels.insert(cloud, guess)
            return guess
        result = small_gicp.align(voxels, cloud, guess, num_threads=THREADS)
        voxels.insert(cloud, result.T_target_source)
        return np.asarray(result.T_target_source)

    return _odometry(scans, motion, match)


def gicp(scans: Iterable[Scan], motion: Gyros) -> list[Pose]:
    """GICP of small_gicp from scan to scan; prediction and deskewing by constant velocity."""
    import small_gicp

    del motion
    before: list[Any] = []

    def match(scan: Array, guess: Array) -> Array:
        cloud, tree = small_gicp.preprocess_points(scan, DOWNSAMPLING_M, num_threads=THREADS)
        pose = guess
        if before:
            target, target_tree, target_pose = before.pop()
            result = small_gicp.align(
                target, cloud, target_tree, np.linalg.inv(target_pose) @ guess, num_threads=THREADS
            )
            pose = target_pose @ result.T_target_source
        before.append((cloud, tree, pose))
        return pose

    return _odometry(scans, ConstantVelocity(), match)


def _odometry(scans: Iterable[Scan], motion: Motion, match: Callable[[Array, Array], Array]) -> list[Pose]:
    """Predict, deskew to the scan's end, match; the velocity is that of the last step."""
    found: list[Pose] = []
    for scan in scans:
        if not found:
            pose = match(scan.points_m, np.eye(4))
            found.append(Pose(scan.end_ns, pose[:3, :3], pose[:3, 3]))
            continue
        last, before = found[-1], found[-2] if len(found) > 1 else None
        velocity = np.zeros(3)
        if before is not None:
            velocity = (last.position_m - before.position_m) / (last.time_ns - before.time_ns)
        turns = motion.turn(last, before, np.append(scan.time_ns, scan.end_ns))
        to_world = last.mat @ turns[-1].as_matrix()
        moved = (scan.time_ns - scan.end_ns)[:, None] * (velocity @ to_world)
        points = (turns[-1].inv() * turns[:-1]).apply(scan.points_m) + moved
        guess = np.eye(4)
        guess[:3, :3], guess[:3, 3] = to_world, last.position_m + velocity * (scan.end_ns - last.time_ns)
        pose = match(points, guess)
        found.append(Pose(scan.end_ns, pose[:3, :3], pose[:3, 3]))
    return found


PEERS: Final[dict[str, Callable[[Iterable[Scan], Gyros], list[Pose]]]] = {
    "kiss_icp": kiss_icp,
    "small_gicp_gicp": gicp,
    "small_gicp_vgicp": vgicp,
    "small_gicp_vgicp_gyro": vgicp_gyro,
}
"""The peers by name."""
NEEDS_GYROS: Final = ("small_gicp_vgicp_gyro",)
