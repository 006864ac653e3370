"""What a cloud's errors are told by: figures of a second of flight, of the whole, and the facade that sections are taken of."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
PASS_NS: Final = 2_000_000_000
"""Points of so long a time are one pass over a facade."""


@dataclass(frozen=True, slots=True)
class CloudFigures:
    """Errors of a cloud after one rigid alignment, and of its floor.

    Attributes
    ----------
    points : int
        Compared.
    unmatched : int
        Points of which no true echo was found: the airframe's, and wrong matches of range.
    covered_share : float
        Part of the floor's points that the trajectory covers.
    point_rms_m, point_median_m, floor_point_rms_m, cloud_floor_ratio : float
        Distance of points from their true echoes, and the ratio of the two RMS values.
    surface_rms_m, surface_median_m, floor_surface_rms_m : float
        Distance from the true plane of the echo; mixed echoes left out.
    facade_m, floor_facade_m, facade_floor_ratio : float
        Thickness of facade patches over all passes: mean over patches without the extreme tenths.
    facade_pass_m, floor_facade_pass_m : float
        The same within passes of 2 s.
    facade_patches : int
    ground_revolution_m, floor_ground_revolution_m, ground_revolution_floor_ratio : float
        RMS difference of ground models of 5 cm between consecutive revolutions.
    ground_strip_m, floor_ground_strip_m, ground_strip_floor_ratio : float
        The same between strips of 10 s with at least one between.
    """

    points: int
    unmatched: int
    covered_share: float
    point_rms_m: float
    point_median_m: float
    floor_point_rms_m: float
    cloud_floor_ratio: float
    surface_rms_m: float
    surface_median_m: float
    floor_surface_rms_m: float
    facade_m: float
    floor_facade_m: float
    facade_floor_ratio: float
    facade_pass_m: float
    floor_facade_pass_m: float
    facade_patches: int
    ground_revolution_m: float
    floor_ground_revolution_m: float
    ground_revolution_floor_ratio: float
    ground_strip_m: float
    floor_ground_strip_m: float
    ground_strip_floor_ratio: float


@dataclass(frozen=True, slots=True)
class Section:
    """A horizontal slice through a facade, seen from above.

    Attributes
    ----------
    centre_m : ndarray, shape (3,)
        On the true wall.
    normal : ndarray, shape (2,)
        Of the wall, east and north.
    half_length_m, half_depth_m, half_height_m : float
        Echoes within these of the centre, along the wall, across it, and in height.
    """

    centre_m: Array
    normal: Array
    half_length_m: float = 6.0
    half_depth_m: float = 0.6
    half_height_m: float = 0.15

    def coordinates(self, points_m: Array) -> Array:
        """Along the wall, out of it, and height, from the centre, shape (n, 3)."""
        away = points_m - self.centre_m
        east, north = self.normal
        along = away[:, 1] * east - away[:, 0] * north
        return np.stack([along, away[:, 0] * east + away[:, 1] * north, away[:, 2]], axis=1)

    def holds(self, hits_m: Array) -> npt.NDArray[np.bool_]:
        """Which true echoes lie in it, shape (n,)."""
        limits = np.array([self.half_length_m, self.half_depth_m, self.half_height_m])
        return np.asarray((np.abs(self.coordinates(hits_m)) <= limits).all(axis=1))


@dataclass(frozen=True, slots=True)
class CloudErrors:
    """What `judge_cloud` finds.

    Attributes
    ----------
    figures : CloudFigures
    time_ns : ndarray of int64, shape (s,)
        Start of each piece of about a second.
    point_rms_m, floor_point_rms_m : ndarray, shape (s,)
        Of its points.
    section_m : ndarray, shape (k, 3)
        Estimated points in the section's coordinates.
    section_time_ns : ndarray of int64, shape (k,)
    """

    figures: CloudFigures
    time_ns: Times
    point_rms_m: Array
    floor_point_rms_m: Array
    section_m: Array
    section_time_ns: Times
