"""A block put together: first poses of all images, points intersected, control and observed poses as rows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError
from groundproc.imagery.bundle.block import (
    CONTROL,
    Block,
    PointRows,
    PosePriors,
    Stations,
    joined_rows,
    no_priors,
    no_rows,
)  # fmt: skip
from groundproc.imagery.bundle.intersection import intersect
from groundproc.imagery.bundle.screen import GROSS, LEAST_ANGLE_RAD, distances
from groundproc.imagery.bundle.solve import solve
from groundproc.imagery.measurements import Measurements, rows_of
from groundproc.imagery.poses import NO_TIME
from groundproc.imagery.rig import Rig
from groundproc.imagery.site import Site
from groundproc.imagery.starting import Placed, Sightings, laid, nothing_placed, place_all, similarity
from groundproc.imagery.tables import Control

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_LEAST_TO_LAY: Final = 3


@dataclass(frozen=True, slots=True)
class Known:
    """Poses of images before the adjustment, of whatever origin, in the local frame.

    Attributes
    ----------
    posed : ndarray of bool, shape (i,)
        Images with a pose.
    stations : Stations
        One for each image, or shared.
    station : ndarray of int64, shape (i,)
    priors : PosePriors
        Observed poses or places.
    """

    posed: Mask
    stations: Stations
    station: Ints
    priors: PosePriors


def unknown_poses(count: int, camera: Ints) -> Known:
    """Nothing is known of any image."""
    zero = np.zeros((count, 3))
    stations = Stations(
        np.full(count, NO_TIME), zero, np.tile(np.eye(3), (count, 1, 1)), zero, zero, np.asarray(camera, np.int64)
    )
    return Known(np.zeros(count, np.bool_), stations, np.arange(count), no_priors())


def from_camera_poses(rig: Rig, camera: Ints, posed: Mask, place_m: Array, mat_local_camera: Array) -> Known:
    """Poses of cameras, shape (i, ...), as stations of their own."""
    known = unknown_poses(len(camera), camera)
    mat_cam_ins = np.stack([rig.cameras[number].mat_cam_ins for number in camera])
    lever = np.stack([rig.cameras[number].lever_arm_m for number in camera])
    mat = mat_local_camera @ mat_cam_ins
    place = place_m - np.einsum("iab,ib->ia", mat, lever)
    return replace(known, posed=posed, stations=replace(known.stations, place_m=place, mat_local_ins=mat))


def control_rows(site: Site, control: Control | None, names: Sequence[str]) -> tuple[PointRows, Array]:
    """Rows of the control points that are used, and the local places of all points that are surveyed for use, shape (p, 3)."""
    places = np.full((len(names), 3), np.nan)
    if control is None:
        return no_rows(), places
    found = rows_of(names, ()) | {name: number for number, name in enumerate(names)}
    use = [n for n, name in enumerate(control.name) if name in found and not control.check[n]]
    if not use:
        return no_rows(), places
    point = np.array([found[control.name[n]] for n in use])
    local = site.local(control.place_m[use])
    places[point] = local
    # along the grid's axes, which the sigmas are stated for
    axes = np.swapaxes(site.mat_local_grid(local), 1, 2)
    order = np.argsort(point)
    point, local, axes, sigma = point[order], local[order], axes[order], control.sigma_m[use][order]
    count = 3 * len(use)
    rows = PointRows(
        np.repeat(point, 3), axes.reshape(-1, 3), np.einsum("nij,nj->ni", axes, local).ravel(), sigma.ravel(), np.ones(count),
        np.full(count, CONTROL),
    )  # fmt: skip
    return rows, places


@dataclass(frozen=True, slots=True)
class Assembled:
    """A block ready to be adjusted.

    Attributes
    ----------
    block : Block
    measured : ndarray of int64, shape (n,)
        Rows of the measurements that are in it.
    unplaced : tuple of str
        Images without a pose; they are left out.
    notes : tuple of str
    """

    block: Block
    measured: Ints
    unplaced: tuple[str, ...]
    notes: tuple[str, ...]


def assemble(
    rig: Rig, images: Sequence[str], camera: Ints, known: Known, measured: Measurements, site: Site, control: Control | None,
    mounting: tuple[tuple[str, ...], ...], more: PointRows | None = None,
) -> Assembled:  # fmt: skip
    """Give every image a first pose and every point a first place.

    Raises
    ------
    CoverageError
        No two images can be posed.
    """
    rows, surveyed = control_rows(site, control, measured.names)
    if more is not None:
        rows = joined_rows(rows, more)
    notes: list[str] = []
    if not known.posed.all():
        known, note = _placed(rig, camera, known, measured, surveyed)
        notes += [note] if note else []
    keep = np.flatnonzero(known.posed)
    unplaced = tuple(images[number] for number in np.flatnonzero(~known.posed).tolist())
    if len(keep) < 2:
        raise CoverageError(
            f"{len(keep)} of {len(images)} images can be posed: too few points in common, or no start; expected two at least"
        )
    known, image_row, camera = _only(known, keep, camera)
    points = measured.points
    inside = np.flatnonzero(image_row[points.image] >= 0)
    chosen = points.masked(image_row[points.image] >= 0)
    chosen = replace(chosen, image=image_row[chosen.image])
    block = Block(
        rig, tuple(images[number] for number in keep.tolist()), camera, known.station, known.stations,
        np.zeros((len(measured.names), 3)), chosen, rows, known.priors, mounting,
    )  # fmt: skip
    places, angle = intersect(block)
    surveyed_too = finite(surveyed)
    places = np.where(surveyed_too[:, None], surveyed, places)
    bad = ~finite(places) | ((angle < LEAST_ANGLE_RAD) & ~surveyed_too)
    weight = np.where(bad[chosen.point], 0.0, chosen.weight)
    middle = np.nanmean(np.where(bad[:, None], np.nan, places), axis=0) if not bad.all() else np.zeros(3)
    block = replace(
        block,
        points_m=np.where(bad[:, None], middle, places),
        measured=replace(chosen, weight=weight),
        rows=rows.masked(~bad[rows.point]),
    )
    return Assembled(block, inside, unplaced, tuple(notes))


def finite(places: Array) -> Mask:
    """Which rows, shape (n, m), are numbers throughout."""
    return np.asarray(np.isfinite(places).all(axis=1))


def _only(known: Known, keep: Ints, camera: Ints) -> tuple[Known, Ints, Ints]:
    """What is known of some images alone; the row of each image among them, -1 for those left out; their cameras."""
    image_row = np.full(len(known.posed), -1)
    image_row[keep] = np.arange(len(keep))
    used, station = np.unique(known.station[keep], return_inverse=True)
    names = ("time_ns", "place_m", "mat_local_ins", "velocity_m_s", "rate_rad_s", "lead")
    stations = Stations(*(getattr(known.stations, name)[used] for name in names))
    row = np.full(len(known.stations), -1)
    row[used] = np.arange(len(used))
    priors = known.priors
    inside = row[priors.station] >= 0
    fields = ("place_m", "mat_local_ins", "covariance", "arm_m", "velocity_m_s", "turning_rad_s", "weight")
    chosen = {name: getattr(priors, name)[inside] for name in fields}
    priors = replace(priors, station=row[priors.station[inside]], **chosen)
    return Known(known.posed[keep], stations, station, priors), image_row, camera[keep]


def _placed(rig: Rig, camera: Ints, known: Known, measured: Measurements, surveyed: Array) -> tuple[Known, str]:
    """Poses found for the images that have none."""
    points = measured.points
    ray, reached = np.zeros((len(points), 3)), np.zeros(len(points), np.bool_)
    of_camera = camera[points.image]
    for number, one in enumerate(rig.cameras):
        own = of_camera == number
        ray[own], reached[own] = one.camera.unproject(points.pixel[own])
    sightings = Sightings(points.image[reached], points.point[reached], ray[reached], len(camera), len(measured.names))
    placed = nothing_placed(sightings)
    stations, station = known.stations, known.station
    lever = np.stack([rig.cameras[number].lever_arm_m for number in camera])
    mat_cam_ins = np.stack([rig.cameras[number].mat_cam_ins for number in camera])
    mat = stations.mat_local_ins[station]
    placed.posed[:] = known.posed
    placed.centre_m[:] = stations.place_m[station] + np.einsum("iab,ib->ia", mat, lever)
    placed.mat_world_camera[:] = mat @ np.swapaxes(mat_cam_ins, 1, 2)
    placed.points_m[:] = surveyed
    held = finite(surveyed)
    if not known.posed.any() and held.sum() >= _LEAST_TO_LAY and not _resectable(sightings, held):
        placed.points_m[:] = np.nan
        held = np.zeros_like(held)

    def tidy(placed: Placed) -> None:
        _tidied(rig, camera, measured, placed, held)

    absolute = place_all(sightings, placed, held, tidy)
    note = ""
    if not absolute and placed.posed.any():
        tidy(placed)
        note = _lay(placed, known, surveyed)
    taken = from_camera_poses(rig, camera, placed.posed, placed.centre_m, placed.mat_world_camera)
    assert len(known.stations) == len(camera), "only images of a trajectory share stations, and these have poses"
    velocity = {name: getattr(known.stations, name) for name in ("time_ns", "velocity_m_s", "rate_rad_s", "lead")}
    new = replace(taken.stations, **velocity)
    both = known.posed[known.station]
    new = replace(
        new,
        place_m=np.where(both[:, None], known.stations.place_m, new.place_m),
        mat_local_ins=np.where(both[:, None, None], known.stations.mat_local_ins, new.mat_local_ins),
    )
    return Known(placed.posed.copy(), new, known.station, known.priors), note


def _resectable(sightings: Sightings, held: Mask) -> bool:
    """Whether any image sees enough known points."""
    counts = np.bincount(sightings.image[held[sightings.point]], minlength=sightings.images)
    return bool(counts.max(initial=0) >= 6)


def _tidied(rig: Rig, camera: Ints, measured: Measurements, placed: Placed, held: Mask) -> None:
    """A free adjustment of what is placed so far, with gross errors left out; in place."""
    keep = np.flatnonzero(placed.posed)
    if len(keep) < 2 or held.any():
        return
    known = from_camera_poses(rig, camera, placed.posed, placed.centre_m, placed.mat_world_camera)
    only, image_row, cameras = _only(known, keep, camera)
    points = measured.points
    good = finite(placed.points_m)
    inside = (image_row[points.image] >= 0) & good[points.point]
    chosen = points.masked(inside)
    chosen = replace(chosen, image=image_row[chosen.image])
    plain = Rig(tuple(replace(one, estimate=(), sigma={}) for one in rig.cameras))
    places = np.where(good[:, None], placed.points_m, 0.0)
    block = Block(plain, tuple(str(n) for n in keep), cameras, only.station, only.stations, places, chosen)
    for _ in range(2):
        distance, reached = distances(block)
        usual = float(np.median(distance[reached])) if reached.any() else 1.0
        weight = np.where(reached & (distance < GROSS / 2.0 * max(usual, 0.5)), 1.0, 0.0)
        counts = np.bincount(chosen.point[weight > 0.0], minlength=len(places))
        block = replace(block, measured=replace(block.measured, weight=np.where(counts[chosen.point] > 1, weight, 0.0)))
        block = solve(block, plain.cameras).block
    mats = block.stations.mat_local_ins
    cam_ins = np.stack([plain.cameras[number].mat_cam_ins for number in cameras])
    lever = np.stack([plain.cameras[number].lever_arm_m for number in cameras])
    placed.mat_world_camera[keep] = mats @ np.swapaxes(cam_ins, 1, 2)
    placed.centre_m[keep] = block.stations.place_m + np.einsum("iab,ib->ia", mats, lever)
    placed.points_m[good] = block.points_m[good]


def _lay(placed: Placed, known: Known, surveyed: Array) -> str:
    """Lay a block that lies anywhere on observed places of its images, or on control; what it was laid on, in words."""
    priors = known.priors
    image = {int(s): n for n, s in enumerate(known.station)}
    observed = finite(np.diagonal(priors.covariance, axis1=1, axis2=2)[:, :3])
    rows = [n for n in np.flatnonzero(observed) if placed.posed[image[int(priors.station[n])]]]
    own = np.array([placed.centre_m[image[int(priors.station[n])]] for n in rows]).reshape(-1, 3)
    if len(rows) >= _LEAST_TO_LAY and _spread(own):
        laid(placed, *similarity(own, priors.place_m[rows]))
        return ""
    both = finite(surveyed) & finite(placed.points_m)
    if both.sum() >= _LEAST_TO_LAY and _spread(placed.points_m[both]):
        laid(placed, *similarity(placed.points_m[both], surveyed[both]))
        return ""
    return "nothing says where the block lies: its first image is the origin, and the base of its first pair has length one"


def _spread(places: Array) -> bool:
    """Whether places do not lie on a line."""
    values = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(values[1] > 1e-3 * values[0])
