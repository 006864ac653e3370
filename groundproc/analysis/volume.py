"""Volumes of heaps and pits within polygons, above a base that their own edge or another surface gives.

The surface is the mean height of small cells; cells without points are interpolated. A cell counts by the share of it that lies within
the polygon. Uncertainty has two parts: the base, whose error acts on the whole area at once and so mostly decides, and the scatter of
the points, which averages out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import shapely
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from groundproc.assessment.surface import RADII_M, Patch, patch_at
from groundproc.raster.cells import Cells
from groundproc.raster.grid import Grid

Array = npt.NDArray[np.float64]

EDGE_STEP_M: Final = 0.5
"""Between the places along the edge whose heights are taken."""
MARGIN_M: Final = RADII_M[-1]
"""Points so far outside a polygon are used for the heights of its edge."""
AROUND_M: Final = 5.0
"""Ground so far around a polygon belongs to the terrain below it."""
_TERRAIN_CELL_M: Final = 0.25
_LEAST_CELLS: Final = 8
_POINTS_A_CELL: Final = 6.0
_SMALLEST_CELL_M, _LARGEST_CELL_M = 0.05, 1.0
_PARTS: Final = 8
"""A cell on the edge is tested at 8 x 8 places."""
_CORRELATED_M: Final = 5.0
"""Errors of the edge's heights nearer to each other than this are taken as one: they come from the same strip, grass or step."""


class Base(Protocol):
    """The surface that volumes are counted from."""

    def heights(self, xy_m: Array) -> Array:
        """Heights at places, shape (n, 2) -> (n,); NaN where it is not known."""

    def sigma_m(self) -> float:
        """Of its mean height over the polygon."""


@dataclass(frozen=True, slots=True)
class Volume:
    """What a polygon holds.

    Attributes
    ----------
    cut_m3, fill_m3 : float
        What stands above the base, and what is missing below it.
    sigma_m3 : float
        Of their difference.
    area_m2, empty_m2 : float
        Of the polygon, and of its cells without points, which are interpolated.
    """

    cut_m3: float
    fill_m3: float
    sigma_m3: float
    area_m2: float
    empty_m2: float

    @property
    def net_m3(self) -> float:
        """Cut less fill."""
        return self.cut_m3 - self.fill_m3


def edge_heights(polygon: Any, points_m: Array) -> tuple[Array, Array]:
    """Places along the outer edge with the surface's height, shape (n, 3), and the sigma of each, shape (n,); NaN where there is none.

    Parameters
    ----------
    polygon : shapely.Polygon
    points_m : ndarray, shape (m, 3)
        Of the cloud, `MARGIN_M` beyond the polygon.
    """
    edge = polygon.exterior
    count = max(int(np.ceil(edge.length / EDGE_STEP_M)), 8)
    places = np.array([edge.interpolate(share, normalized=True).coords[0][:2] for share in np.arange(count) / count])
    tree = shapely.STRtree(shapely.points(points_m[:, :2]))
    owner, found = tree.query(shapely.points(places), predicate="dwithin", distance=RADII_M[-1])
    near = np.split(found, np.searchsorted(owner, np.arange(1, count)))
    patches = [patch_at(place, points_m[some]) for place, some in zip(places, near, strict=True)]
    heights = np.array([each.height_m if isinstance(each, Patch) else np.nan for each in patches])
    sigmas = np.array([each.sigma_m if isinstance(each, Patch) else np.nan for each in patches])
    return np.column_stack([places, heights]), sigmas


class Plane:
    """The plane through the heights of the edge by least squares."""

    def __init__(self, edge_m: Array, sigma_m: Array) -> None:
        self._middle = edge_m[:, :2].mean(axis=0)
        design = np.column_stack([np.ones(len(edge_m)), edge_m[:, :2] - self._middle])
        self._solution, *_ = np.linalg.lstsq(design, edge_m[:, 2], rcond=None)
        residual = edge_m[:, 2] - design @ self._solution
        self._sigma_m = _mean_sigma(edge_m, np.sqrt(np.mean(residual**2) + np.mean(sigma_m**2)))

    def heights(self, xy_m: Array) -> Array:
        """See `Base`."""
        d = xy_m - self._middle
        return np.asarray(self._solution[0] + d @ self._solution[1:])

    def sigma_m(self) -> float:
        """From how far the edge lies off the plane."""
        return self._sigma_m


