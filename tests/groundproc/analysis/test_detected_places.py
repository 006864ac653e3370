"""Places that score are those of the cloud, wherever the tiles lie that its points are counted in, and however far they are apart."""

import numpy as np
import numpy.typing as npt

from groundproc.analysis.detection.layers import SIDE, Layers
from groundproc.analysis.detection.targets import Target, scan
from groundproc.raster.grid import Grid

CELL_M, LOW_M, HIGH_M = 0.5, 0.5, 3.0


def counted(west: int, south: int, far: int = 0) -> Layers:
    """Two boxes on level ground of 40 x 40 m, whose south-west corner lies so many cells within the grid, and a point far beyond it."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(0.0, 40.0, (20_000, 2))
    above = np.abs(rng.normal(0.0, 0.02, len(xy)))
    for east, north in ((12.0, 20.0), (30.0, 9.0)):
        above[(np.abs(xy[:, 0] - east) < 2.2) & (np.abs(xy[:, 1] - north) < 0.9)] += 1.5
    xy += (west * CELL_M, south * CELL_M)
    if far:
        xy, above = np.concatenate([xy, xy[-1:] + far * CELL_M]), np.append(above, 0.0)
    side = 2 * SIDE + far
    layers = Layers(Grid(0, 0, side, side, CELL_M), LOW_M, HIGH_M)
    for some in np.array_split(np.arange(len(xy)), 3):
        xyz = np.column_stack([xy[some], above[some]])
        layers.add(xyz, above[some].astype(np.float32), np.ones(len(some), np.bool_))
    return layers


def places(found: list[Target], layers: Layers, west: int, south: int) -> npt.NDArray[np.float64]:
    """Their cells from the corner of the ground, what they are of, and their scores, shape (n, 6)."""
    rows = layers.grid.rows
    return np.array(
        [(rows - each.row - south, each.column - west, each.size, each.turn, each.top, each.score) for each in found]
    )


def test_tiles_do_not_show() -> None:
    """The ground lies within one tile, or its boxes on the edges of four."""
    inner = counted(90, 90)
    found = places(scan(inner, 2.0), inner, 90, 90)
    for box in ((40, 24), (18, 60)):
        assert np.abs(found[:, :2] - box).max(axis=1).min() <= 3
    for west, south in ((SIDE - 24, SIDE - 40), (SIDE - 60, SIDE - 18)):
        other = counted(west, south)
        np.testing.assert_allclose(places(scan(other, 2.0), other, west, south), found, rtol=1e-4, atol=1e-3)


def test_a_point_sixty_kilometres_away_takes_a_tile() -> None:
    inner, wide = counted(90, 90), counted(90, 90, far=120_000)
    np.testing.assert_allclose(
        places(scan(wide, 2.0), wide, 90, 90), places(scan(inner, 2.0), inner, 90, 90), rtol=1e-3, atol=0.01
    )
    assert len(list(wide)) == len(list(inner)) + 1
    assert wide.window(0, 0, 10, 10).pulses.sum() == 0
