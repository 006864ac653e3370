"""What is adjusted: cameras, stations, images, points, and what was observed of them."""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from groundproc.imagery.rig import Rig

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

POSE: int = 6
"""Unknowns of a station: place [m], then a small turn in the local frame [rad]."""


@dataclass(frozen=True, slots=True)
class Stations:
    """Poses of the ins at which images were taken; cameras that expose together share one.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (s,)
        As stamped, without the camera's shift; `poses.NO_TIME` where unknown.
    place_m : ndarray, shape (s, 3)
        Of the ins origin, local.
    mat_local_ins : ndarray, shape (s, 3, 3)
    velocity_m_s : ndarray, shape (s, 3)
        Local.
    rate_rad_s : ndarray, shape (s, 3)
        Of the ins, in its own frame. With the velocity it carries a pose to the rows of a rolling shutter; zero where unknown.
    lead : ndarray of int64, shape (s,)
        The camera whose clock the station follows. Cameras that share stations are triggered together: their shifts change by the same.
    """

    time_ns: Ints
    place_m: Array
    mat_local_ins: Array
    velocity_m_s: Array
    rate_rad_s: Array
    lead: Ints

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True, slots=True)
class ImagePoints:
    """Measurements in images, in the order of points.

    Attributes
    ----------
    image, point : ndarray of int64, shape (n,)
    pixel : ndarray, shape (n, 2)
    sigma_px : ndarray, shape (n,)
    weight : ndarray, shape (n,)
        Robust; 0 is left out.
    """

    image: Ints
    point: Ints
    pixel: Array
    sigma_px: Array
    weight: Array

    def __len__(self) -> int:
        return len(self.image)

    def masked(self, kept: Mask) -> "ImagePoints":
        """Some of them."""
        return ImagePoints(self.image[kept], self.point[kept], self.pixel[kept], self.sigma_px[kept], self.weight[kept])


def image_points(image: Ints, point: Ints, pixel: Array, sigma_px: Array) -> ImagePoints:
    """Measurements put in the order of points, all with weight 1."""
    order = np.lexsort((image, point))
    return ImagePoints(image[order], point[order], pixel[order], sigma_px[order], np.ones(len(order)))


@dataclass(frozen=True, slots=True)
class PointRows:
    """What is known of points without images: normal . X = target, in the order of points.

    Attributes
    ----------
    point : ndarray of int64, shape (m,)
    normal : ndarray, shape (m, 3)
    target_m, sigma_m, weight : ndarray, shape (m,)
    source : ndarray of int64, shape (m,)
        0: control, 1: lidar.
    """

    point: Ints
    normal: Array
    target_m: Array
    sigma_m: Array
    weight: Array
    source: Ints

    def __len__(self) -> int:
        return len(self.point)

    def masked(self, kept: Mask) -> "PointRows":
        """Some of them."""
        return PointRows(
            self.point[kept], self.normal[kept], self.target_m[kept], self.sigma_m[kept], self.weight[kept],
            self.source[kept],
        )  # fmt: skip


CONTROL = 0
LIDAR = 1


def no_rows() -> PointRows:
    """Nothing known but by images."""
    none = np.empty(0)
    return PointRows(np.empty(0, np.int64), np.empty((0, 3)), none, none, none, np.empty(0, np.int64))


def joined_rows(first: PointRows, second: PointRows) -> PointRows:
    """Rows of two origins in the order of points."""
    order = np.argsort(np.concatenate([first.point, second.point]), kind="stable")
    columns = (
        np.concatenate([getattr(first, name), getattr(second, name)])[order]
        for name in ("point", "normal", "target_m", "sigma_m", "weight", "source")
    )
    return PointRows(*columns)


@dataclass(frozen=True, slots=True)
class Common:
    """What all observed poses of a trajectory are off together.

    Attributes
    ----------
    late_s, late_sigma_s : float
        By how much its attitudes are later than its places: filters delay an autopilot's gyros, and its receiver has a clock of its own.
        A sigma of 0 holds it.
    centre_m : ndarray, shape (3,)
        What the turn is about.
    moved : ndarray, shape (6,)
        Shift [m] and turn in the local frame [rad] of the trajectory against the truth.
    covariance : ndarray, shape (6, 6), optional
        Of `moved` before; None: it is held.
    cloud : bool
        The lidar's planes were made with the trajectory, and are off with it.
    whole : bool
        Stamps of stations are cut off to whole seconds.
    """

    late_s: float = 0.0
    late_sigma_s: float = 0.0
    centre_m: Array = field(default_factory=lambda: np.zeros(3))
    moved: Array = field(default_factory=lambda: np.zeros(POSE))
    covariance: Array | None = None
    cloud: bool = False
    whole: bool = False

    def shift_m(self, places_m: Array) -> Array:
        """How far places, shape (n, 3), are moved."""
        return np.asarray(self.moved[:3] + np.cross(self.moved[3:], places_m - self.centre_m))


@dataclass(frozen=True, slots=True)
class PosePriors:
    """Observed poses of stations: place + mat arm, and where it is stated attitude.

    Attributes
    ----------
    station : ndarray of int64, shape (k,)
    place_m : ndarray, shape (k, 3)
        Of the point at `arm_m`, at the stamp with the shift that the rig holds now; local.
    mat_local_ins : ndarray, shape (k, 3, 3)
    covariance : ndarray, shape (k, 6, 6)
        Place [m] and turn in the local frame [rad]; infinite on the diagonal where nothing is known.
    arm_m : ndarray, shape (k, 3)
        In the ins frame.
    velocity_m_s, turning_rad_s : ndarray, shape (k, 3)
        What a millisecond of the camera's clock moves.
    weight : ndarray, shape (k,)
        Robust.
    before : ndarray of int64, shape (k,), optional
        Row of the pose before each in time, -1 for none; absent: all poses are independent.
    keep : ndarray, shape (k, 2), optional
        Correlation of errors of place and of turn, in units of their sigmas, with those of the pose before.
    common : Common
        `covariance` is of what is left beside it.
    """

    station: Ints
    place_m: Array
    mat_local_ins: Array
    covariance: Array
    arm_m: Array
    velocity_m_s: Array
    turning_rad_s: Array
    weight: Array
    before: Ints | None = None
    keep: Array | None = None
    common: Common = field(default_factory=Common)

    def __len__(self) -> int:
        return len(self.station)


def no_priors() -> PosePriors:
    """No pose was observed."""
    none, mats = np.empty((0, 3)), np.empty((0, 3, 3))
    return PosePriors(np.empty(0, np.int64), none, mats, np.empty((0, 6, 6)), none, none, none, np.empty(0))


@dataclass(frozen=True, slots=True)
class Block:
    """Values so far, and all observations.

    Attributes
    ----------
    rig : Rig
    images : tuple of str
    camera, station : ndarray of int64, shape (i,)
        Of each image.
    stations : Stations
    points_m : ndarray, shape (p, 3)
        Local.
    measured : ImagePoints
    rows : PointRows
    priors : PosePriors
    mounting : tuple of tuple of str
        For each camera, which of `rig.MOUNTING` are unknown.
    """

    rig: Rig
    images: tuple[str, ...]
    camera: Ints
    station: Ints
    stations: Stations
    points_m: Array
    measured: ImagePoints
    rows: PointRows = field(default_factory=no_rows)
    priors: PosePriors = field(default_factory=no_priors)
    mounting: tuple[tuple[str, ...], ...] = ()

    def with_(self, **changes: object) -> "Block":
        """The same with some attributes changed."""
        return replace(self, **changes)  # type: ignore[arg-type]
