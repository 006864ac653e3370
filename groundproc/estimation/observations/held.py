"""A map held to control points and planes: one row for each place that its surface has to go through.

A point on a surface does not fix a point of the cloud, only the distance of the surface along its normal. That surface
is a plane through clusters of many slices. With the plane solved for within, one row is left: distance = survey - sum
of shares x clusters, with the variance of both. Such a row touches all slices that saw the place. It is applied as it
is, and is part of no sparse matrix.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.observations.datum import Datum, find_datum, reach_m
from groundproc.estimation.observations.moments import spots as moments_of
from groundproc.estimation.observations.planes import placed
from groundproc.estimation.observations.rows import Factor, RowBuilder, Unknowns, cross
from groundproc.estimation.observations.spots import WIDEST_M, Spots
from groundproc.estimation.observations.surfaces import RADII_M, Near, Surface, near, surfaces
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.spline import Path
from groundproc.flight.control import ControlPoint

Array = npt.NDArray[np.float64]

NAME: Final = "control"
GATE_M: Final = 0.2


@dataclass(slots=True)
class Held:
    """Control that a stretch of flight is held to.

    Attributes
    ----------
    points : sequence of ControlPoint
        In the local frame.
    spots : Spots
    datum : Datum
    before_m : ndarray, shape (k,)
        Distances of the spots from the surface before, along what they are measured along; not a number where there is none.
    deflation : float
    """

    points: Sequence[ControlPoint]
    spots: Spots
    datum: Datum
    before_m: Array
    deflation: float

    def factor(self, clusters: Clusters, path: Path, unknowns: Unknowns) -> Factor | None:
        """A row for each spot that counts; None where no surface is left."""
        seen, found = self._found(clusters, path)
        rows = [i for i in np.flatnonzero(self.datum.active).tolist() if found[i] is not None]
        if not rows:
            return None
        builder, residual = RowBuilder(len(rows), unknowns), np.empty(len(rows))
        for row, i in enumerate(rows):
            surface = found[i]
            assert surface is not None
            residual[row] = surface.distance_m
            _add(builder, row, surface, seen, path, unknowns)
        return Factor(NAME, residual, builder.matrix(), self.datum.sigma_m[rows], wide=True)

    def report(self, clusters: Clusters, path: Path) -> list[dict[str, Any]]:
        """What stands in quality.json of each point, with its distance from the surface as it lies now."""
        _, found = self._found(clusters, path)
        told = []
        for number, point in enumerate(self.points):
            rows = np.flatnonzero(self.spots.point == number)
            told.append(self._point(point, rows[[found[i] is not None for i in rows]], found))
        return told

    def _point(self, point: ControlPoint, rows: npt.NDArray[np.int64], found: list[Surface | None]) -> dict[str, Any]:
        told: dict[str, Any] = {"name": point.name, "use": "check" if point.check else "control"}
        on = [surface for i in rows if (surface := found[i]) is not None]
        if not on:
            return told | {"state": "not seen"}
        used = bool(self.datum.active[rows].any())
        distances = np.array([surface.distance_m for surface in on])
        sigma = np.array([np.hypot(point.sigma_m, surface.sigma_m) for surface in on])
        if used:
            sigma = self.datum.sigma_m[rows][self.datum.active[rows]] / np.sqrt(len(point.spots()))
        told |= {
            "state": self._state(point, rows),
            "along": np.mean([surface.along for surface in on], axis=0).round(4).tolist(),
            "before_m": float(np.nanmean(self.before_m[rows])) if np.isfinite(self.before_m[rows]).any() else None,
            "after_m": float(distances.mean()),
            "sigma_m": float(np.sqrt(np.mean(np.square(sigma)))),
            "redundancy": float(np.nanmean(self.datum.redundancy[rows])) if used else None,
        }
        if point.radius_m and len(on) >= 3:
            told["tilt_deg"] = _tilt_deg(self.spots.place_m[rows], distances)
        return told

    def _state(self, point: ControlPoint, rows: npt.NDArray[np.int64]) -> str:
        if point.check:
            return "check"
        if self.datum.active[rows].any():
            return "used"
        return "doubtful" if self.datum.doubtful[rows].any() else "rejected"

    def _found(self, clusters: Clusters, path: Path) -> tuple[Near, list[Surface | None]]:
        seen = near(clusters, path, self.spots.place_m, RADII_M[-1])
        return seen, surfaces(seen, self.spots.place_m, self.spots.normals, GATE_M, self.deflation)


def _add(builder: RowBuilder, row: int, surface: Surface, seen: Near, path: Path, unknowns: Unknowns) -> None:
    """What the clusters of a surface, and the whole, move its distance by."""
    rows = surface.rows
    knot, weights, _, _ = moments_of(seen.time_ns[rows], path)
    pull = -surface.shares[:, None, None] * surface.along
    at = np.full(len(rows), row)
    builder.at_times(at, knot, weights, 3, pull)
    builder.at_times(at, knot, weights, 0, -pull @ seen.mats[rows] @ cross(seen.body_m[rows]))
    if "world.turn" in unknowns.names:
        builder.by(at, "world.turn", -pull @ cross(seen.world_m[rows]))
        builder.by(at, "world.shift", pull)


def _tilt_deg(places: Array, distances: Array) -> float:
    """Lean of distances over their places."""
    off = places - places.mean(axis=0)
    lean, *_ = np.linalg.lstsq(off, distances - distances.mean(), rcond=1e-6)
    return float(np.rad2deg(np.linalg.norm(lean)))


def spots_of(points: Sequence[ControlPoint]) -> Spots:
    """The places by which points and planes are held."""
    places = [point.spots() for point in points]
    count = [len(place) for place in places]
    return Spots(
        np.repeat(np.arange(len(points)), count),
        np.concatenate(places),
        np.repeat([point.spot_sigma_m() for point in points], count),
        [point.normal for point, n in zip(points, count, strict=True) for _ in range(n)],
        np.repeat([not point.check for point in points], count),
    )


KEPT: Final = 40_000
"""Clusters of a window that are kept for control, at most."""


def kept_for(points: Sequence[ControlPoint], clusters: Clusters, path: Path, frame: Path) -> Clusters:
    """Clusters of a window that may be of a surface at some control, wherever the whole has to go, in the frame of a coarse path.

    Parameters
    ----------
    points : sequence of ControlPoint
    clusters : Clusters
    path : Path
        Of the window.
    frame : Path
        The same, coarse: what will be corrected.
    """
    seen = near(clusters, path, spots_of(points).place_m, WIDEST_M + RADII_M[-1])
    chosen = np.arange(len(seen.index))
    if len(chosen) > KEPT:
        chosen = np.sort(np.random.default_rng(len(chosen)).choice(chosen, KEPT, replace=False))
    index = seen.index[chosen]
    kept = Clusters(
        clusters.time_ns[index], clusters.xyz_m[index].copy(), clusters.scatter_m2[index], clusters.count[index]
    )
    origin, mats = placed(Clusters(kept.time_ns, np.zeros_like(kept.xyz_m), kept.scatter_m2, kept.count), frame)
    inside = np.linalg.solve(mats.reshape(-1, 3, 3).astype(np.float64), (seen.world_m[chosen] - origin)[:, :, None])
    kept.xyz_m = inside[:, :, 0].astype(np.float32)
    return kept


def together(parts: Sequence[Clusters]) -> Clusters:
    """Clusters of several windows as one."""
    return Clusters(
        np.concatenate([part.time_ns for part in parts]),
        np.concatenate([part.xyz_m for part in parts]),
        np.concatenate([part.scatter_m2 for part in parts]),
        np.concatenate([part.count for part in parts]),
    )


def held_to(
    points: Sequence[ControlPoint], clusters: Clusters, path: Path, covariance: Array, deflation: float
) -> Held | None:
    """Find where the map has to go for its surfaces to meet the control; None where it meets none.

    Parameters
    ----------
    points : sequence of ControlPoint
        In the local frame.
    clusters : Clusters
    path : Path
        Right in itself.
    covariance : ndarray, shape (6, 6)
        Of its turn about the origin and shift.
    deflation : float
        What the lidar's information is divided by.
    """
    spots = spots_of(points)
    seen = near(clusters, path, spots.place_m, reach_m(spots, covariance) + RADII_M[-1])
    datum = find_datum(spots, seen, covariance, deflation)
    if datum is None:
        return None
    placing = datum.placing
    before = np.full(len(spots.point), np.nan)
    moved = seen.moved(placing.mat, placing.about_m, placing.shift_m)
    for i, surface in enumerate(datum.surfaces):
        if surface is not None:
            step = surface.shares @ (moved.world_m[surface.rows] - seen.world_m[surface.rows])
            before[i] = surface.distance_m + step @ surface.along
    return Held(points, spots, datum, before, deflation)
