"""A cloud compared with another of the same place: distances along the other's normals, as a whole and place by place.

Cylinders stand around points of the reference along its normals; the distance is that between the means of both clouds
in them (M3C2, `deformation.m3c2`). All distances together give one shift, by weighted least squares along their
normals. Its covariance is that of groups of four metres, because neighbours share their errors. Optionally the cloud
is laid on the reference first. Then that motion is reported, and the remaining distances carry its covariance.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from flightlog.errors import CoverageError
from groundproc.analysis.deformation import m3c2, surface
from groundproc.analysis.epochs import Epochs, laid
from groundproc.cloud import reader
from groundproc.cloud.selection import SURFACES
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Progress = Callable[[str, int], object]

_LEVEL: Final = 0.94
"""Planes with a steeper normal than this upward part (20 deg) tell heights; the others tell plan."""
_GROUP_M: Final = 4.0
_FEWEST: Final = 10
_TOLD: Final = 1e-4
"""A direction is told if normals have at least this share in it."""
_ROUNDS: Final = 5


@dataclass(frozen=True, slots=True)
class Task:
    """What is compared.

    Attributes
    ----------
    cloud, reference : Path
    register : bool
        Lay the cloud on the reference first.
    reach_m : float
        How far a surface is looked for along its normal.
    """

    cloud: Path
    reference: Path
    register: bool = False
    reach_m: float = 1.0


@dataclass(frozen=True, slots=True)
class Compared:
    """What came of it.

    Attributes
    ----------
    told : dict
        For JSON.
    place_m, normal : ndarray, shape (n, 3)
        Where distances were measured, in the frame of the reference.
    distance_m, sigma_m : ndarray, shape (n,)
        Cloud less reference along the normal, and what both clouds' scatter and the registration let expect.
    """

    told: dict[str, Any]
    place_m: Array
    normal: Array
    distance_m: Array
    sigma_m: Array


def compare(task: Task, progress: Progress) -> Compared:
    """Hold a cloud against another.

    Raises
    ------
    CaptureError
        A file cannot be read.
    CoverageError
        They have no surface in common.
    GeodesyError
        They are not in one CRS in metres.
    """
    clouds = reader.look(task.reference, SURFACES), reader.look(task.cloud, SURFACES)
    epochs = laid(clouds, (None, None), not task.register, progress)
    crs = epochs.crs
    with tempfile.TemporaryDirectory(prefix="swath-assess-") as folder:
        records = surface.distances(surface.Task(reach_m=task.reach_m), epochs, Path(folder), progress)
    some = records[records["seen"]] if len(records) else records
    if len(some) < _FEWEST:
        raise CoverageError(
            f"{task.cloud}: has {len(some)} places with a surface within {task.reach_m:g} m of that of {task.reference}, expected "
            f"{_FEWEST} or more: are they of one place, and in one CRS?"
        )
    place, normal, distance = (np.asarray(some[name], np.float64) for name in ("xyz", "normal", "distance"))
    sigma = np.sqrt(np.asarray(some["own"], np.float64) + some["shared"])
    told = {
        "crs": None if crs is None else crs.name,
        "places": len(some),
        "unseen": int(len(records) - len(some)),
        "normal": figures(distance, sigma),
        "height": figures(*_along(normal[:, 2] > _LEVEL, distance, sigma, normal[:, 2])),
        "plan": figures(*_along(normal[:, 2] <= _LEVEL, distance, sigma, np.hypot(normal[:, 0], normal[:, 1]))),
        "shift": shift(place, normal, distance, sigma),
        "registration": _registered(epochs) if task.register else None,
    }
    return Compared(told, place, normal, distance, sigma)


def _along(chosen: npt.NDArray[np.bool_], distance: Array, sigma: Array, part: Array) -> tuple[Array, Array]:
    """Distances along an axis of which the normals have a part."""
    return distance[chosen] / part[chosen], sigma[chosen] / part[chosen]


def figures(d_m: Array, sigma_m: Array) -> dict[str, Any]:
    """Figures of differences; None where there are none.

    Parameters
    ----------
    d_m, sigma_m : ndarray, shape (n,)
        And what noise and registration let expect.
    """
    names = ("mean_m", "median_m", "mean_abs_m", "rmse_m", "sigma_mad_m", "p95_abs_m", "expected_sigma_m", "beyond_95")
    if not len(d_m):
        return {"count": 0} | dict.fromkeys(names)
    values = (
        np.mean(d_m), np.median(d_m), np.mean(np.abs(d_m)), np.sqrt(np.mean(d_m**2)), robust.sigma(d_m),
        np.percentile(np.abs(d_m), 95.0), np.median(sigma_m), np.mean(np.abs(d_m) > m3c2.detectable(sigma_m**2)),
    )  # fmt: skip
    return {"count": len(d_m)} | {name: float(value) for name, value in zip(names, values, strict=True)}


def shift(place_m: Array, normal: Array, distance_m: Array, sigma_m: Array) -> dict[str, list[float | None]]:
    """The shift of the whole that distances tell, with its sigma; None along an axis that no normal tells.

    Parameters
    ----------
    place_m, normal : ndarray, shape (n, 3)
    distance_m, sigma_m : ndarray, shape (n,)
    """
    _, axes = np.linalg.eigh(normal.T @ normal / len(normal))
    share = np.mean((normal @ axes) ** 2, axis=0)
    rows = (normal @ axes)[:, share > _TOLD]
    weight = 1.0 / sigma_m**2
    found = np.zeros(rows.shape[1])
    for _ in range(_ROUNDS):
        left = distance_m - rows @ found
        scale = max(robust.sigma(left / sigma_m, 0.0), 1.0)
        now = weight * robust.cauchy(left / (2.0 * scale * sigma_m))
        inverse = np.linalg.inv((rows * now[:, None]).T @ rows)
        found = inverse @ (rows.T @ (now * distance_m))
    score = rows * (now * (distance_m - rows @ found))[:, None]
    _, group = np.unique(np.floor(place_m / _GROUP_M).astype(np.int64), axis=0, return_inverse=True)
    sums = np.stack([np.bincount(group.ravel(), column) for column in score.T], axis=1)
    used = axes[:, share > _TOLD]
    covariance = used @ inverse @ (sums.T @ sums) @ inverse @ used.T
    along = used @ found
    known = np.sum(axes[:, share <= _TOLD] ** 2, axis=1) < 0.01
    sigma = np.sqrt(np.diag(covariance))
    return {
        "xyz_m": [float(v) if k else None for v, k in zip(along, known, strict=True)],
        "sigma_m": [float(v) if k else None for v, k in zip(sigma, known, strict=True)],
    }


def _registered(epochs: Epochs) -> dict[str, Any]:
    """What it took to lay the cloud on the reference, at their middle."""
    found = epochs.registration
    sigma = np.sqrt(np.diag(found.covariance))
    turn = Rotation.from_matrix(found.matrix[:3, :3]).as_rotvec()
    return {
        "shift_m": (found.move(found.about_m[None])[0] - found.about_m).tolist(), "shift_sigma_m": sigma[:3].tolist(),
        "turn_deg": np.rad2deg(turn).tolist(), "turn_sigma_deg": np.rad2deg(sigma[3:]).tolist(), "about_m": found.about_m.tolist(),
        "overlap": found.overlap,
    }  # fmt: skip


def text(told: dict[str, Any]) -> str:
    """Figures for the terminal."""
    lines = [
        f"{'cloud less reference':<22}{'count':>9}{'mean [m]':>11}{'RMSE [m]':>11}{'95 % below':>12}{'noise lets expect':>19}"
    ]
    for name, key in (("along normals", "normal"), ("in height", "height"), ("in plan", "plan")):
        each = told[key]
        if each["count"]:
            lines.append(
                f"{name:<22}{each['count']:>9,}{each['mean_m']:>+11.4f}{each['rmse_m']:>11.4f}{each['p95_abs_m']:>12.4f}"
                f"{each['expected_sigma_m']:>19.4f}"
            )
    lines.append("the whole is off by " + _axes(told["shift"]["xyz_m"], told["shift"]["sigma_m"]))
    if (laid_on := told["registration"]) is not None:
        lines.append("after it was moved by " + _axes(laid_on["shift_m"], laid_on["shift_sigma_m"]) + " at the middle")
    if told["unseen"]:
        lines.append(
            f"{told['unseen']:,} places of the reference have no such surface in the cloud, and are not compared"
        )
    return "\n".join(lines)


def _axes(value: list[float | None], sigma: list[float | None]) -> str:
    return ", ".join(
        f"{axis} not told" if v is None or s is None else f"{axis} {v:+.4f} +- {s:.4f} m"
        for axis, v, s in zip("xyz", value, sigma, strict=True)
    )
