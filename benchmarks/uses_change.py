"""Figures of what moved between two flights, on places of known truth: a part of `uses.py`.

surface_false_percent      core points that did not move and are called significant at 95 %
surface_found_at_2_lod     share of those found that moved by twice the level of detection
surface_volume_sigmas      root mean square of the errors of volumes lost and gained, in their sigmas
surface_ratio_to_py4dgeo   CPU time of the distances over that of py4dgeo, same core points, normals and cylinders; null where it is not
                           installed
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt
from uses_clouds import ORIGIN, write_cloud

from groundproc.analysis.deformation import m3c2
from groundproc.analysis.deformation import surface as surfaces
from groundproc.analysis.deformation.cores import cores
from groundproc.analysis.epochs import laid
from groundproc.cloud import reader
from simulator import epochs

Array = npt.NDArray[np.float64]


def surface() -> dict[str, Any]:
    """A gully and its fan, four times, registered by what did not move."""
    false, found, sigmas = [], [], []
    for seed in range(4):
        pair = epochs.eroded(seed, per_m2=150.0)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            clouds = (
                write_cloud(folder / "a.laz", pair.a),
                write_cloud(folder / "b.laz", pair.b + np.array([0.12, -0.2, 0.05])),
            )
            both = laid(
                (reader.look(clouds[0]), reader.look(clouds[1])), (None, None), False, lambda stage, count: None
            )
            told = surfaces.compare(surfaces.Task(), both, folder, lambda stage, count: None)
            cloud = laspy.read(folder / surfaces.CLOUD)
            xy = (np.asarray(cloud.xyz) - ORIGIN)[:, :2]
        moved = np.abs(pair.after(xy) - pair.before(xy))
        state, lod = np.asarray(cloud["change"]), np.asarray(cloud["change_lod"])
        false.append(np.isin(state, (1, 2))[(moved < 0.002) & (state < 3)].mean())
        found.append(np.isin(state, (1, 2))[moved > 2.0 * lod].mean())
        for kind, true in zip(("lost", "gained"), pair.volumes(), strict=True):
            sigmas.append((told[f"{kind}_m3"] - true) / told[f"{kind}_sigma_m3"])
    return {
        "surface_false_percent": round(100.0 * float(np.mean(false)), 2),
        "surface_found_at_2_lod": round(float(np.mean(found)), 4),
        "surface_volume_sigmas": round(float(np.sqrt(np.mean(np.square(sigmas)))), 2),
        "surface_ratio_to_py4dgeo": _ratio(),
    }


def _ratio() -> float | None:
    """CPU time against that of py4dgeo, its search trees left out."""
    try:
        import py4dgeo
    except ImportError:
        return None
    pair = epochs.eroded(9, side_m=40.0, per_m2=150.0)
    chosen = cores(pair.a, 0.25)
    places, normal, size = pair.a[chosen.row], chosen.normal, (0.25, 1.0)
    both = tuple(py4dgeo.Epoch(each) for each in (pair.a, pair.b))
    for each in both:
        each.build_kdtree()
    peer = py4dgeo.M3C2(
        epochs=both, corepoints=places, cyl_radius=size[0], max_distance=size[1], normal_radii=(1.0,), corepoint_normals=normal
    )  # fmt: skip

    def ours() -> Array:
        sorted_points = m3c2.bins(pair.a, *size), m3c2.bins(pair.b, *size)
        return m3c2.distances(places, normal, sorted_points, *size).distance_m

    ours()
    spent = [[_cpu_s(each) for _ in range(3)] for each in (ours, peer.run)]
    return round(float(np.median(spent[0]) / np.median(spent[1])), 3)


def _cpu_s(work: Callable[[], object]) -> float:
    begun = time.process_time()
    work()
    return time.process_time() - begun


FIGURES: Final[dict[str, Callable[[], dict[str, Any]]]] = {"surface": surface}
