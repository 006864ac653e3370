"""Clouds, trajectory and options of an adjustment, together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.reader import Cloud
from groundproc.strips.clouds import Chunk
from groundproc.strips.options import StripOptions
from groundproc.strips.route import Route

Array = npt.NDArray[np.float64]


@dataclass(slots=True)
class Site:
    """Clouds, trajectory and strips of a task."""

    clouds: Sequence[Cloud]
    clock: Clock
    route: Route
    options: StripOptions
    outside: int = 0
    no_surface: int = 0

    def placed(self, chunk: Chunk) -> tuple[npt.NDArray[np.bool_], Array, Array, Array]:
        """Which points have a pose, and for all of them place less the origin, scanner, and attitude; shape (n, 3) and (n, 4)."""
        poses, covered = self.route.poses.where_covered(chunk.time_ns)
        quat = poses.quat_local_ins_wxyz
        quat[~covered] = (1.0, 0.0, 0.0, 0.0)
        scanner = poses.position_m
        lever = np.array(self.options.lever_arm_m)
        if lever.any():
            scanner = scanner + np.einsum("nij,j->ni", frames.mat_from_quat(quat), lever)
        scanner[~covered] = 0.0
        return covered, chunk.xyz_m - self.route.origin_m, scanner, quat
