"""A camera: its lens model and sensor; rays to pixels and back, with analytic derivatives."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import UsageError
from groundproc.imagery import lenses

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

NONE: Final = "none"
RADTAN: Final = "radtan"
EQUIDISTANT: Final = "equidistant"
PHOTOGRAMMETRIC: Final = "brown_photogrammetric"
POLYNOMIAL: Final = "fisheye_polynomial"
KINDS: Final = {
    NONE: lenses.RADTAN,
    RADTAN: lenses.RADTAN,
    EQUIDISTANT: lenses.EQUIDISTANT,
    PHOTOGRAMMETRIC: lenses.PHOTOGRAMMETRIC,
    POLYNOMIAL: lenses.POLYNOMIAL,
}
"""Distortion models by their name in rig.yaml."""
COEFFICIENTS: Final = {
    NONE: (),
    RADTAN: ("k1", "k2", "p1", "p2", "k3"),
    EQUIDISTANT: ("k1", "k2", "k3", "k4"),
    PHOTOGRAMMETRIC: ("k1", "k2", "p1", "p2", "k3"),
    POLYNOMIAL: ("p0", "p1", "p2", "p3"),
}
"""Names of the coefficients, in their order."""
_MOST_TANGENT: Final = np.tan(np.deg2rad(89.0))
_MOST_ANGLE: Final = np.deg2rad(179.0)


@dataclass(frozen=True, slots=True)
class Camera:
    """Lens and sensor of a camera.

    Attributes
    ----------
    width_px, height_px : int
    focal_px : float
        In x. Of a fish-eye: pixels a radian on the axis.
    centre_px : tuple of float
        Principal point; (0, 0) is the centre of the upper left pixel.
    model : str
        Distortion model, a key of `COEFFICIENTS`.
    coefficients : tuple of float
        In the order of `COEFFICIENTS`; those left out at the end are 0.
    aspect : float
        Focal length in y over that in x.
    pixel_mm : float
        Width of a pixel, which a model in millimetres needs; 0 where unknown.
    skew_px : tuple of float
        What y adds to u and x adds to v, as the vendor's affine matrix has it.
    """

    width_px: int
    height_px: int
    focal_px: float
    centre_px: tuple[float, float]
    model: str = NONE
    coefficients: tuple[float, ...] = ()
    aspect: float = 1.0
    pixel_mm: float = 0.0
    skew_px: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.model not in KINDS:
            raise UsageError(f"distortion model {self.model!r}: expected one of {', '.join(KINDS)}")
        most = len(COEFFICIENTS[self.model])
        if len(self.coefficients) > most:
            raise UsageError(f"{self.model}: {len(self.coefficients)} coefficients found, expected {most} at most")
        numbers = (self.focal_px, *self.centre_px, *self.coefficients, self.aspect, self.pixel_mm, *self.skew_px)
        if not (np.isfinite(numbers).all() and self.focal_px > 0.0 and self.aspect > 0.0):
            raise UsageError(f"camera: focal length {self.focal_px} px, aspect {self.aspect}; expected more than 0")
        if self.model == PHOTOGRAMMETRIC and not self.pixel_mm > 0.0:
            raise UsageError(f"{self.model}: its coefficients are in mm, expected pixel_mm above 0")

    @property
    def kind(self) -> int:
        """Number of the model for the kernels of `lenses`."""
        return KINDS[self.model]

    @property
    def names(self) -> tuple[str, ...]:
        """What can be estimated: f, pu, pv, aspect and the coefficients of its model."""
        return ("f", "pu", "pv", "aspect", *COEFFICIENTS[self.model])

    def place_of(self, name: str) -> int:
        """Where a value stands in the lens vector.

        Raises
        ------
        UsageError
            The model has no such value.
        """
        fixed = {"f": lenses.FOCAL, "aspect": lenses.ASPECT, "pu": lenses.PU, "pv": lenses.PV}
        if name in fixed:
            return fixed[name]
        if name not in COEFFICIENTS[self.model]:
            raise UsageError(f"{name!r}: a camera with {self.model} has {', '.join(self.names)}")
        return lenses.COEFFICIENT + COEFFICIENTS[self.model].index(name)

    def values(self) -> dict[str, float]:
        """All that can be estimated, by name."""
        lens = self.lens()
        return {name: float(lens[self.place_of(name)]) for name in self.names}

    def with_values(self, changes: Mapping[str, float]) -> "Camera":
        """The same camera with some values changed."""
        values = self.values() | {name: float(value) for name, value in changes.items()}
        return replace(
            self,
            focal_px=values["f"],
            centre_px=(values["pu"], values["pv"]),
            aspect=values["aspect"],
            coefficients=tuple(values[name] for name in COEFFICIENTS[self.model]),
        )

    def lens(self) -> Array:
        """The lens vector of the kernels, shape (lenses.SIZE,)."""
        lens = np.zeros(lenses.SIZE)
        lens[[lenses.FOCAL, lenses.ASPECT, lenses.PU, lenses.PV]] = self.focal_px, self.aspect, *self.centre_px
        lens[lenses.COEFFICIENT : lenses.COEFFICIENT + len(self.coefficients)] = self.coefficients
        lens[lenses.PIXEL_MM], lens[lenses.SKEW], lens[lenses.SKEW + 1] = self.pixel_mm, *self.skew_px
        lens[lenses.FARTHEST] = farthest(self.kind, lens)
        return lens

    def project(self, points_m: Array) -> tuple[Array, Mask]:
        """Pixels of points in the camera frame.

        Parameters
        ----------
        points_m : ndarray, shape (n, 3)
            x right, y down, z forward; any length of the vectors.

        Returns
        -------
        pixels : ndarray, shape (n, 2)
            Not a number where the model does not reach: behind the camera, or beyond where distortion would fold back.
        inside : ndarray of bool, shape (n,)
            Reached, and within the picture.
        """
        points = np.ascontiguousarray(points_m, np.float64)
        pixels, reached = np.empty((len(points), 2)), np.empty(len(points), np.bool_)
        lenses.project_all(self.kind, self.lens(), points, pixels, reached)
        return pixels, reached & self.holds(pixels)

    def holds(self, pixels: Array, margin_px: float = 0.0) -> Mask:
        """Which pixels, shape (n, 2), lie in the picture, at least a margin from its edge."""
        size = np.array([self.width_px, self.height_px])
        with np.errstate(invalid="ignore"):
            return np.asarray(((pixels >= margin_px - 0.5) & (pixels <= size - 0.5 - margin_px)).all(axis=1))

    def unproject(self, pixels: Array) -> tuple[Array, Mask]:
        """Unit rays of pixels, shape (n, 2), in the camera frame, shape (n, 3), and which of them the model reaches."""
        given = np.ascontiguousarray(pixels, np.float64)
        rays, reached = np.empty((len(given), 3)), np.empty(len(given), np.bool_)
        lenses.unproject_all(self.kind, self.lens(), given, rays, reached)
        return rays, reached

    def compare(self, points_m: Array, pixels: Array) -> tuple[Array, Array, Array, Mask]:
        """Residuals of measured pixels with their derivatives.

        Parameters
        ----------
        points_m : ndarray, shape (n, 3)
            In the camera frame.
        pixels : ndarray, shape (n, 2)
            Measured.

        Returns
        -------
        residual : ndarray, shape (n, 2)
            Predicted minus measured [px]; with `brown_photogrammetric` pinhole minus corrected measurement.
        by_point : ndarray, shape (n, 2, 3)
        by_lens : ndarray, shape (n, 2, lenses.FREE)
        reached : ndarray of bool, shape (n,)
        """
        points, measured = np.ascontiguousarray(points_m, np.float64), np.ascontiguousarray(pixels, np.float64)
        count = len(points)
        residual, by_point = np.zeros((count, 2)), np.zeros((count, 2, 3))
        by_lens, reached = np.zeros((count, 2, lenses.FREE)), np.empty(count, np.bool_)
        lenses.compare_all(self.kind, self.lens(), points, measured, residual, by_point, by_lens, reached)
        return residual, by_point, by_lens, reached

    @property
    def middle_row_px(self) -> float:
        """The row that the time of an image belongs to."""
        return (self.height_px - 1) / 2.0


def farthest(kind: int, lens: Array) -> float:
    """Where a model folds back: the least positive root of the slope of its radial part; beyond it two rays share a pixel."""
    if kind == lenses.POLYNOMIAL:
        scale = 2.0 / np.pi
        slope = [lens[5], 2.0 * lens[6] * scale, 3.0 * lens[7] * scale**2]
        return _least_root(slope, _MOST_ANGLE)
    if kind == lenses.EQUIDISTANT:
        k1, k2, k3, k4 = lens[4:8]
        return float(np.sqrt(_least_root([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4], _MOST_ANGLE**2)))
    k1, k2, k3 = lens[[4, 5, 8]]
    most = _MOST_TANGENT if kind == lenses.RADTAN else 1e6
    return float(np.sqrt(_least_root([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3], most**2)))


def _least_root(coefficients: list[float], most: float) -> float:
    """The least positive real root of a polynomial, the constant first, or `most`."""
    roots = np.roots(np.trim_zeros(np.array(coefficients[::-1], float), "f"))
    real = roots[np.abs(roots.imag) <= 1e-9 * np.maximum(1.0, np.abs(roots))].real
    above = real[(real > 0.0) & (real < most)]
    return float(above.min()) if len(above) else float(most)
