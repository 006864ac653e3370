"""Corrections of the single lasers as unknowns: a range offset and an elevation offset for each of the 32.

Clusters of different lasers are kept apart, so that each row of the lidar belongs to one laser. A row is linear in the
two unknowns of its laser, as it is in the pose, and the planes are solved for within as before (`planes`). The
coupling of lasers and path is a border of 64 columns, formed once a step.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.planeproducts import RowArrays, solved_plane
from groundproc.sensors.lasers import LaserCorrections
from groundproc.sensors.shots import LaserTable

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

LASERS: Final = 32
"""The most that are estimated; a sensor with fewer leaves the rest as they were, and one with more is refused before."""
KINDS: Final = ("range", "elevation")
"""What is estimated of each laser; the unknowns stand in this order, 32 of each."""
NAMES: Final = tuple(f"lasers.{kind}" for kind in KINDS)
UNKNOWNS: Final = len(KINDS) * LASERS
PRIOR: Final = np.repeat([0.02, np.deg2rad(0.1)], LASERS)
"""What the manual's table may be off by, one sigma: the data sheet's 2 cm, and an assumption of a thirteenth of their spacing."""
STRETCH: Final = 2.0
"""What the sigmas by the rows' weights are stretched by: found with simulated flights. The sandwich is too narrow for one laser against
the others."""
KNOWN: Final = 0.5
"""An offset counts as found where its sigma is below this share of what was known before."""


class LaserArrays(NamedTuple):
    """Laser of each row and what its distance changes by, as kernels take them; see `LaserColumns`."""

    laser: npt.NDArray[np.int32]
    change: npt.NDArray[np.float32]


@dataclass(slots=True)
class LaserColumns:
    """What the rows of the lidar have to do with the lasers' corrections.

    Attributes
    ----------
    laser : ndarray of int32, shape (n,)
        Of each row.
    change : ndarray of float32, shape (n, 2)
        By the laser's range offset [1] and by its elevation [m/rad].
    """

    UNKNOWNS: ClassVar[int] = UNKNOWNS

    laser: npt.NDArray[np.int32]
    change: npt.NDArray[np.float32]

    @property
    def arrays(self) -> LaserArrays:
        """What the kernels take."""
        return LaserArrays(self.laser, self.change)

    def along(self, corrections: Array) -> Array:
        """The rows times corrections, shape (UNKNOWNS,): shape (n,)."""
        by_kind = corrections.reshape(len(KINDS), LASERS)
        return np.asarray(np.einsum("nk,kn->n", self.change, by_kind[:, self.laser]))

    def gradient(self, projected: Array) -> Array:
        """Columns times weighed residuals less their planes, shape (n,): shape (UNKNOWNS,)."""
        return np.concatenate(
            [np.bincount(self.laser, self.change[:, kind] * projected, LASERS) for kind in range(len(KINDS))]
        )


@dataclass(frozen=True, slots=True)
class Corrections:
    """Offsets of the lasers as estimated, to be added to the table that the returns were placed with.

    Attributes
    ----------
    offsets : ndarray, shape (64,)
        Ranges [m], then elevations [rad], in firing order.
    covariance : ndarray, shape (64, 64)
    """

    offsets: Array
    covariance: Array

    def of(self, kind: str) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Offsets of a kind, their sigmas, and which are known well enough to be taken, shape (32,) each; in m and rad."""
        part = self._part(kind)
        sigma = np.sqrt(np.diag(self.covariance)[part])
        return self.offsets[part], sigma, sigma < KNOWN * PRIOR[part]

    def mean(self, kind: str) -> tuple[float, float]:
        """Mean offset of all lasers, and its sigma."""
        part = self._part(kind)
        return float(self.offsets[part].mean()), float(np.sqrt(self.covariance[part, part].mean()))

    def _part(self, kind: str) -> slice:
        first = KINDS.index(kind) * LASERS
        return slice(first, first + LASERS)

    def file(self, lasers: int = LASERS) -> LaserCorrections:
        """What is worth keeping, of the sensor's number of lasers; the others stay as they were."""
        values = {}
        for kind, unit, scale in (("range", "m", 1.0), ("elevation", "deg", np.rad2deg(1.0))):
            value, sigma, found = self.of(kind)
            for name, numbers in ((f"{kind}_{unit}", value), (f"sigma_{kind}_{unit}", sigma)):
                values[name] = tuple(
                    round(float(number), 5) for number in np.where(found, scale * numbers, 0.0)[:lasers]
                )
        return LaserCorrections(**values)

    def report(self) -> dict[str, Any]:
        """What stands in quality.json and calibration.json: in firing order, and the correlation of ranges, then elevations."""
        stated: dict[str, Any] = {}
        for kind, unit, scale in (("range", "m", 1.0), ("elevation", "deg", np.rad2deg(1.0))):
            value, sigma, found = self.of(kind)
            mean, sigma_mean = self.mean(kind)
            stated |= {
                f"{kind}_{unit}": (scale * value).tolist(),
                f"sigma_{kind}_{unit}": (scale * sigma).tolist(),
                f"{kind}_held": (~found).tolist(),
                f"mean_{kind}_{unit}": scale * mean,
                f"sigma_mean_{kind}_{unit}": scale * sigma_mean,
            }
        sigma = np.sqrt(np.diag(self.covariance))
        return stated | {"correlation": (self.covariance / np.outer(sigma, sigma)).round(3).tolist()}

    def figures(self, table: LaserTable) -> dict[str, npt.NDArray[Any]]:
        """The same as plain arrays for pictures, with the elevations of the table that the returns were placed with.

        For each kind (`range`, `m`; `elevation`, `rad`): lasers.KIND_UNIT, KIND_sigma_UNIT, KIND_found (bool), shape (n,); and
        KIND_mean_UNIT, shape (2,): the mean offset and its sigma. lasers.table_elevation_rad, shape (n,).
        """
        made: dict[str, npt.NDArray[Any]] = {"lasers.table_elevation_rad": table.elevation_rad}
        for kind, unit in (("range", "m"), ("elevation", "rad")):
            value, sigma, found = self.of(kind)
            made |= {
                f"lasers.{kind}_{unit}": value[: len(table)],
                f"lasers.{kind}_sigma_{unit}": sigma[: len(table)],
                f"lasers.{kind}_found": found[: len(table)],
                f"lasers.{kind}_mean_{unit}": np.array(self.mean(kind)),
            }
        return made


