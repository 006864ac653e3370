"""Constant errors of three gyros or three accelerometers: scale, misalignment, bias."""

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
