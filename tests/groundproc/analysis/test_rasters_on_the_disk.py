"""Rasters of which only some blocks are there, against whole ones."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_fill_holes

from flightlog.errors import SourceError
from groundproc.analysis.passage.enclosed import enclosed
from groundproc.analysis.terrain import surfaces
from groundproc.analysis.terrain.building import outlines, roof_outlines
from groundproc.analysis.terrain.surfaces import BLOCK, Sheet
from groundproc.raster.grid import Grid, Window
from groundproc.raster.sampling import bilinear

GRID = Grid(-700, 300, 2 * BLOCK + 300, BLOCK + 200, 0.5)


def filled(folder: Path, whole: np.ndarray) -> Sheet:
    """A sheet with the blocks of a raster that hold something."""
    sheet = Sheet(GRID, folder, whole.dtype)
    top = GRID.row + GRID.rows
    for block in GRID.blocks(BLOCK):
        down, right = top - block.row - block.rows, block.column - GRID.column
        part = whole[down : down + block.rows, right : right + block.columns]
        if (np.isfinite(part) & (part != 0)).any():
            sheet.put(block, part)
    return sheet


def test_values_are_those_of_the_whole_raster(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    whole = rng.normal(size=(GRID.rows, GRID.columns)).astype(np.float32)
    whole[rng.random(whole.shape) < 0.2] = np.nan
    whole[:, BLOCK : 2 * BLOCK] = np.nan
    sheet = filled(tmp_path, whole)
    assert not sheet.holds(Window(GRID.column + BLOCK + 5, GRID.row + 5, 100, 100))
    across = Window(GRID.column - 20, GRID.row - 30, GRID.columns + 50, GRID.rows + 60)
    padded = np.pad(whole, ((30, 30), (20, 30)), constant_values=np.nan)
    np.testing.assert_array_equal(sheet.window(across), padded)
    places = np.column_stack([
        GRID.west_m + rng.uniform(-2, GRID.columns * 0.5 + 2, 50_000),
        GRID.north_m - rng.uniform(-2, GRID.rows * 0.5 + 2, 50_000),
    ])  # fmt: skip
    np.testing.assert_allclose(sheet.bilinear(places), bilinear(whole, GRID, places), rtol=1e-6)
    down, right = rng.integers(GRID.rows, size=9000), rng.integers(GRID.columns, size=9000)
    np.testing.assert_array_equal(sheet.at(down, right), whole[down, right])
    sheet.mark(down, right, 7.0)
    whole[down, right] = 7.0
    np.testing.assert_array_equal(sheet.window(GRID), whole)


def test_what_is_enclosed_is_that_of_the_whole_raster(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    whole = (rng.random((GRID.rows, GRID.columns)) < 0.5).astype(np.uint8)
    whole[100:900, BLOCK - 200 : BLOCK + 300] = 1
    whole[300:500, BLOCK - 50 : BLOCK + 50] = 0  # a lake over the edge of two blocks
    whole[:, 2 * BLOCK :] = 0
    true = int((binary_fill_holes(whole > 0) & (whole == 0)).sum())
    assert true > 20_000
    assert enclosed(filled(tmp_path, whole)) == true


def test_a_house_over_the_edge_of_blocks_is_one(tmp_path: Path) -> None:
    whole = np.zeros((GRID.rows, GRID.columns), np.uint8)
    whole[BLOCK - 20 : BLOCK + 30, BLOCK - 10 : BLOCK + 40] = 1
    whole[50:80, 50:90] = 1
    whole[60:70, 60:70] = 0
    whole[0:12, 0:12] = 1
    found = roof_outlines(filled(tmp_path, whole))
    expected = outlines(whole > 0, GRID)
    assert sorted(each.area for each in found) == pytest.approx(sorted(each.area for each in expected))
    assert len(found) == 3


def test_room_goes_by_what_is_filled(tmp_path: Path) -> None:
    """A corridor of 60 x 60 km aslant: 14 thousand million cells, of which 90 blocks hold something."""
    grid = Grid(0, 0, 118_000, 118_000, 0.5)
    sheet = Sheet(grid, tmp_path)
    for n in range(90):
        sheet.put(Window(n * BLOCK, grid.rows - n * BLOCK - 1, 1, 1), np.ones((1, 1), np.float32))
    assert sheet.window(Window(0, grid.rows - 1, 1, 1))[0, 0] == 1.0
    assert surfaces.BLOCK**2 * 4 * 90 <= sheet._blocks.nbytes <= surfaces.BLOCK**2 * 4 * 128


@pytest.mark.skipif(
    not hasattr(os, "posix_fallocate"), reason="this system takes room on the disk when it is written to"
)
def test_a_full_disk_is_one_sentence_and_no_signal_of_the_kernel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mapped into memory, holes of a file would be filled when they are written to, and the process killed."""
    left = [20 << 20]

    def take(file: int, begin: int, size: int) -> None:
        if size > left[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        fallocate(file, begin, size)

    fallocate = os.posix_fallocate
    monkeypatch.setattr(os, "posix_fallocate", take)
    sheet = Sheet(GRID, tmp_path, np.float32)
    block = next(iter(GRID.blocks(BLOCK)))
    sheet.put(block, np.ones((block.rows, block.columns), np.float32))
    left[0] = 6 << 20
    with pytest.raises(
        SourceError, match=r"no room for temporary files, \d{1,2},\d{3},\d{3} bytes asked for \(No space left"
    ):
        sheet.put(GRID, np.ones((GRID.rows, GRID.columns), np.float32))
