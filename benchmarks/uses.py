"""What the uses of a cloud are good for: one function a figure, on made-up scenes with known truth and on recordings.

    make bench-uses            or  benchmarks/uses.py [NAME ...]

Recordings are found by SWATH_RECORDINGS; where it is unset their figures are null. GDAL is the peer of the line of sight: its
`gdal_viewshed` from the package gdal-bin, null where it is not installed. The last line is one JSON object:

reflectance_error         largest error of the mean of a panel or a cell of 1 m with 100 echoes or more, up to 70 deg of incidence
strips_closer             by how many times nearer two strips are to each other than as measured, cells of 1 m, 100 echoes and more
strips_trend_percent      slope of what is left of their difference, in 10 m across
strip_bias_percent        largest difference of a strip of lasR's bcts from the others, single echoes in cells of 1 m with 5 and more
strip_cells_percent       how far single cells of a strip are off, the median, there; `expected`: by the scatter of their own echoes
strip_surface_...         the same of echoes from surfaces, whose incidence is known
change_detection_rate     share of boxes of 1 dm3 found, 1000 points/m2 amid swaying shrubs
change_false_per_100m2    claims that are none, there
(those of uses_clouds.py)  ground, detection, wires, trees, buildings
(those of uses_banks.py)  banks, water lines, slides
(those of uses_closeups.py)  tall grass, the edge of a wood, a road, from 4 m
(those of uses_change.py)  what moved between two flights
(those of uses_ground.py)  soil, moving things, panes, pipes, passability
(those of uses_places.py)  ground of made-up places of other kinds
(those of uses_peers.py)  CPU time and errors beside libraries that do the same
sight_exact_agreement     share of cells of 200 random surfaces where `exact` says what a dense walk along the line says
sight_fast_agreement      share of cells of a terrain of a million cells where `fast` says what `exact` says
sight_fast_ratio_to_gdal  CPU time of `fast` over that of GDAL, for it
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import uses_banks
import uses_change
import uses_closeups
import uses_clouds
import uses_ground
import uses_peers
import uses_places
import uses_radiometry
import uses_sight

ROOT: Final = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT), str(ROOT / "tests" / "helpers")]

Array = npt.NDArray[np.float64]
Figures = dict[str, Any]


def main() -> int:
    """Measure what was asked for, or all."""
    parser = argparse.ArgumentParser(description="Figures of the uses of a cloud.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FIGURES)}; default: all")
    names = parser.parse_args().names or list(FIGURES)
    found: Figures = {}
    for name in names:
        begun = time.process_time()
        found |= FIGURES[name]()
        print(f"{name}: {time.process_time() - begun:.1f} CPU-s", file=sys.stderr)
    print(json.dumps(found))
    return 0


def change() -> Figures:
    """Boxes on waves of ground between shrubs that sway by 10 cm, 14 x 14 m, four times."""
    from groundproc.analysis.changebeams import Side
    from groundproc.analysis.changedetection import compare
    from groundproc.analysis.changemodel import Rule, model
    from groundproc.analysis.registration import Registration

    side, per_m2, hits, boxes, false = 14.0, 1000.0, 0, 0, 0
    known = Registration(np.eye(4), np.zeros(3), np.diag([1e-4] * 3 + [1e-8] * 3), 0.01, 1.0, 1.0)
    rule = Rule(0.1, 0.25, known, per_m2)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        shrubs = [(*rng.uniform(1, side - 1, 2), rng.uniform(0.3, 0.8)) for _ in range(6)]
        places = rng.uniform(1, side - 1, (20, 2))
        places = np.array([p for p in places if all(np.hypot(p[0] - x, p[1] - y) > r + 0.4 for x, y, r in shrubs)])
        a, b = (_epoch(rng, each, shrubs, side, per_m2) for each in (places[:0], places))
        at_a, at_b = (model(Side(each, np.zeros_like(each)), rule) for each in (a, b))
        new, gone = compare(at_b, at_a, rule).claims, compare(at_a, at_b, rule).claims
        claimed = np.array([claim.place_m[:2] for claim in new]).reshape(-1, 2)
        apart = np.linalg.norm(claimed[:, None] - places[None], axis=2)
        hits += int((apart.min(axis=0, initial=np.inf) < 0.15).sum())
        boxes += len(places)
        false += int((apart.min(axis=1, initial=np.inf) > 0.2).sum()) + len(gone)
    return {
        "change_detection_rate": round(hits / boxes, 3),
        "change_false_per_100m2": round(false / (4 * side**2 / 100.0), 2),
    }


def _epoch(rng: np.random.Generator, boxes: Array, shrubs: list[Any], side: float, per_m2: float) -> Array:
    xy = rng.uniform(0, side, (int(side**2 * per_m2), 2))
    z = 0.05 * np.sin(xy[:, 0])
    for x, y in boxes:
        z[(np.abs(xy[:, 0] - x) < 0.05) & (np.abs(xy[:, 1] - y) < 0.05)] += 0.1
    parts = [np.column_stack([xy, z]) + rng.normal(0, 1, (len(xy), 3)) * (0.005, 0.005, 0.02)]
    for x, y, radius in shrubs:
        way = rng.standard_normal((int(per_m2 * np.pi * radius**2), 3))
        way *= radius * rng.uniform(0, 1, (len(way), 1)) ** (1 / 3) / np.linalg.norm(way, axis=1)[:, None]
        way[:, 2] = np.abs(way[:, 2])
        parts.append(way + (x, y, 0.0) + rng.normal(0, 0.1, 3) * (1, 1, 0.3) + rng.normal(0, 0.05, (len(way), 3)))
    return np.asarray(np.concatenate(parts) + rng.normal(0, 0.01, 3))


FIGURES: Final[dict[str, Callable[[], Figures]]] = {
    "change": change,
    **uses_radiometry.FIGURES,
    **uses_sight.FIGURES,
    **uses_peers.FIGURES,
    **uses_banks.FIGURES,
    **uses_change.FIGURES,
    **uses_closeups.FIGURES,
    **uses_clouds.FIGURES,
    **uses_ground.FIGURES,
    **uses_places.FIGURES,
}

if __name__ == "__main__":
    sys.exit(main())
