"""Photographs of the rolling ground of `imageblock`, by a renderer that shares nothing with the simulator."""

from pathlib import Path

import imageblock
import numpy as np
import numpy.typing as npt
from imageblock import Flown
from numba import njit
from PIL import Image

from flightlog import frames

Array = npt.NDArray[np.float64]

RAYS: int = 2
"""Across a pixel."""
NOISE: float = 3.0
"""Of a pixel, one sigma, of 255."""


@njit(cache=False, nogil=True)
def _chance(i: int, j: int, octave: int) -> float:
    """A number from 0 to 1 for a node of a grid (Wang's integer hash)."""
    key = np.uint32(i * 73856093 ^ j * 19349663 ^ octave * 83492791)
    key = np.uint32((key ^ np.uint32(61)) ^ (key >> np.uint32(16)))
    key = np.uint32(key * np.uint32(9))
    key = np.uint32(key ^ (key >> np.uint32(4)))
    key = np.uint32(key * np.uint32(0x27D4EB2D))
    key = np.uint32(key ^ (key >> np.uint32(15)))
    return float(key) / 4294967296.0


@njit(cache=False, nogil=True)
def _looks(x: float, y: float) -> float:
    """Brightness of the ground from 0 to 1: noise of six octaves, stones, and tracks."""
    total, size, share = 0.45, 3.0, 0.16
    for octave in range(6):
        u, v = x / size, y / size
        i, j = int(np.floor(u)), int(np.floor(v))
        a, b = u - i, v - j
        a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
        low = _chance(i, j, octave) * (1.0 - a) + _chance(i + 1, j, octave) * a
        high = _chance(i, j + 1, octave) * (1.0 - a) + _chance(i + 1, j + 1, octave) * a
        total += share * (low * (1.0 - b) + high * b - 0.5)
        size, share = size / 2.1, share * 0.85
    i, j = int(np.floor(x / 0.8)), int(np.floor(y / 0.8))
    if _chance(i, j, 11) < 0.35:
        off_x = x / 0.8 - i - 0.25 - 0.5 * _chance(i, j, 12)
        off_y = y / 0.8 - j - 0.25 - 0.5 * _chance(i, j, 13)
        if off_x * off_x + off_y * off_y < (0.08 + 0.15 * _chance(i, j, 14)) ** 2:
            total += 0.5 * (_chance(i, j, 15) - 0.45)
    if abs((x * 0.8 + y * 0.6) % 9.0 - 4.5) < 0.2:
        total -= 0.15
    return min(max(total, 0.0), 1.0)


@njit(cache=False, nogil=True)
def _render(rays: Array, place: Array, mat: Array, out: Array) -> None:
    """Mean brightness of each pixel; rays (h, w, n, 3) in the camera frame, place (h, 3) and matrix (h, 3, 3) of each row."""
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            total = 0.0
            for n in range(rays.shape[2]):
                ray = mat[row] @ rays[row, column, n]
                height = 0.0
                for _ in range(12):
                    far = (height - place[row, 2]) / ray[2]
                    x, y = place[row, 0] + far * ray[0], place[row, 1] + far * ray[1]
                    height = 2.0 * np.sin(x / 17.0) + 1.5 * np.cos(y / 13.0)
                total += _looks(x, y)
            out[row, column] = total / rays.shape[2]


def photographs(flown: Flown, folder: Path, seed: int = 1) -> None:
    """A JPEG of every exposure, its shutter rolling, with noise."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    camera = flown.camera.camera
    inner = (np.arange(RAYS) + 0.5) / RAYS - 0.5
    rays = np.empty((camera.height_px, camera.width_px, RAYS * RAYS, 3))
    row, column = np.mgrid[: camera.height_px, : camera.width_px].astype(np.float64)
    for n, (y, x) in enumerate((y, x) for y in inner for x in inner):
        found, reached = camera.unproject(np.stack([(column + x).ravel(), (row + y).ravel()], axis=1))
        assert reached.all()
        rays[:, :, n] = found.reshape(*row.shape, 3)
    later = (np.arange(camera.height_px) - camera.middle_row_px) * flown.camera.line_delay_s
    for number, stamp in enumerate((flown.stamp_ns + round(flown.camera.timeshift_s * 1e9)).tolist()):
        poses = flown.trajectory.at(stamp + np.rint(later * 1e9).astype(np.int64))
        ins = frames.mat_from_quat(poses.quat_local_ins_wxyz)
        light = np.empty(row.shape)
        mat = np.ascontiguousarray(ins @ flown.camera.mat_cam_ins.T)
        _render(rays, poses.position_m + ins @ flown.camera.lever_arm_m, mat, light)
        shown = 255.0 * light + rng.normal(0.0, NOISE, light.shape)
        picture = Image.fromarray(np.rint(np.clip(shown, 0.0, 255.0)).astype(np.uint8))
        picture.save(folder / imageblock.name_of(number), quality=92)


def write_marks(flown: Flown, control: Path, path: Path, sigma_px: float = 0.3, seed: int = 2) -> None:
    """What a person measures of the points of a control.csv."""
    rng = np.random.default_rng(seed)
    names = {line.split(",")[0] for line in control.read_text().splitlines()[1:]}
    lines = ["image,point,x_px,y_px,sigma"]
    for image, point, pixel in flown.rows:
        if str(point) in names:
            x, y = pixel + rng.normal(0, sigma_px, 2)
            lines.append(f"{imageblock.name_of(image)},{point},{x:.3f},{y:.3f},{sigma_px}")
    path.write_text("\n".join(lines) + "\n")