def stretched(covariance: Array, by: float) -> Array:
    """A covariance of the corrections with what the flight says of them made weaker, and the prior as it was."""
    prior = np.diag(PRIOR**-2.0)
    return np.asarray(np.linalg.inv((np.linalg.inv(covariance) - prior) / by**2 + prior), np.float64)


def columns_of(laser: npt.NDArray[np.int32], xyz_m: npt.NDArray[np.float32], normal: Array) -> LaserColumns:
    """How the distance from a plane changes with the offsets of its laser.

    Parameters
    ----------
    laser : ndarray of int32, shape (n,)
    xyz_m : ndarray of float32, shape (n, 3)
        Clusters in the sensor frame.
    normal : ndarray, shape (n, 3)
        Normals of their planes in the sensor frame.
    """
    level = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    reach = np.hypot(level, xyz_m[:, 2])
    by_range = np.einsum("ni,ni->n", normal, xyz_m) / reach
    # r du/d(elevation): up, and as much back as it is up
    level = np.maximum(level, 1e-6)
    ahead = (normal[:, 0] * xyz_m[:, 0] + normal[:, 1] * xyz_m[:, 1]) / level
    by_elevation = normal[:, 2] * level - ahead * xyz_m[:, 2]
    return LaserColumns(laser, np.stack([by_range, by_elevation], axis=1).astype(np.float32))


def shifted(xyz_m: npt.NDArray[np.float32], laser: npt.NDArray[np.int32], change: Array) -> npt.NDArray[np.float32]:
    """Clusters with their lasers' offsets changed by `change`, shape (UNKNOWNS,) [m, rad]."""
    by_range, by_elevation = change[:LASERS][laser], change[LASERS:][laser]
    level = np.hypot(xyz_m[:, 0], xyz_m[:, 1]).astype(np.float64)
    reach = np.hypot(level, xyz_m[:, 2])
    stretch = 1.0 + by_range / reach
    flat = stretch - by_elevation * xyz_m[:, 2] / np.maximum(level, 1e-6)
    return np.stack(
        [xyz_m[:, 0] * flat, xyz_m[:, 1] * flat, xyz_m[:, 2] * stretch + by_elevation * level], axis=1
    ).astype(np.float32)


