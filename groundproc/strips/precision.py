"""How well the strips of a cloud agree: the thickness of planes within each strip, and the distances between strips.

A cloud is cut into voxels. If one strip's points in a voxel form a plane, their scatter across it is the precision
within a strip: noise of the ranges, and poses that wander while the strip passes. The distance between the planes of
two strips is the precision between strips. All strips together are as thick as both effects make them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError, GeodesyError
from groundproc.cloud import reader
from groundproc.cloud.metres import metres_of
from groundproc.cloud.selection import SURFACES
from groundproc.strips.clusters import merged
from groundproc.strips.differences import Differences, Patches

Array = npt.NDArray[np.float64]
Progress = Callable[[str, int], object]

_LINE: Final = "point_source_id"
_FEWEST: Final = 12
"""Points of a plane whose thickness is told."""
_POINTS: Final = 80.0
"""Of a voxel on level ground, of all strips together: two or three of them have enough each."""
_SMALLEST_M, _LARGEST_M = 0.5, 4.0
_FLAT: Final = 0.15
"""Variance across a plane in that along it, at most; and of that in the square of an edge, at least, as its square."""


@dataclass(frozen=True, slots=True)
class Precision:
    """Of one cloud.

    Attributes
    ----------
    told : dict
        For JSON.
    differences : Differences
        Between strips; places are those of the map.
    thickness_m : ndarray, shape (n,)
        Of each strip's planes, one sigma.
    """

    told: dict[str, Any]
    differences: Differences
    thickness_m: Array


def of_cloud(path: Path, voxel_m: float | None, progress: Progress) -> Precision:
    """Look at the strips of a cloud.

    Parameters
    ----------
    path : Path
        Whose `point_source_id` tells the strips.
    voxel_m : float or None
        Default: by the density of points.
    progress : callable

    Raises
    ------
    CaptureError
        It cannot be read.
    CoverageError
        It has no two strips, or no planes.
    GeodesyError
        It is not in metres.
    """
    cloud = reader.look(path, SURFACES)
    if not metres_of(cloud).plain:
        raise GeodesyError(f"{path}: is not in metres; expected a CRS that is: `swath transform` makes it")
    cells, lines = np.empty(0, np.int64), np.empty(0, np.int64)
    for chunk in reader.chunks(cloud, columns=(_LINE,)):
        lines = np.union1d(lines, np.asarray(chunk.points[_LINE], np.int64))
        at = np.floor(chunk.points.xyz_m[:, :2]).astype(np.int64)
        cells = np.union1d(cells, (at[:, 0] << 32) + (at[:, 1] & 0xFFFFFFFF))
        progress("looking", len(chunk.points))
    if len(lines) < 2:
        raise CoverageError(
            f"{path}: all points are of one strip (point_source_id {', '.join(map(str, lines))}), expected two or more; swath process and "
            "swath adjust number flight lines"
        )
    per_m2 = cloud.points / len(cells)
    edge = voxel_m or float(np.clip(np.sqrt(_POINTS / per_m2), _SMALLEST_M, _LARGEST_M))
    patches, origin = Patches(edge), None
    for chunk in reader.chunks(cloud, columns=(_LINE,)):
        xyz = chunk.points.xyz_m
        if not len(xyz):
            continue
        origin = np.floor(xyz[0]) if origin is None else origin
        patches.add(xyz - origin, np.searchsorted(lines, chunk.points[_LINE]).astype(np.int32))
        progress("patches", len(xyz))
    found = patches.differences()
    assert origin is not None
    found = Differences(
        found.along_m, found.normal, found.place_m + origin, found.sigma_m, lines[found.strips].astype(np.int32)
    )
    return _summed(path, edge, lines, patches.cells(), found)


def _summed(
    path: Path, edge_m: float, lines: npt.NDArray[np.int64], cells: npt.NDArray[np.void], differences: Differences
) -> Precision:
    planes = cells[thickness(cells, edge_m) > 0.0]
    within = thickness(planes, edge_m)
    if not len(planes):
        raise CoverageError(
            f"{path}: no strip has a plane of {_FEWEST} points in a voxel of {edge_m:.2f} m; expected ground, roofs or walls"
        )
    one = planes.copy()
    one["strip"] = 0
    together = merged(one, edge_m)
    shared = together[together["count"] > _most_of_one(planes, edge_m)]
    whole = thickness(shared, edge_m)
    told = {
        "voxel_m": edge_m,
        "strips": len(lines),
        "within_strips": _thick(within),
        "all_strips_together": _thick(whole[whole > 0.0]),
        "by_strip": [
            {"strip": int(lines[k])} | _thick(within[planes["strip"] == k]) for k in np.unique(planes["strip"]).tolist()
        ],
        "between_strips": differences.summary() | {"pairs": differences.by_pair()},
    }
    return Precision(told, differences, within)


def _most_of_one(planes: npt.NDArray[np.void], edge_m: float) -> npt.NDArray[np.int64]:
    """Of each voxel, the points of the strip that has most: fewer than all of them, where there are two; in the order of `merged`."""
    cells = np.floor(planes["place"] / edge_m).astype(np.int64)
    order = np.lexsort((planes["strip"], cells[:, 2], cells[:, 1], cells[:, 0]))
    new = np.ones(len(order), np.bool_)
    new[1:] = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    return np.asarray(np.maximum.reduceat(planes["count"][order], np.flatnonzero(new)), np.int64)


def thickness(cells: npt.NDArray[np.void], edge_m: float) -> Array:
    """One sigma of points across their plane, shape (n,); 0 where they are too few or form none.

    Parameters
    ----------
    cells : ndarray of `clusters.CLUSTER`
    edge_m : float
    """
    if not len(cells):
        return np.empty(0)
    count = cells["count"].astype(np.float64)
    matrix = cells["scatter"].astype(np.float64)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    least, middle, _ = np.linalg.eigvalsh(matrix).T
    flat = (count >= _FEWEST) & (least < _FLAT * middle) & (middle / count > (_FLAT * edge_m) ** 2)
    return np.where(flat, np.sqrt(np.maximum(least, 1e-12) / np.maximum(count - 3.0, 1.0)), 0.0)


def _thick(sigma_m: Array) -> dict[str, Any]:
    """Figures of thicknesses."""
    if not len(sigma_m):
        return {"planes": 0, "median_m": None, "rms_m": None, "p95_m": None}
    return {
        "planes": len(sigma_m),
        "median_m": round(float(np.median(sigma_m)), 5),
        "rms_m": round(float(np.sqrt(np.mean(sigma_m**2))), 5),
        "p95_m": round(float(np.percentile(sigma_m, 95.0)), 5),
    }


def text(told: dict[str, Any], before: dict[str, Any] | None = None) -> str:
    """Figures for the terminal, those before beside those after."""
    columns = [each for each in (before, told) if each is not None]
    names = ("before", "after") if before is not None else ("",)
    lines = [f"{'':<44}" + "".join(f"{name:>12}" for name in names)]

    def row(name: str, *keys: str) -> None:
        words = []
        for each in columns:
            value: Any = each
            for key in keys:
                value = value[key]
            words.append("-" if value is None else f"{value:,}" if isinstance(value, int) else f"{value:.4f}")
        lines.append(f"{name:<44}" + "".join(f"{word:>12}" for word in words))

    row("strips", "strips")
    row("planes of single strips", "within_strips", "planes")
    row("thickness within a strip, median [m]", "within_strips", "median_m")
    row("thickness of all strips together, median [m]", "all_strips_together", "median_m")
    for key, name in (("normal", "along normals"), ("height", "in height"), ("plan", "in plan")):
        row(f"planes of two strips {name}", "between_strips", key, "count")
        row(f"  strips differ {name}, RMS [m]", "between_strips", key, "rms_m")
        row("  sigmaMAD [m]", "between_strips", key, "sigma_mad_m")
    row("noise lets expect [m]", "between_strips", "expected_sigma_m")
    return "\n".join(lines)
