"""Two clouds of one place with known truth of what moved between them, made without flying: surfaces that are functions of the place.

x east, y north, z up, metres. Random numbers come from the seed alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Heights = Callable[[Array], Array]


@dataclass(frozen=True, slots=True)
class Pair:
    """Two epochs.

    Attributes
    ----------
    a, b : ndarray, shape (n, 3)
    before, after : callable
        True heights at places, shape (n, 2) -> (n,).
    side_m : float
    """

    a: Array
    b: Array
    before: Heights
    after: Heights
    side_m: float

    def volumes(self, cell_m: float = 0.05) -> tuple[float, float]:
        """True volume lost and gained [m3]."""
        axis = np.arange(cell_m / 2, self.side_m, cell_m)
        xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        by = (self.after(xy) - self.before(xy)) * cell_m**2
        return float(-by[by < 0].sum()), float(by[by > 0].sum())


def rough(seed: int, slope: tuple[float, float] = (0.0, 0.0), stones_m: float = 0.06) -> Heights:
    """Terrain of waves from 20 m down to 1 m, the shortest as high as stones."""
    rng = np.random.default_rng(seed)
    waves = [
        (2 * np.pi / length * np.array([np.cos(turn), np.sin(turn)]), height, phase)
        for length, height in (
            (20.0, 0.5),
            (9.0, 0.2),
            (5.0, 0.12),
            (3.0, 1.3 * stones_m),
            (2.0, stones_m),
            (1.2, 0.5 * stones_m),
        )
        for turn, phase in rng.uniform(0, 2 * np.pi, (3, 2))
    ]

    def height(xy: Array) -> Array:
        z = slope[0] * xy[:, 0] + slope[1] * xy[:, 1]
        for wave, by, phase in waves:
            z = z + by / 3 * np.sin(xy @ wave + phase)
        return np.asarray(z)

    return height


def sampled(rng: np.random.Generator, height: Heights, side_m: float, per_m2: float, noise_m: float) -> Array:
    """Points of a surface with noise in height, and a quarter of it across."""
    xy = rng.uniform(0, side_m, (int(side_m**2 * per_m2), 2))
    xyz = np.column_stack([xy, height(xy)])
    return np.asarray(xyz + rng.normal(0, 1, xyz.shape) * (noise_m / 4, noise_m / 4, noise_m))


def eroded(seed: int, side_m: float = 30.0, per_m2: float = 200.0, noise_m: float = 0.02, deep_m: float = 0.25) -> Pair:
    """A gully cut into a slope and a fan below it, smooth at their edges."""
    rng = np.random.default_rng(seed)
    before = rough(seed + 1000, (0.15, 0.05))
    x, y = rng.uniform(0.3, 0.7, 2) * side_m

    def after(xy: Array) -> Array:
        gully = np.exp(-(((xy[:, 0] - x - 6.0) / 3.5) ** 2) - ((xy[:, 1] - y) / 1.2) ** 2)
        fan = np.exp(-(((xy[:, 0] - x + 6.0) / 2.5) ** 2) - ((xy[:, 1] - y) / 2.5) ** 2)
        return np.asarray(before(xy) - deep_m * gully + 0.6 * deep_m * fan)

    a, b = (sampled(rng, each, side_m, per_m2, noise_m) for each in (before, after))
    return Pair(a, b, before, after, side_m)
