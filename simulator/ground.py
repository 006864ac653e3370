"""The undulating ground of the village."""

import numpy as np
import numpy.typing as npt

from simulator.meshes import height_grid, quad
from simulator.parts import Parts

Array = npt.NDArray[np.float64]


def ground_height(x_m: Array, y_m: Array) -> Array:
    """Relief of the undulating ground: 12 cm over 20 m and 5 cm over 7 m, flat at 0 round the house; shape as given [m]."""
    relief = 0.12 * np.sin(2 * np.pi * x_m / 20.0 + 0.4) * np.cos(2 * np.pi * y_m / 23.0)
    relief += 0.05 * np.sin(2 * np.pi * (x_m + 0.6 * y_m) / 7.0)
    outside_m = np.maximum(np.abs(x_m) - 22.0, np.abs(y_m) - 8.0)
    return np.asarray(relief * np.clip(outside_m / 4.0, 0.0, 1.0))


def add_ground(parts: Parts, half_m: float, step_m: float, rng: np.random.Generator, grass_m: float = 0.015) -> None:
    """Undulating grass with a street of asphalt, and bare soil far out."""
    axis = np.arange(-half_m, half_m + step_m / 2, step_m)
    x, y = np.meshgrid(axis, axis)
    z = ground_height(x, y) + rng.normal(scale=grass_m, size=x.shape)
    street = np.abs(y + 21.0) < 3.0
    z[street] = -0.12
    triangles = height_grid(axis, axis, z)
    middle = triangles.mean(axis=1)
    on_street = np.abs(middle[:, 1] + 21.0) < 3.0 - step_m
    parts.add("grass", "grass", triangles[~on_street])
    parts.add("street", "asphalt", triangles[on_street])
    far_m = 300.0
    for west, south, east, north in (
        (-far_m, -far_m, far_m, -half_m),
        (-far_m, half_m, far_m, far_m),
        (-far_m, -half_m, -half_m, half_m),
        (half_m, -half_m, far_m, half_m),
    ):
        parts.add("far ground", "soil", quad((west, south, -0.2), (east - west, 0, 0), (0, north - south, 0)))
