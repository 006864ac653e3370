"""Errors of three gyros or three accelerometers: scale, misalignment, bias, and a bias that wanders."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Triad:
    """What three sensors read of a vector: `matrix @ true + bias`, in one frame.

    Attributes
    ----------
    matrix : ndarray, shape (3, 3)
        Row i is the direction in which sensor i feels, times its scale factor.
    bias : ndarray, shape (3,)
        In the unit of what is measured.
    """

    matrix: Array
    bias: Array

    @classmethod
    def drawn(
        cls,
        rng: np.random.Generator,
        *,
        scale: float,
        scale_fixed: tuple[float, float, float],
        misalignment_deg: float,
        bias: Array | float,
    ) -> "Triad":
        """Draw the errors of one set of sensors.

        Parameters
        ----------
        rng : Generator
            Nine numbers are drawn whatever the sizes are, so that none changes another.
        scale : float
            Relative error of each sensor's scale factor, one sigma.
        scale_fixed : tuple of float
            What comes on top for sensor x, y, z.
        misalignment_deg : float
            Tilt of each sensor's axis towards each of the two others [deg], one sigma.
        bias : ndarray of shape (3,), or float
            The biases themselves, or one sigma of them.
        """
        scales, tilts, biases = rng.standard_normal(3), rng.standard_normal((3, 3)), rng.standard_normal(3)
        matrix = np.radians(misalignment_deg) * tilts
        np.fill_diagonal(matrix, 1.0)
        factors = 1.0 + scale * scales + np.array(scale_fixed)
        return cls(factors[:, None] * matrix, bias * biases if np.ndim(bias) == 0 else np.asarray(bias))

    def read(self, true: Array) -> Array:
        """Readings without noise of true vectors, shape (n, 3)."""
        return np.asarray(true @ self.matrix.T + self.bias)


class Wander:
    """Random walks of three biases, 0 at the start.

    Parameters
    ----------
    rng : Generator
    duration_s : float
    sigma : float
        Of each after a minute, in the unit of what is measured; it grows with the root of time.
    """

    def __init__(self, rng: np.random.Generator, duration_s: float, sigma: float) -> None:
        steps = rng.standard_normal((int(duration_s) + 2, 3)) * sigma / np.sqrt(60.0)
        steps[0] = 0.0
        self._values = np.cumsum(steps, axis=0)

    def at(self, time_s: Array) -> Array:
        """Values at true times, shape (n, 3); straight from second to second."""
        grid_s = np.arange(len(self._values))
        return np.stack([np.interp(time_s, grid_s, column) for column in self._values.T], axis=1)

    def listed(self, every_s: int = 10) -> list[list[float]]:
        """Values at 0, 10, 20 s and so on, as the truth states them."""
        return [row.tolist() for row in self._values[::every_s]]
