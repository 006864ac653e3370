"""Pictures of a cloud, straight from the points: seen from above by height and by intensity, and from the south."""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import utc_text
from groundproc.cloud.points import Points
from groundproc.machine.readahead import imported_meanwhile
from groundproc.products.plan import DRAWN_WITH, Plan, draw_plan
from groundproc.products.product import Context
from groundproc.raster.cells import Cells
from groundproc.vectors.tracks import pieces

Array = npt.NDArray[np.float64]
Intensity = npt.NDArray[np.unsignedinteger]

LARGEST_SAMPLE: Final = 500_000
"""Points kept for the pictures, however long the flight."""
_HEIGHTS: Final = (1.0, 99.5)
_INTENSITY: Final = 99.0
"""Percentiles between which colours span: single wild values would take all of them."""
_CELL_M: Final = 1.0
"""Of the density."""
_BLOCK: Final = 1024


class CloudSample:
    """A sample of a stream of points, evenly thinned, of bounded size."""

    def __init__(self) -> None:
        self._parts: list[tuple[Array, Intensity]] = []
        self._step, self._size = 8, 0

    def add(self, xyz_m: Array, intensity: Intensity) -> None:
        """Take every n-th of some points, shapes (n, 3) and (n,)."""
        # a step that shares no factor with the 32 lasers, so that none is preferred
        part = slice(None, None, self._step + 1)
        self._parts.append((xyz_m[part].copy(), intensity[part].copy()))
        self._size += len(self._parts[-1][0])
        if self._size > LARGEST_SAMPLE:
            self._parts = [(xyz[::2].copy(), shade[::2].copy()) for xyz, shade in self._parts]
            self._size = sum(len(xyz) for xyz, _ in self._parts)
            self._step *= 2

    def points(self) -> tuple[Array, Intensity]:
        """Positions, shape (n, 3), and intensities, shape (n,)."""
        xyz, intensity = zip(*self._parts, strict=True)
        return np.concatenate(xyz), np.concatenate(intensity)


class Pictures:
    """cloud_height.png and cloud_intensity.png."""

    def begin(self, context: Context) -> None:
        """Begin with no points."""
        self._context, self._sample = context, CloudSample()
        self._cells, self._total = Cells(_CELL_M, {"count"}), 0
        imported_meanwhile(DRAWN_WITH)  # it takes half a second, while kernels and compression leave the interpreter

    def add(self, points: Points) -> None:
        """Keep some of the points."""
        self._sample.add(points.xyz_m, points["intensity"])
        self._cells.add(points.xyz_m, points.xyz_m[:, 2])
        self._total += len(points)

    def finish(self) -> None:
        """Draw them."""
        context, sample = self._context, self._sample
        trajectory = context.estimate.trajectory
        paths = [context.projection.exact(trajectory.position_m[some]) for some in pieces(trajectory)]
        title = (
            f"{utc_text(int(trajectory.time_ns[0]))[:16].replace('T', ', ')} UTC; {self._total:,} points, "
            f"{density(self._cells):.0f} per m² (median); {context.projection.crs.name}"
        )
        draw_cloud(context.folder, sample, title, paths)


def density(cells: Cells) -> float:
    """Points per square metre: the median of the cells that hold any."""
    grid = cells.grid()
    assert grid is not None
    counts = [cells.window(window, "count") for window in grid.blocks(_BLOCK)]
    return float(np.median(np.concatenate([each[each > 0] for each in counts]))) / _CELL_M**2


def draw_cloud(folder: Path, sample: CloudSample, title: str, paths: list[Array]) -> None:
    """Write cloud_height.png and cloud_intensity.png."""
    xyz, intensity = sample.points()
    low, high = np.percentile(xyz[:, 2], _HEIGHTS)
    top = max(float(np.percentile(intensity, _INTENSITY)), 1.0)
    heights = Plan(xyz, xyz[:, 2], (float(low), float(high)), "height [m]", "height", title, paths, shaded=True)
    strengths = Plan(xyz, intensity.astype(np.float64), (0.0, top), "intensity", "grey", title, paths)
    draw_plan(folder / "cloud_height.png", heights)
    draw_plan(folder / "cloud_intensity.png", strengths)