class _Triangles:
    """Triangles through places, shape (n, 3); outside of all the height of the nearest place."""

    def __init__(self, places_m: Array) -> None:
        self._linear = LinearNDInterpolator(places_m[:, :2], places_m[:, 2])
        self._nearest = NearestNDInterpolator(places_m[:, :2], places_m[:, 2])

    def heights(self, xy_m: Array) -> Array:
        """See `Base`; a place on the rim itself takes the height of the nearest place."""
        found = np.asarray(self._linear(xy_m))
        beyond = ~np.isfinite(found)
        if beyond.any():
            found[beyond] = self._nearest(xy_m[beyond])
        return found


class Toe(_Triangles):
    """Triangles through the heights of the edge."""

    def __init__(self, edge_m: Array, sigma_m: Array) -> None:
        super().__init__(edge_m)
        rough = np.diff(edge_m[:, 2], n=2) / np.sqrt(6.0)  # what neighbours along the edge do not agree in
        self._sigma_m = _mean_sigma(edge_m, np.sqrt(np.mean(rough**2) + np.mean(sigma_m**2)))

    def sigma_m(self) -> float:
        """From the roughness of the edge."""
        return self._sigma_m


class Terrain(_Triangles):
    """The bare ground within and around, filled where something stands on it: triangles through means of small cells.

    Parameters
    ----------
    polygon : shapely.Polygon
    ground_m : ndarray, shape (n, 3)
        Points of the ground, within `AROUND_M` of the polygon.

    Raises
    ------
    ValueError
        There are too few.
    """

    def __init__(self, polygon: Any, ground_m: Array) -> None:
        cells = Cells(_TERRAIN_CELL_M, {"mean", "count"})
        cells.add(ground_m, ground_m[:, 2])
        grid = cells.grid()
        if grid is None:
            raise ValueError("no ground")
        heights = cells.window(grid, "mean").astype(np.float64)
        known = np.isfinite(heights)
        places = np.column_stack([_centres(grid)[known.ravel()], heights[known]])
        if len(places) < _LEAST_CELLS or np.ptp(places[:, :2], axis=0).min() <= 0.0:
            raise ValueError("too little ground")
        super().__init__(places)
        # every other cell from the rest: what triangles do not know of the ground between
        odd = np.arange(len(places)) % 2 == 1
        rest = np.asarray(LinearNDInterpolator(places[~odd, :2], places[~odd, 2])(places[odd, :2]))
        off = places[odd, 2] - rest
        rough = float(np.sqrt(np.nanmean(off**2) / 1.5)) if np.isfinite(off).any() else 0.0
        # under the thing itself there may be no ground: it rests on what lies along its edge
        edge = np.asarray(polygon.exterior.coords)[:-1, :2]
        self._sigma_m = _mean_sigma(edge, rough)

    def sigma_m(self) -> float:
        """From the roughness of the ground."""
        return self._sigma_m


class Known:
    """Another surface, such as a terrain model from before.

    Parameters
    ----------
    at : callable
        Heights at places.
    sigma_m : float
        Of its mean height; 0 where it is a design.
    """

    def __init__(self, at: Callable[[Array], Array], sigma_m: float = 0.0) -> None:
        self._at, self._sigma_m = at, sigma_m

    def heights(self, xy_m: Array) -> Array:
        """See `Base`."""
        return self._at(xy_m)

    def sigma_m(self) -> float:
        """As stated."""
        return self._sigma_m


def _mean_sigma(edge_m: Array, sigma_m: float) -> float:
    """Sigma of a mean of heights along an edge whose errors are alike over some metres."""
    length = float(np.linalg.norm(np.diff(edge_m[:, :2], axis=0, append=edge_m[:1, :2]), axis=1).sum())
    return sigma_m / float(np.sqrt(max(length / _CORRELATED_M, 1.0)))


