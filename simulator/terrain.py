"""Rough ground whose shape the seed draws, and the low plants that stand on it."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simulator.meshes import height_grid, leaves, quad
from simulator.parts import Parts

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Relief:
    """Heights as a sum of waves in all directions, on a plane that may lean.

    Attributes
    ----------
    amplitude_m, phase_rad : ndarray, shape (waves,)
    wave_1_m : ndarray, shape (waves, 2)
        Wave vectors [rad/m].
    slope : ndarray, shape (2,)
        Rise of the plane towards the east and the north.
    """

    amplitude_m: Array
    phase_rad: Array
    wave_1_m: Array
    slope: Array

    @classmethod
    def drawn(
        cls, rng: np.random.Generator, bands: tuple[tuple[float, float], ...], slope: tuple[float, float] = (0.0, 0.0)
    ) -> "Relief":
        """Five waves for each band of (length [m], RMS [m]); their lengths are within a quarter of the band's."""
        amplitude, phase, wave = [], [], []
        for length_m, rms_m in bands:
            strength = rng.uniform(0.5, 1.0, 5)
            amplitude.append(strength * rms_m * np.sqrt(2.0 / np.square(strength).sum()))
            phase.append(rng.uniform(0.0, 2 * np.pi, 5))
            angle, turn = rng.uniform(0.0, 2 * np.pi, 5), 2 * np.pi / (length_m * rng.uniform(0.75, 1.25, 5))
            wave.append(turn[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))
        return cls(np.concatenate(amplitude), np.concatenate(phase), np.concatenate(wave), np.array(slope))

    def height(self, x_m: Array, y_m: Array) -> Array:
        """Height at places; shape as given [m]."""
        x_m, y_m = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
        z_m = self.slope[0] * x_m + self.slope[1] * y_m
        for amplitude, phase, (east, north) in zip(self.amplitude_m, self.phase_rad, self.wave_1_m, strict=True):
            z_m = z_m + amplitude * np.sin(east * x_m + north * y_m + phase)
        return np.asarray(z_m)

    def at(self, x_m: float, y_m: float, above_m: float = 0.0) -> Array:
        """A point so far above the ground, shape (3,)."""
        return np.array([x_m, y_m, float(self.height(np.array(x_m), np.array(y_m))) + above_m])

    def over(
        self, points_m: tuple[tuple[float, float], ...], heights_m: Array
    ) -> tuple[tuple[float, float, float], ...]:
        """Corner points of a route at heights above the ground."""
        found = (self.at(x, y, h) for (x, y), h in zip(points_m, heights_m.tolist(), strict=True))
        return tuple((float(x), float(y), float(z)) for x, y, z in found)


def add_relief(
    parts: Parts, relief: Relief, half_m: float, step_m: float, rough_m: float, rng: np.random.Generator,
    material: str = "grass",
) -> None:  # fmt: skip
    """Ground with roughness of its own at every grid point, one sigma; a level plane of soil carries on far out where it is flat."""
    axis = np.arange(-half_m, half_m + step_m / 2, step_m)
    x, y = np.meshgrid(axis, axis)
    z = relief.height(x, y) + rng.normal(scale=rough_m, size=x.shape)
    parts.add("ground", material, height_grid(axis, axis, z))
    if not relief.slope.any():
        far_m, low_m = 300.0, float(z.min())
        for west, south, east, north in (
            (-far_m, -far_m, far_m, -half_m),
            (-far_m, half_m, far_m, far_m),
            (-far_m, -half_m, -half_m, half_m),
            (half_m, -half_m, far_m, half_m),
        ):
            parts.add("far ground", "soil", quad((west, south, low_m), (east - west, 0, 0), (0, north - south, 0)))


def add_plants(
    parts: Parts, name: str, roots_m: Array, size_m: Array, blades: int, rng: np.random.Generator, blade_m: float = 0.1
) -> None:
    """Low plants: so many blades each, within boxes of (width, height) on the ground.

    Parameters
    ----------
    roots_m : ndarray, shape (n, 3)
    size_m : ndarray, shape (n, 2)
    blades : int
    blade_m : float
        Size of a blade.
    """
    count = len(roots_m)
    off = rng.uniform(-0.5, 0.5, (count, blades, 3)) + np.array([0.0, 0.0, 0.5])
    centre = roots_m[:, None] + off * size_m[:, [0, 0, 1]][:, None]
    corners = centre[:, :, None] + rng.normal(scale=blade_m / 2, size=(count, blades, 3, 3)) * np.array([0.5, 0.5, 1.3])
    parts.add(name, "leaf", corners.reshape(-1, 3, 3))


def add_bush(parts: Parts, name: str, at: Array, height_m: float, rng: np.random.Generator) -> None:
    """A bush: leaves down to the ground."""
    radii = np.array([0.6, 0.6, 0.5]) * height_m
    parts.add(name, "leaf", leaves(at + np.array([0.0, 0.0, 0.45 * height_m]), radii, int(220 * height_m), 0.12, rng))
