"""Compiles or loads every kernel before the first packet, so that none of them makes the flight wait."""

import numpy as np

from groundproc import sensors
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.odometry import Odometry
from groundproc.estimation.odometry.seeking import starts
from groundproc.estimation.odometry.slices import Slice
from groundproc.estimation.odometry.spline import Path, integrated
from groundproc.estimation.odometry.state import State
from groundproc.estimation.odometry.surfaces import surfaces_of
from groundproc.geodesy import LocalFrame
from groundproc.live.motion import GrowingMotion
from groundproc.live.slicer import Slicer
from groundproc.live.voxelcloud import VoxelCloud
from groundproc.sensors.shots import Gate
from groundproc.trajectory.trajectory import Trajectory


def warm_up() -> None:
    """Run a tenth of a second of nothing through everything."""
    motion = GrowingMotion(0, 1e-3, 1e-2, "none")
    rest = np.zeros((5 * STEPS, 3))
    motion.extend(rest, rest + np.array([0.0, 0.0, 9.8]), np.ones(5 * STEPS, np.bool_))
    gravity = np.array([0.0, 0.0, -9.80665])
    state = State(
        np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), gravity, 1e-4 * np.eye(18)
    )
    odometry = Odometry(state, motion, 0, 0.5)
    side = np.linspace(1.0, 5.0, 60)
    floor = np.stack([*np.meshgrid(side, side), np.full((60, 60), -2.0)], axis=-1).reshape(-1, 3).astype(np.float32)
    # of one cluster or none, columns of a table count as contiguous: another type of array, and compiled anew
    for number, seen in enumerate((floor, floor, floor, floor[:1], floor[:0])):
        times = number * SLICE_NS + np.linspace(0, SLICE_NS - 1, len(seen)).astype(np.int64)
        odometry.step(Slice(number, times, seen))
    surfaces = surfaces_of(odometry.planes, np.zeros(3), 100.0)
    starts(surfaces, surfaces, np.zeros(3), np.ones(4))
    odometry.planes.forget_beyond(np.zeros(3), 100.0)
    quat = integrated(rest[:STEPS], state.quat)
    cloud = VoxelCloud(1.0, 1 << 20)
    cloud.add(
        np.arange(len(floor)) * STEP_NS // 100, floor, np.zeros(len(floor), np.uint8), Path(0, quat, rest[: STEPS + 1])
    )
    lidar = sensors.lidar(sensors.FLOWN)
    for packets in lidar.blanks():
        Slicer(Gate(), lidar).feed(packets, np.arange(len(packets)) * STEP_NS)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    zero = np.zeros((2, 3))
    flags = np.array([True, False])
    Trajectory(
        LocalFrame(0.0, 0.0, 0.0), np.array([0, SLICE_NS]), zero, zero, level, zero, zero, zero, flags
    ).where_covered(np.array([0, 1]))
