"""A block of images over rough ground with known truth: poses, points and measurements, written as the tables that `swath images` takes."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.geodesy import LocalFrame
from groundproc.imagery.camera import Camera
from groundproc.imagery.poses import ImagePoses, write_poses
from groundproc.imagery.rig import Rig, RigCamera, write_rig
from groundproc.imagery.rotations import STRAIGHT_DOWN, mat_of_vector
from groundproc.imagery.site import Site, in_frame
from groundproc.trajectory.table import write_trajectory
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
START_NS = 1_700_000_000_000_000_000
FRAME = LocalFrame(58.4, 15.6, 60.0)


@dataclass(frozen=True)
class Flown:
    """A flight over strips, the truth of it.

    Attributes
    ----------
    trajectory : Trajectory
        At 100 Hz, sigmas zero.
    camera : RigCamera
    stamp_ns : ndarray
        What the camera's clock said.
    points_m : ndarray, shape (p, 3)
    rows : list
        Image, point and true pixel of each measurement.
    """

    trajectory: Trajectory
    camera: RigCamera
    stamp_ns: npt.NDArray[np.int64]
    points_m: Array
    rows: list[tuple[int, int, Array]] = field(default_factory=list)


def true_camera(**changes: Any) -> RigCamera:
    """Looks down, half a degree and some centimetres off its nominal place, its clock 40 ms late."""
    camera = Camera(1600, 1200, 1300.0, (801.3, 597.2), "radtan", (-0.05, 0.02))
    mat = mat_of_vector(np.deg2rad([[0.5, -0.4, 0.3]]))[0] @ STRAIGHT_DOWN
    return replace(RigCamera("cam0", camera, mat, -mat @ np.array([0.05, 0.12, -0.08]), 0.04), **changes)


def fly(
    camera: RigCamera, strips: int = 4, per_strip: int = 6, seed: int = 0, points: int = 900,
    spacing_m: tuple[float, float] = (18.0, 32.0), height: float = 40.0,
) -> Flown:  # fmt: skip
    """Strips there and back at two heights, images over each other along and across as their spacing and height have it."""
    rng = np.random.default_rng(seed)
    (base, side), speed = spacing_m, 6.0
    length_s = per_strip * base / speed
    time_s = np.arange(0.0, strips * (length_s + 6.0), 0.01)
    leg = np.minimum(time_s // (length_s + 6.0), strips - 1).astype(int)
    along = np.clip(time_s - leg * (length_s + 6.0), 0.0, length_s) / length_s
    share = np.clip((time_s - leg * (length_s + 6.0) - length_s) / 6.0, 0.0, 1.0)
    smooth = share * share * (3 - 2 * share)
    east = np.where(leg % 2 == 0, along, 1.0 - along) * per_strip * base
    north = (leg + smooth) * side
    up = height * (1.0 + 0.15 * np.where(leg % 2 == 0, smooth, 1.0 - smooth))
    heading = np.deg2rad(90.0 + 180.0 * (leg + smooth))
    roll = np.deg2rad(3.0) * np.sin(time_s * 0.9) + np.deg2rad(1.0) * np.sin(time_s * 2.3)
    pitch = np.deg2rad(2.5) * np.sin(time_s * 0.7 + 1.0)
    quat = frames.quat_from_mat(frames.mat_local_ins(heading, pitch, roll))
    position = np.stack([east, north, up], axis=1)
    velocity = np.gradient(position, 0.01, axis=0)
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])) / 0.01
    rate = np.concatenate([turn[:1], (turn[1:] + turn[:-1]) / 2.0, turn[-1:]])
    stamps = START_NS + np.rint(time_s * 1e9).astype(np.int64)
    zero = np.zeros_like(position)
    covered = np.append(np.ones(len(stamps) - 1, np.bool_), False)
    trajectory = Trajectory(FRAME, stamps, position, velocity, quat, rate, zero, zero, covered)
    exposed = np.concatenate(
        [n * (length_s + 6.0) + (np.arange(per_strip) + 0.5) * base / speed for n in range(strips)]
    )
    utc_ns = START_NS + np.rint(exposed * 1e9).astype(np.int64)
    ground = np.column_stack(
        [
            rng.uniform(-25, per_strip * base + 25, points),
            rng.uniform(-25, (strips - 1) * side + 25, points),
            np.zeros(points),
        ]
    )
    ground[:, 2] = relief(ground[:, :2])
    rows = []
    for image, moment in enumerate(utc_ns.tolist()):
        for point, pixel in seen_at(trajectory, camera, moment, ground):
            rows.append((image, point, pixel))
    return Flown(trajectory, camera, utc_ns - round(camera.timeshift_s * 1e9), ground, rows)


def relief(plan_m: Array) -> Array:
    """Rolling ground."""
    return np.asarray(2.0 * np.sin(plan_m[:, 0] / 17.0) + 1.5 * np.cos(plan_m[:, 1] / 13.0))


def seen_at(trajectory: Trajectory, camera: RigCamera, utc_ns: int, points: Array) -> list[tuple[int, Array]]:
    """True pixels of the points in one image, its shutter rolling."""
    pixel = np.tile([camera.camera.width_px / 2.0, camera.camera.middle_row_px], (len(points), 1))
    inside = np.ones(len(points), np.bool_)
    for _ in range(4 if camera.line_delay_s else 1):
        row = np.clip(np.nan_to_num(pixel[:, 1]), 0, camera.camera.height_px)
        later = np.rint((row - camera.camera.middle_row_px) * camera.line_delay_s * 1e9).astype(np.int64)
        poses = trajectory.at(utc_ns + later)
        mat = frames.mat_from_quat(poses.quat_local_ins_wxyz)
        body = np.einsum("nji,nj->ni", mat, points - poses.position_m)
        pixel, inside = camera.camera.project(body @ camera.mat_cam_ins.T + camera.origin_cam_m)
    return [(int(n), pixel[n]) for n in np.flatnonzero(inside)]


def name_of(image: int) -> str:
    """Of an image."""
    return f"img{image:03d}.jpg"


def site() -> Site:
    """Where the flight was."""
    return in_frame(FRAME, 32633)


def disturbed(flown: Flown, seed: int, place_m: Array, turn_deg: Array) -> Trajectory:
    """The trajectory with errors that are other ones at each image: a curve through independent normal deviates."""
    rng = np.random.default_rng(seed)
    trajectory, utc = flown.trajectory, flown.stamp_ns + round(flown.camera.timeshift_s * 1e9)
    at = (trajectory.time_ns - START_NS) * 1e-9
    knots = (utc - START_NS) * 1e-9
    errors = rng.normal(0, 1, (len(knots), 6)) * np.concatenate([place_m, np.deg2rad(turn_deg)])
    curve = np.stack([_held(at, knots, column) for column in errors.T], axis=1)
    heading, pitch, roll = frames.attitude_of(frames.mat_from_quat(trajectory.quat_local_ins_wxyz))
    mat = frames.mat_local_ins(heading + curve[:, 5], pitch + curve[:, 4], roll + curve[:, 3])
    count = len(at)
    return replace(
        trajectory, position_m=trajectory.position_m + curve[:, :3], quat_local_ins_wxyz=frames.quat_from_mat(mat),
        sigma_position_m=np.tile(place_m, (count, 1)), sigma_attitude_rad=np.tile(np.deg2rad(turn_deg), (count, 1)),
    )  # fmt: skip


def _held(at: Array, knots: Array, values: Array) -> Array:
    """Constant for a second about each knot, straight between."""
    times = np.concatenate([[knots - 0.5], [knots + 0.5]]).T.ravel()
    return np.asarray(np.interp(at, times, np.repeat(values, 2)))


def write_block(
    flown: Flown, folder: Path, rig: RigCamera, trajectory: Trajectory, noise_px: float, seed: int = 1, checks: int = 20
) -> None:
    """trajectory.csv, rig.yaml, points.csv, start.csv (with stamps only of use) and control.csv whose points are all check points."""
    rng = np.random.default_rng(seed)
    write_trajectory(folder / "trajectory.csv", trajectory)
    write_rig(folder / "rig.yaml", Rig((rig,)))
    lines = ["image,point,x_px,y_px,sigma"]
    for image, point, pixel in flown.rows:
        x, y = pixel + rng.normal(0, noise_px, 2)
        lines.append(f"{name_of(image)},{point},{x:.4f},{y:.4f},{noise_px}")
    (folder / "points.csv").write_text("\n".join(lines) + "\n")
    count = len(flown.stamp_ns)
    nothing = np.full((count, 3), np.nan)
    names = tuple(name_of(n) for n in range(count))
    write_poses(
        folder / "start.csv",
        ImagePoses(names, flown.stamp_ns, np.zeros((count, 3)), np.zeros((count, 3)), nothing, nothing),
    )
    times = "\n".join(f"{name},{stamp}" for name, stamp in zip(names, flown.stamp_ns.tolist(), strict=True))
    (folder / "times.csv").write_text(f"image,utc_ns\n{times}\n")
    rays = np.bincount([point for _, point, _ in flown.rows], minlength=len(flown.points_m))
    chosen = rng.choice(np.flatnonzero(rays >= 3), checks, replace=False)
    lines = ["name,x,y,z,sigma,use"]
    for point, place in zip(chosen.tolist(), site().map(flown.points_m[chosen]).tolist(), strict=True):
        lines.append(f"{point},{place[0]:.4f},{place[1]:.4f},{place[2]:.4f},0.01,check")
    (folder / "control.csv").write_text("\n".join(lines) + "\n")