@njit(cache=True, nogil=True)
def border_of(rows: RowArrays, lasers: LaserArrays, border: Array, corner: Array) -> None:
    """Normal matrix of corrections and path, and of the corrections alone, planes solved for within; added to the two last."""
    first, knot, inverse = rows.first, rows.knot, rows.inverse
    wide = lasers.change.shape[1] * LASERS
    place, active = np.full(wide, -1, np.int64), np.empty(wide, np.int64)
    sums, off, gathered = np.zeros((wide, 3)), np.zeros((wide, 3)), np.zeros((24, 3))
    for v in range(len(first) - 1):
        count = _sums(v, rows, lasers, place, active, sums)
        for a in range(count):
            off[a, 0], off[a, 1], off[a, 2] = solved_plane(inverse[v], sums[a, 0], sums[a, 1], sums[a, 2])
        for a in range(count):
            for b in range(count):
                corner[active[a], active[b]] -= sums[a, 0] * off[b, 0] + sums[a, 1] * off[b, 1] + sums[a, 2] * off[b, 2]
        for i in range(first[v], first[v + 1]):
            _own(i, rows, lasers, border, corner)
            _gather(i, rows, gathered)
            # rows of one voxel are in order of time: all of a slice at once
            if i + 1 == first[v + 1] or knot[i + 1] != knot[i]:
                _take_off(active[:count], off, gathered, 6 * knot[i], border)
        for a in range(count):
            place[active[a]] = -1


@njit(cache=True, nogil=True, inline="always")
def _sums(v: int, rows: RowArrays, lasers: LaserArrays, place: Ints, active: Ints, sums: Array) -> Any:
    """For each column that a voxel has (`active`, found by `place`) its weighed sums along the plane; returns how many there are."""
    plane, weight, laser, change = rows.plane, rows.weight, lasers.laser, lasers.change
    count = 0
    for i in range(rows.first[v], rows.first[v + 1]):
        for c in range(change.shape[1]):
            column = c * LASERS + laser[i]
            if place[column] < 0:
                place[column] = count
                active[count] = column
                sums[count, :] = 0.0
                count += 1
            at, pull = place[column], weight[i] * change[i, c]
            sums[at, 0] += pull
            sums[at, 1] += pull * plane[i, 0]
            sums[at, 2] += pull * plane[i, 1]
    return count


@njit(cache=True, nogil=True, inline="always")
def _own(i: int, rows: RowArrays, lasers: LaserArrays, border: Array, corner: Array) -> None:
    """A row's own product with its pose and its laser."""
    k, laser, change = rows.knot[i], lasers.laser[i], lasers.change[i]
    weights, jacobian = rows.weights[i], rows.jacobian[i]
    for c in range(len(change)):
        column, pull = c * LASERS + laser, rows.weight[i] * change[c]
        for b in range(len(change)):
            corner[column, b * LASERS + laser] += pull * change[b]
        for j in range(4):
            for e in range(6):
                border[column, 6 * (k + j) + e] += pull * weights[j] * jacobian[e]


@njit(cache=True, nogil=True, inline="always")
def _gather(i: int, rows: RowArrays, gathered: Array) -> None:
    """Add a row's product with its pose and its plane."""
    weights, jacobian, plane, weight = rows.weights[i], rows.jacobian[i], rows.plane[i], rows.weight[i]
    for j in range(4):
        for e in range(6):
            pull = weight * weights[j] * jacobian[e]
            gathered[6 * j + e, 0] += pull
            gathered[6 * j + e, 1] += pull * plane[0]
            gathered[6 * j + e, 2] += pull * plane[1]


@njit(cache=True, nogil=True, inline="always")
def _take_off(active: Ints, off: Array, gathered: Array, start: int, border: Array) -> None:
    """Take what the plane takes off a slice's products, and begin anew."""
    for a in range(len(active)):
        for j in range(24):
            border[active[a], start + j] -= (
                gathered[j, 0] * off[a, 0] + gathered[j, 1] * off[a, 1] + gathered[j, 2] * off[a, 2]
            )
    gathered[:, :] = 0.0
