"""A camera's lens and pose: rays of its pixels while its shutter rolls, and pixels of points.

The ground tool has a lens model of its own; this one shares nothing with it but the formulas' sources: Brown (1971) as OpenCV writes it,
and the equidistant fish-eye of Kannala & Brandt (2006).
"""

from dataclasses import dataclass
from typing import Final

import numba as nb
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

RADTAN: Final = "radtan"
EQUIDISTANT: Final = "equidistant"
MODELS: Final = (RADTAN, EQUIDISTANT)
_STEPS: Final = 12
STRAIGHT_DOWN: Final = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""Camera (x right, y down, z forward) from ins (right, forward, up): the upper edge of the picture is ahead."""


@dataclass(frozen=True, slots=True)
class Lens:
    """Focal length and principal point [px], distortion model and its coefficients: k1, k2, p1, p2, k3, or k1 to k4."""

    model: str
    focal_px: float
    centre_px: tuple[float, float]
    coefficients: tuple[float, ...] = ()

    def numbers(self) -> Array:
        """As the kernel takes them."""
        full = [*self.coefficients, *[0.0] * (5 - len(self.coefficients))]
        return np.array([self.focal_px, *self.centre_px, *full])

    def project(self, points_m: Array) -> Array:
        """Pixels of points in the camera frame, shape (n, 3); not a number behind a camera that is no fish-eye."""
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.model == EQUIDISTANT:
                across = np.hypot(points_m[:, 0], points_m[:, 1])
                bent = _bent(np.arctan2(across, points_m[:, 2]), self.numbers()[3:7])
                flat = points_m[:, :2] * np.where(across > 0.0, bent / across, 0.0)[:, None]
            else:
                flat = points_m[:, :2] / points_m[:, 2:]
                x, y = flat.T
                k1, k2, p1, p2, k3 = self.numbers()[3:]
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                flat = np.stack(
                    [
                        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                    ],
                    axis=1,
                )
        pixels = self.focal_px * flat + np.array(self.centre_px)
        return np.where((points_m[:, 2] > 1e-6)[:, None] | (self.model == EQUIDISTANT), pixels, np.nan)


def _bent(theta: Array, k: Array) -> Array:
    square = theta * theta
    return np.asarray(theta * (1.0 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])))))


@nb.njit(cache=True, nogil=True)
def rays(
    fish_eye: bool, numbers: npt.NDArray[np.float64], first_row: int, mats: npt.NDArray[np.float64], width: int, samples: int,
    out: npt.NDArray[np.float64],
) -> None:  # fmt: skip
    """Unit rays of the pixels of some rows, samples x samples to a pixel.

    Parameters
    ----------
    fish_eye : bool
    numbers : shape (8,)
        See `Lens.numbers`.
    first_row : int
    mats : shape (rows, 3, 3)
        Local from camera when each row is exposed.
    width, samples : int
    out : shape (rows * width * samples**2, 3)
        Filled: a pixel's samples follow each other.
    """
    n = 0
    for row in range(mats.shape[0]):
        mat = mats[row]
        for column in range(width):
            for i in range(samples):
                for j in range(samples):
                    x = (column + (j + 0.5) / samples - 0.5 - numbers[1]) / numbers[0]
                    y = (first_row + row + (i + 0.5) / samples - 0.5 - numbers[2]) / numbers[0]
                    u, v, w = _unbent(x, y, numbers) if fish_eye else _straight(x, y, numbers)
                    for axis in range(3):
                        out[n, axis] = mat[axis, 0] * u + mat[axis, 1] * v + mat[axis, 2] * w
                    n += 1


@nb.njit(cache=True, nogil=True)
def _straight(x: float, y: float, numbers: npt.NDArray[np.float64]) -> tuple[float, float, float]:
    """Unit ray of an image point with Brown's distortion, by fixed points: distortion is small against the picture."""
    k1, k2, p1, p2, k3 = numbers[3], numbers[4], numbers[5], numbers[6], numbers[7]
    u, v = x, y
    for _ in range(_STEPS):
        r2 = u * u + v * v
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u, v = (
            (x - 2.0 * p1 * u * v - p2 * (r2 + 2.0 * u * u)) / radial,
            (y - p1 * (r2 + 2.0 * v * v) - 2.0 * p2 * u * v) / radial,
        )
    length = np.sqrt(u * u + v * v + 1.0)
    return u / length, v / length, 1.0 / length


@nb.njit(cache=True, nogil=True)
def _unbent(x: float, y: float, numbers: npt.NDArray[np.float64]) -> tuple[float, float, float]:
    """Unit ray of an image point of the fish-eye, by Newton's steps."""
    r = np.sqrt(x * x + y * y)
    theta = min(r, 1.5)
    for _ in range(_STEPS):
        s = theta * theta
        k1, k2, k3, k4 = numbers[3], numbers[4], numbers[5], numbers[6]
        value = theta * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))) - r
        slope = 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + 9.0 * s * k4)))
        theta -= value / slope
    if r < 1e-12:
        return 0.0, 0.0, 1.0
    across = np.sin(theta) / r
    return x * across, y * across, np.cos(theta)


def turn(vector_rad: Array) -> Array:
    """Rotation matrix of a rotation vector, shape (3, 3) (Rodrigues)."""
    angle = float(np.linalg.norm(vector_rad))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector_rad / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)
