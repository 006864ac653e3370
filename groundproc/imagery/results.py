"""What an adjustment leaves: the folder with poses.csv, rig.yaml, bundle.json, points.csv and COLMAP's text files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.files import make_folder, written_aside
from groundproc.imagery import colmap
from groundproc.imagery.bundle.block import LIDAR
from groundproc.imagery.bundle.covariance import CameraPoses, camera_poses, camera_spread, on_map, points_covariance
from groundproc.imagery.bundle.screen import Adjusted
from groundproc.imagery.bundle.solve import image_residuals, row_residuals
from groundproc.imagery.poses import ImagePoses, write_poses
from groundproc.imagery.rig import MOUNTING, Rig, RigCamera, write_rig
from groundproc.imagery.site import Site
from groundproc.imagery.tables import Control, write_points

Array = npt.NDArray[np.float64]

HYBRID: Final = "hybrid"
"""Folder of the poses that go back to the smoother."""
FILES: Final = ("poses.csv", "rig.yaml", "bundle.json", "points.csv", "colmap", HYBRID)


COMMON_SIGMA_M: Final = 0.015
"""Of a cloud as a whole, in height: what all of its planes are off together. However many hold a block, it is not known better."""


def held_by_cloud_m2(adjusted: Adjusted) -> float:
    """Variance in height that a block has from the cloud that holds it; 0 where none does."""
    rows = adjusted.solved.block.rows
    return COMMON_SIGMA_M**2 if ((rows.source == LIDAR) & (rows.weight > 0.0)).any() else 0.0


def place_covariances(adjusted: Adjusted) -> Array:
    """Covariance of the points in the local frame, shape (p, 3, 3)."""
    covariance = points_covariance(adjusted.solved.block, adjusted.found, scale_of(adjusted))
    covariance[:, 2, 2] += held_by_cloud_m2(adjusted)
    return covariance


def rig_after(adjusted: Adjusted) -> Rig:
    """The rig as it was adjusted, with covariances."""
    solved = adjusted.solved
    matrix, sigma0 = adjusted.found.matrix, scale_of(adjusted)
    return Rig(
        tuple(
            replace(one, spread=camera_spread(solved, number, matrix, sigma0) or one.spread)
            for number, one in enumerate(solved.block.rig.cameras)
        )
    )


def scale_of(adjusted: Adjusted) -> float:
    """What cofactors are multiplied by: sigma0, or 1 where nothing is redundant."""
    sigma0 = adjusted.balance.sigma0
    return sigma0 if np.isfinite(sigma0) else 1.0


def local_poses(adjusted: Adjusted) -> CameraPoses:
    """Poses of the cameras in the local frame."""
    solved = adjusted.solved
    poses = camera_poses(solved.block, solved.unknowns, adjusted.found.matrix, scale_of(adjusted))
    poses.covariance[:, 2, 2] += held_by_cloud_m2(adjusted)
    return poses


def map_poses(adjusted: Adjusted, site: Site, utc_ns: npt.NDArray[np.int64]) -> ImagePoses:
    """Poses of the cameras in the coordinates that people use."""
    return on_map(adjusted.solved.block, local_poses(adjusted), site, utc_ns)


def write_all(
    folder: Path, adjusted: Adjusted, site: Site, poses: ImagePoses, names: tuple[str, ...], told: dict[str, Any]
) -> None:
    """Write every file, bundle.json last.

    Raises
    ------
    SourceError
        A file cannot be written.
    """
    make_folder(folder)
    (folder / "bundle.json").unlink(missing_ok=True)
    block = adjusted.solved.block
    rig = rig_after(adjusted)
    write_poses(folder / "poses.csv", poses)
    write_rig(folder / "rig.yaml", rig, "p_cam = T_cam_imu p_ins; t_utc = t_exif + timeshift_cam_imu")
    measured = block.measured.masked(block.measured.weight > 0.0)
    seen = np.bincount(measured.point, minlength=len(block.points_m))
    good = adjusted.found.normal.kept.determined & (seen > 0)
    covariance = place_covariances(adjusted)[good]
    grid = site.mat_local_grid(block.points_m[good])
    turned = np.swapaxes(grid, 1, 2) @ covariance @ grid
    sigma = np.sqrt(np.maximum(np.diagonal(turned, axis1=1, axis2=2), 0.0))
    chosen = [names[place] for place in np.flatnonzero(good)]
    write_points(folder / "points.csv", chosen, site.map(block.points_m[good]), sigma, seen[good])
    make_folder(folder / "colmap")
    residual, _ = image_residuals(replace(block, measured=measured), adjusted.solved.unknowns)
    square = np.bincount(measured.point, np.square(residual).sum(axis=1), len(block.points_m))
    errors = np.sqrt(square / np.maximum(seen, 1))
    local = local_poses(adjusted)
    colmap.write(
        folder / "colmap", rig, block.images, block.camera, local.place_m, local.mat_local_camera,
        np.where(good[:, None], block.points_m, np.nan), (measured.image, measured.point, measured.pixel), errors,
    )  # fmt: skip
    with written_aside(folder / "bundle.json") as aside:
        aside.write_text(json.dumps(told, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def figures(adjusted: Adjusted, site: Site, names: tuple[str, ...], control: Control | None) -> dict[str, Any]:
    """What bundle.json says of the adjustment."""
    solved, balance, block = adjusted.solved, adjusted.balance, adjusted.solved.block
    measured = block.measured
    used = measured.weight > 0.0
    residual, _ = image_residuals(block, solved.unknowns)
    square = np.square(residual).sum(axis=1)
    told: dict[str, Any] = {
        "crs": None if site.epsg is None else f"EPSG:{site.epsg}",
        "sigma0": _number(balance.sigma0),
        "observations": balance.observations,
        "unknowns": balance.unknowns,
        "redundancy": balance.redundancy,
        "datum": solved.unknowns.datum,
        "steps": solved.steps,
        "settled": solved.settled,
        "counts": {
            "images": len(block.images), "points": balance.points, "image_points": balance.image_points // 2,
            "image_rows": balance.image_points, "pose_rows": balance.pose_rows, "point_rows": balance.point_rows,
            "camera_rows": balance.known_rows, "left_out": adjusted.reasons,
        },
        "residual_rms_px": _number(np.sqrt(square[used].mean()) if used.any() else np.nan),
        "residual_largest_px": _number(np.sqrt(square[used].max()) if used.any() else np.nan),
        "sigma_px_scale": _number(adjusted.sigma_px),
        "images": _images(adjusted, square),
        "cameras": [_camera(adjusted, number, one) for number, one in enumerate(solved.known)],
        "control": [],
        "check": [],
    }  # fmt: skip
    if control is not None:
        errors = _control(adjusted, site, names, control)
        told["control"] = [one for one, check in errors if not check]
        told["check"] = [one for one, check in errors if check]
    lidar = (block.rows.source == LIDAR) & (block.rows.weight > 0.0)
    if lidar.any():
        off = row_residuals(block)[lidar]
        told["lidar"] = {"rows": int(lidar.sum()), "rms_m": _number(np.sqrt(np.square(off).mean()))}
    return told


def common_of(adjusted: Adjusted) -> dict[str, Any]:
    """What all poses of the trajectory are found to be off together."""
    solved = adjusted.solved
    column = int(solved.unknowns.common[0])
    sigma = scale_of(adjusted) * np.sqrt(adjusted.found.matrix[column, column]) if column >= 0 else np.nan
    told = {"attitudes_late_s": solved.block.priors.common.late_s, "attitudes_late_sigma_s": _number(sigma)}
    columns = solved.unknowns.common[1:4]
    if (columns < 0).any():
        return told
    spread = scale_of(adjusted) * np.sqrt(np.diag(adjusted.found.matrix)[columns])
    return told | {
        "trajectory_shift_m": solved.block.priors.common.moved[:3].tolist(),
        "trajectory_shift_sigma_m": spread.tolist(),
    }


def _number(value: Any) -> float | None:
    """A number of JSON; None for what is none."""
    return float(value) if np.isfinite(value) else None


def _images(adjusted: Adjusted, square: Array) -> list[dict[str, Any]]:
    """Points and RMS of each image."""
    block = adjusted.solved.block
    used = block.measured.weight > 0.0
    count = np.bincount(block.measured.image[used], minlength=len(block.images))
    total = np.bincount(block.measured.image[used], square[used], len(block.images))
    rms = np.sqrt(total / np.maximum(count, 1))
    return [
        {"image": name, "points": int(points), "rms_px": float(value) if points else None}
        for name, points, value in zip(block.images, count.tolist(), rms.tolist(), strict=True)
    ]


def _camera(adjusted: Adjusted, number: int, before: RigCamera) -> dict[str, Any]:
    """Values of a camera with sigmas, and how its mounting changed."""
    block = adjusted.solved.block
    now = block.rig.cameras[number]
    spread = camera_spread(adjusted.solved, number, adjusted.found.matrix, scale_of(adjusted))
    turn = frames.quat_log(frames.quat_from_mat(now.mat_cam_ins @ before.mat_cam_ins.T))
    sigma = {name: None if spread is None else spread.sigma(name) for name in (*now.camera.names, *MOUNTING)}
    return {
        "name": now.name,
        "images": int((block.camera == number).sum()),
        "model": now.camera.model,
        "values": now.camera.values(),
        "sigma": {name: sigma[name] for name in now.camera.names if sigma[name] is not None},
        "boresight_change_deg": np.rad2deg(turn).tolist(),
        "boresight_sigma_deg": [_degrees(sigma[f"boresight_{axis}"]) for axis in "xyz"],
        "lever_arm_m": now.lever_arm_m.tolist(),
        "lever_arm_sigma_m": [sigma[f"lever_{axis}"] for axis in "xyz"],
        "timeshift_s": now.timeshift_s,
        "timeshift_sigma_s": sigma["timeshift"],
        "line_delay_s": now.line_delay_s,
        "line_delay_sigma_s": sigma["line_delay"],
    }


def _degrees(value: float | None) -> float | None:
    return None if value is None else float(np.rad2deg(value))


def _control(
    adjusted: Adjusted, site: Site, names: tuple[str, ...], control: Control
) -> list[tuple[dict[str, Any], bool]]:
    """Adjusted minus given of each surveyed point that images determine."""
    block = adjusted.solved.block
    places = {name: number for number, name in enumerate(names)}
    measured = block.measured
    rays = np.bincount(measured.point[measured.weight > 0.0], minlength=len(names))
    covariance = place_covariances(adjusted)
    found = []
    for name, given, check in zip(control.name, control.place_m, control.check.tolist(), strict=True):
        at = places.get(name)
        if at is None or not adjusted.found.normal.kept.determined[at] or not rays[at]:
            continue
        off = site.map(block.points_m[at][None])[0] - given
        grid = site.mat_local_grid(block.points_m[at][None])[0]
        sigma = np.sqrt(np.maximum(np.diag(grid.T @ covariance[at] @ grid), 0.0))
        told = {"name": name, "dx": float(off[0]), "dy": float(off[1]), "dz": float(off[2]), "images": int(rays[at])}
        told |= dict(zip(("sx", "sy", "sz"), sigma.tolist(), strict=True))
        found.append((told, check))
    return found
