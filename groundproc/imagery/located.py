"""Images that know their place from EXIF alone, and the views that matching begins with."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.geodesy import LocalFrame, utm_epsg
from groundproc.imagery.assembly import Known, from_camera_poses
from groundproc.imagery.bundle.block import PosePriors
from groundproc.imagery.photos import Picture
from groundproc.imagery.rig import Rig
from groundproc.imagery.site import Site, in_frame
from groundproc.imagery.ties import Views

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

GIMBAL_SIGMA_RAD: Final = np.deg2rad([5.0, 5.0, 10.0])
"""Of a gimbal's or an autopilot's attitude: its heading is a compass's."""


def site_of(pictures: Sequence[Picture], epsg: str | int | None) -> Site | None:
    """Where pictures were taken; None where none says."""
    fixes = [one.fix for one in pictures if one.fix is not None]
    if not fixes:
        return None
    latitude, longitude, height = (
        float(np.median([getattr(fix, name) for fix in fixes]))
        for name in ("latitude_deg", "longitude_deg", "height_m")
    )
    return in_frame(LocalFrame(latitude, longitude, height), epsg or utm_epsg(latitude, longitude))


def known_of(pictures: Sequence[Picture], rig: Rig, camera: Ints, site: Site) -> Known:
    """Observed places of all pictures that state one; poses only where these lie on a line.

    Attitudes that pictures state are good for footprints, and wrong by half a turn where a program has turned the picture; with places
    that are spread, points tell them better.
    """
    count = len(pictures)
    place, mat = np.zeros((count, 3)), np.tile(np.diag([1.0, -1.0, -1.0]), (count, 1, 1))
    posed, covariance, rows = np.zeros(count, np.bool_), [], []
    for number, picture in enumerate(pictures):
        fix = picture.fix
        if fix is None or site.projection is None:
            continue
        frame = site.projection.frame
        place[number] = frame.from_geodetic(
            *(np.array([v]) for v in (fix.latitude_deg, fix.longitude_deg, fix.height_m))
        )[0]
        spread = np.diag([*np.square(fix.sigma_m), np.inf, np.inf, np.inf])
        if picture.mat_enu_camera is not None:
            posed[number], mat[number] = True, picture.mat_enu_camera
        covariance.append(spread)
        rows.append(number)
    known = from_camera_poses(rig, camera, posed, place, mat)
    at = np.array(rows, np.int64)
    on_line = not _spread(place[at])
    if on_line:
        for spread, number in zip(covariance, rows, strict=True):
            if posed[number]:
                spread[np.arange(3, 6), np.arange(3, 6)] = GIMBAL_SIGMA_RAD**2
    zero = np.zeros((len(at), 3))
    arm = np.stack([rig.cameras[n].lever_arm_m for n in camera[at]]) if len(at) else zero
    priors = PosePriors(
        at,
        place[at],
        known.stations.mat_local_ins[at],
        np.array(covariance).reshape(-1, 6, 6),
        arm,
        zero,
        zero,
        np.ones(len(at)),
    )
    return replace(known, priors=priors)


def without_attitudes(known: Known) -> Known:
    """Poses forgotten where observed places alone will lay the block."""
    observed = np.isfinite(np.diagonal(known.priors.covariance, axis1=1, axis2=2))
    if observed[:, 3:].any():
        return known
    return replace(known, posed=np.zeros_like(known.posed))


def _spread(places: Array) -> bool:
    """Whether places, shape (n, 3), lie on no line."""
    if len(places) < 3:
        return False
    values = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(values[1] > 0.05 * values[0])


def ground_of(pictures: Sequence[Picture], place_m: Array) -> float:
    """Height of the ground, local, by heights above take-off; not a number where nobody states them."""
    above = np.array([one.relative_m for one in pictures])
    known = np.isfinite(above) & (above > 1.0)
    return float(np.median(place_m[known, 2] - above[known])) if known.any() else float("nan")


def views_of(known: Known, rig: Rig, camera: Ints, ground_m: float) -> Views:
    """Poses of cameras with how far off they may be: of the pose, the mounting and the clock."""
    stations, at = known.stations, known.station
    mat = stations.mat_local_ins[at]
    lever = np.stack([rig.cameras[number].lever_arm_m for number in camera])
    cam_ins = np.stack([rig.cameras[number].mat_cam_ins for number in camera])
    turn, aside = np.full(len(camera), np.deg2rad(5.0)), np.full(len(camera), 3.0)
    row = {int(s): n for n, s in enumerate(known.priors.station)}
    for image in range(len(camera)):
        one, n = rig.cameras[camera[image]], row.get(int(at[image]))
        if n is None:
            continue
        spread = np.sqrt(np.diag(known.priors.covariance[n]))
        shift_s = one.sigma.get("timeshift_s", 0.0)
        rate, speed = (float(np.linalg.norm(v[at[image]])) for v in (stations.rate_rad_s, stations.velocity_m_s))
        boresight = np.deg2rad(one.sigma.get("boresight_deg", 0.0))
        turn[image] = np.sqrt(np.square(spread[3:]).mean() + boresight**2 + (rate * shift_s) ** 2)
        aside[image] = np.hypot(np.sqrt(np.square(spread[:3]).mean()), speed * shift_s)
    place = stations.place_m[at] + np.einsum("iab,ib->ia", mat, lever)
    posed = known.posed & np.isfinite(turn)
    return Views(place, mat @ np.swapaxes(cam_ins, 1, 2), posed, np.where(posed, turn, np.pi), aside, ground_m)
