"""Statistics by cell, against numpy's own on all points at once."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from flightlog.errors import UsageError
from groundproc.raster.cells import STATISTICS, Cells
from groundproc.raster.grid import Grid, Window, checked_cell
from groundproc.raster.medians import Medians

Array = npt.NDArray[np.float64]

PLACE = np.array([533_466.37, 6_472_800.91, 0.0])


def points(count: int, seed: int = 1) -> Array:
    """Points round a place, some of them west and south of the origin of the cells, on some 300 m."""
    return np.random.default_rng(seed).normal(0.0, [60.0, 50.0, 3.0], (count, 3)) + PLACE


def by_cell(xyz_m: Array, cell_m: float) -> dict[tuple[int, int], Array]:
    """Heights of each cell (column, row)."""
    found: dict[tuple[int, int], list[float]] = {}
    for x, y, z in xyz_m:
        found.setdefault((int(np.floor(x / cell_m)), int(np.ceil(y / cell_m)) - 1), []).append(z)
    return {cell: np.array(heights) for cell, heights in found.items()}


WITNESS = {
    "max": np.max, "min": np.min, "mean": np.mean, "count": len, "median": np.median,
    "sigma": lambda heights: np.std(heights, ddof=1) if len(heights) > 1 else np.nan,
}  # fmt: skip


@pytest.mark.parametrize("statistic", [*STATISTICS, "median"])
@pytest.mark.parametrize("cell_m", [0.25, 7.3])
def test_every_cell_holds_the_statistic_of_its_own_points(statistic: str, cell_m: float, tmp_path: Path) -> None:
    xyz = points(20_000) - PLACE if cell_m > 1.0 else points(20_000)
    cells = Medians(cell_m, tmp_path) if statistic == "median" else Cells(cell_m, {statistic})
    for piece in np.array_split(xyz, 7):
        cells.add(piece, piece[:, 2])
    grid = cells.grid()
    assert grid is not None
    made = cells.window(grid, statistic)
    expected = np.full(made.shape, 0.0 if statistic == "count" else np.nan)
    for (column, row), heights in by_cell(xyz, cell_m).items():
        expected[grid.row + grid.rows - 1 - row, column - grid.column] = WITNESS[statistic](heights)
    # float32 holds heights of 12 m to a micrometre
    np.testing.assert_allclose(made, expected, rtol=0, atol=2e-6)
    counted = np.isfinite(expected) if statistic != "count" else expected > 0
    if statistic != "sigma":  # a lone point has none
        assert counted[[0, -1]].any(axis=1).all(), "no row at the edge is empty"
        assert counted[:, [0, -1]].any(axis=0).all(), "no column at the edge is empty"


@pytest.mark.parametrize("offset_m", [(500_000.0, 5_600_000.0), (2_600_000.0, 1_200_000.0), (-30.0, -20.0)])
@pytest.mark.parametrize("cell_mm", [10, 50, 100, 200, 250, 300, 400, 600, 700])
def test_a_lattice_on_the_edges_has_one_point_in_each_cell(
    cell_mm: int, offset_m: tuple[float, float], tmp_path: Path
) -> None:
    """Another program's terrain model as a cloud: places as LAS makes them, of whole millimetres; so whole numbers tell the cells."""
    own_mm = [cell_mm - round(1000 * each) % cell_mm for each in offset_m]
    column, row = (each.ravel() for each in np.meshgrid(np.arange(60), np.arange(60)))
    x, y = ((start + cell_mm * k) * 0.001 + off for start, off, k in zip(own_mm, offset_m, (column, row), strict=True))
    xyz = np.stack([x, y, 1000.0 * column + row], axis=1)
    first = [(round(1000 * off) + start) // cell_mm for off, start in zip(offset_m, own_mm, strict=True)]
    expected = (1000.0 * column + row).reshape(60, 60)[::-1]
    for cells, statistic in (
        (Cells(cell_mm / 1000, {"max", "count"}), "max"),
        (Medians(cell_mm / 1000, tmp_path), "median"),
    ):
        cells.add(xyz, xyz[:, 2])
        grid = cells.grid()
        # a point on an edge is of the cell east or south of it
        assert grid == Grid(first[0], first[1] - 1, 60, 60, cell_mm / 1000)
        np.testing.assert_array_equal(cells.window(grid, statistic), expected)


def test_a_mean_of_very_many_points_keeps_its_digits() -> None:
    """Two million heights about 4000 m: a sum in float32 would be decimetres off."""
    heights = 4000.0 + np.random.default_rng(2).normal(0.0, 0.02, 2_000_000)
    cells = Cells(1.0, {"mean", "sigma"})
    cells.add(np.full((len(heights), 3), 0.5), heights)
    one = Window(0, 0, 1, 1)
    assert cells.window(one, "mean")[0, 0] == pytest.approx(heights.mean(), abs=3e-4)  # a step of float32 there
    assert cells.window(one, "sigma")[0, 0] == pytest.approx(heights.std(), rel=1e-6)


def test_points_far_apart_cost_no_memory_between_them() -> None:
    cells = Cells(0.25, {"max"})
    cells.add(np.array([[0.1, 0.1, 5.0], [9e6, 9e6, 6.0]]), np.array([5.0, 6.0]))
    assert len(cells) == 2


def test_values_that_are_no_numbers_are_left_out(tmp_path: Path) -> None:
    xyz = np.array([[0.1, 0.1, 1.0], [0.2, 0.2, np.nan], [np.inf, 0.0, 3.0], [0.2, 0.1, 2.0]])
    for cells in (Cells(0.25, {"max"}), Medians(0.25, tmp_path)):
        cells.add(xyz, xyz[:, 2])
        assert cells.grid() == Grid(0, 0, 1, 1, 0.25)
    assert Cells(0.25, {"count"}).grid() is None


@pytest.mark.parametrize("cell_m", [0.0, -1.0, float("nan"), float("inf")])
def test_a_cell_that_is_no_size_is_refused(cell_m: float) -> None:
    with pytest.raises(UsageError, match="expected"):
        checked_cell(cell_m)


def test_blocks_cover_a_grid_once() -> None:
    grid = Grid(-3, 17, 1100, 700, 0.5)
    seen = np.zeros((grid.rows, grid.columns), int)
    for block in grid.blocks(512):
        down = grid.row + grid.rows - block.row - block.rows
        right = block.column - grid.column
        seen[down : down + block.rows, right : right + block.columns] += 1
    assert (seen == 1).all()
