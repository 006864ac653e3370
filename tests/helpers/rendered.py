"""Pictures of a box on a plain, by rays and arithmetic of their own: what a camera sees, and what of points it cannot."""

from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
import rasterio

from groundproc.imagery.camera import Camera
from groundproc.imagery.poses import NO_TIME, ImagePoses, write_poses
from groundproc.imagery.rig import Rig, RigCamera, write_rig
from groundproc.imagery.rotations import mat_world_camera

Array = npt.NDArray[np.float64]

LOW = np.array([-5.0, -4.0, 0.0])
HIGH = np.array([5.0, 4.0, 8.0])
"""Corners of the box; the plain is at height 0."""
ORIGIN = np.array([500_000.0, 6_480_000.0, 100.0])
"""Where the scene lies on the map: the central meridian of a UTM zone, where grid north is true north."""
EPSG = 32633


def colour_at(xyz: Array) -> Array:
    """What the surfaces look like, shape (n, 3), 0 to 1: waves of some metres, another tint a side."""
    x, y, z = xyz.T
    return np.stack(
        [
            0.5 + 0.3 * np.sin(1.1 * x) * np.cos(0.7 * y + z),
            0.5 + 0.3 * np.sin(0.9 * y + 0.5) * np.cos(0.8 * z + 0.3 * x),
            0.25 + 0.5 * (z > 0.01),
        ],
        axis=1,
    )


def hit(origin: Array, ray: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Distance along rays, shape (n, 3), to the box, infinite where they miss it, and to the plain behind."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (LOW - origin) / ray, (HIGH - origin) / ray
    near, far = np.fmin(one, other).max(axis=1), np.fmax(one, other).min(axis=1)
    box = np.where((near <= far) & (near > 1e-9), near, np.inf)
    plain = np.where(ray[:, 2] < 0, -origin[2] / np.where(ray[:, 2] < 0, ray[:, 2], -1.0), np.inf)
    return np.minimum(box, plain), box < plain


def hidden(origin: Array, xyz: Array) -> npt.NDArray[np.bool_]:
    """Points that the box hides from a place."""
    distance, _ = hit(origin, xyz - origin)
    return distance < 1.0 - 1e-6


@dataclass(frozen=True)
class Shot:
    """A picture: place and angles of the camera, and a factor of its exposure."""

    place_m: Array
    angles_deg: tuple[float, float, float]
    exposure: float = 1.0


CAMERA = Camera(640, 480, 500.0, (322.0, 238.5), "radtan", (-0.08, 0.02, 0.0005, -0.0003))


def shots() -> list[Shot]:
    """A grid of views straight down, and four slanting ones, each with an exposure of its own."""
    found = [
        Shot(np.array([x, y, 40.0]), (0.0, 0.0, kappa), 0.8 + 0.02 * number)
        for number, (x, y, kappa) in enumerate(
            (x, y, 10.0 * x) for x in (-18.0, -6.0, 6.0, 18.0) for y in (-12.0, 0.0, 12.0)
        )
    ]
    slanting = [((0.0, -30.0), (45.0, 0.0, 0.0)), ((0.0, 30.0), (-45.0, 0.0, 180.0))]
    slanting += [((-30.0, 0.0), (0.0, -45.0, -90.0)), ((30.0, 0.0), (0.0, 45.0, 90.0))]
    return found + [Shot(np.array([*xy, 32.0]), angles, 1.05) for xy, angles in slanting]


def picture(shot: Shot, camera: Camera = CAMERA) -> npt.NDArray[np.uint8]:
    """What it shows, shape (height, width, 3)."""
    row, column = np.mgrid[: camera.height_px, : camera.width_px]
    rays, reached = camera.unproject(np.stack([column.ravel(), row.ravel()], axis=1).astype(float))
    assert reached.all()
    mat = mat_world_camera(*np.deg2rad(np.array(shot.angles_deg))[:, None])[0]
    world = rays @ mat.T
    distance, _ = hit(shot.place_m, world)
    values = shot.exposure * colour_at(shot.place_m + world * np.where(np.isfinite(distance), distance, 0.0)[:, None])
    return np.rint(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8).reshape(camera.height_px, camera.width_px, 3)


def write_block(folder: Path, taken: list[Shot], camera: Camera = CAMERA, epsg: int | None = EPSG) -> None:
    """Pictures, poses.csv and rig.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, shot in enumerate(taken):
        shown = picture(shot, camera)
        with rasterio.open(
            folder / f"{number:02d}.png", "w", driver="PNG", width=camera.width_px, height=camera.height_px, count=3, dtype="uint8"
        ) as file:  # fmt: skip
            file.write(np.moveaxis(shown, -1, 0))
    origin = ORIGIN if epsg is not None else np.zeros(3)
    nothing = np.full((len(taken), 3), np.nan)
    poses = ImagePoses(
        tuple(f"{number:02d}.png" for number in range(len(taken))),
        np.full(len(taken), NO_TIME),
        np.array([shot.place_m for shot in taken]) + origin,
        np.deg2rad([shot.angles_deg for shot in taken]),
        nothing,
        nothing,
    )
    write_poses(folder / "poses.csv", poses)
    write_rig(folder / "rig.yaml", Rig((RigCamera("cam0", camera),)))


def points(density: float, seed: int, noise_m: float = 0.015) -> tuple[Array, Array]:
    """Points of plain and box, so many a square metre, as measured and as they are, shape (n, 3)."""
    rng = np.random.default_rng(seed)
    plain = rng.uniform([-25.0, -20.0], [25.0, 20.0], (int(2000 * density), 2))
    inside = ((plain > LOW[:2]) & (plain < HIGH[:2])).all(axis=1)
    faces = [np.column_stack([plain[~inside], np.zeros((~inside).sum())])]
    size = HIGH - LOW
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        for side in (LOW[axis], HIGH[axis]) if axis < 2 else (HIGH[2],):
            face = rng.uniform(LOW, HIGH, (int(density * size[others].prod()), 3))
            face[:, axis] = side
            faces.append(face)
    true = np.concatenate(faces)
    true = true[rng.permutation(len(true))]
    return true + rng.normal(0.0, noise_m, true.shape), true


def write_cloud(path: Path, xyz: Array, epsg: int | None = EPSG, point_format: int = 6) -> None:
    """A LAZ file of points."""
    header = laspy.LasHeader(version="1.4" if point_format >= 6 else "1.2", point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, ORIGIN if epsg is not None else np.zeros(3)
    if epsg is not None and point_format >= 6:
        header.add_crs(pyproj.CRS.from_epsg(epsg))
    las = laspy.LasData(header)
    las.xyz = xyz + (ORIGIN if epsg is not None else 0.0)
    las.intensity = np.arange(len(xyz)) % 65536
    las.write(path)