def volume(polygon: Any, points_m: Array, base: Base) -> Volume | str:
    """The volume between a surface and a base within a polygon, or why there is none.

    Parameters
    ----------
    polygon : shapely.Polygon
    points_m : ndarray, shape (m, 3)
        Of the cloud, within and around it.
    base : Base
    """
    shapely.prepare(polygon)
    inside = shapely.contains_xy(polygon, points_m[:, 0], points_m[:, 1])
    if inside.sum() < 3:
        return "no points within it"
    cell_m = float(np.clip(np.sqrt(_POINTS_A_CELL * polygon.area / inside.sum()), _SMALLEST_CELL_M, _LARGEST_CELL_M))
    low_x, low_y, high_x, high_y = polygon.bounds
    first = np.floor(np.array([low_x, low_y]) / cell_m).astype(int)
    last = np.floor(np.array([high_x, high_y]) / cell_m).astype(int)
    grid = Grid(int(first[0]), int(first[1]), int(last[0] - first[0]) + 1, int(last[1] - first[1]) + 1, cell_m)
    cells = Cells(cell_m, {"mean", "sigma", "count"})
    cells.add(points_m, points_m[:, 2])
    surface, empty = _filled(grid, cells)
    share = coverage(polygon, grid)
    used = share > 0.0
    heights = base.heights(_centres(grid)[used.ravel()])
    if not np.isfinite(heights).all():
        return "the base is not known everywhere within it"
    above = surface[used] - heights
    area = share[used] * cell_m**2
    count = np.maximum(cells.window(grid, "count")[used], 1.0)
    scatter = np.nan_to_num(cells.window(grid, "sigma")[used], nan=0.0)
    spread = float(np.sqrt(np.sum((area * scatter) ** 2 / count)))
    return Volume(
        float(np.sum(np.maximum(above, 0.0) * area)), float(np.sum(np.maximum(-above, 0.0) * area)),
        float(np.hypot(spread, base.sigma_m() * area.sum())), float(area.sum()), float(area[empty[used]].sum()),
    )  # fmt: skip


def _filled(grid: Grid, cells: Cells) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Mean heights of cells, those without points interpolated, shape (rows, columns); and which those are."""
    heights = cells.window(grid, "mean").astype(np.float64)
    empty = ~np.isfinite(heights)
    if empty.any():
        centres = _centres(grid)
        known = centres[~empty.ravel()]
        found = NearestNDInterpolator(known, heights[~empty])(centres[empty.ravel()])
        if len(known) > 3 and np.ptp(known, axis=0).min() > 0:
            linear = np.asarray(LinearNDInterpolator(known, heights[~empty])(centres[empty.ravel()]))
            found = np.where(np.isfinite(linear), linear, found)
        heights[empty] = found
    return heights, empty


def _centres(grid: Grid) -> Array:
    """Centres of cells, shape (rows * columns, 2), the first row in the north."""
    x = (grid.column + np.arange(grid.columns) + 0.5) * grid.cell_m
    y = (grid.row + grid.rows - np.arange(grid.rows) - 0.5) * grid.cell_m
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def coverage(polygon: Any, grid: Grid) -> Array:
    """Share of each cell that lies within a polygon, shape (rows, columns), to 1/64."""
    centres = _centres(grid)
    half = grid.cell_m / 2.0
    boxes = shapely.box(centres[:, 0] - half, centres[:, 1] - half, centres[:, 0] + half, centres[:, 1] + half)
    share = shapely.contains_properly(polygon, boxes).astype(np.float64)
    edge = (share == 0.0) & shapely.intersects(polygon, boxes)
    step = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
    offset = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2) * grid.cell_m
    parts = centres[edge][:, None] + offset
    share[edge] = shapely.contains_xy(polygon, parts[..., 0], parts[..., 1]).mean(axis=1)
    return np.asarray(share.reshape(grid.rows, grid.columns))


def together(parts: Sequence[Volume]) -> Volume:
    """Several parts of one thing: their errors have nothing to do with each other, as far as each has a base of its own."""
    return Volume(
        sum(each.cut_m3 for each in parts), sum(each.fill_m3 for each in parts),
        float(np.linalg.norm([each.sigma_m3 for each in parts])), sum(each.area_m2 for each in parts),
        sum(each.empty_m2 for each in parts),
    )  # fmt: skip
