"""Clouds in squares: each point once, with all that lies near it, and what was found of it in its place."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from groundproc.cloud.tiles import AT_ONCE, Found, Tiles, side_for


def test_every_point_is_core_once_and_sees_all_within_the_halo(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    xyz = rng.uniform((-40.0, 10.0, 0.0), (35.0, 80.0, 5.0), (6000, 3))
    tiles = Tiles(tmp_path, {"value": "f4"}, 20.0, 1.5)
    for part in np.array_split(np.arange(6000), 7):
        tiles.add(xyz[part], {"value": part.astype(np.float32)})
    found = Found(tmp_path, {"near": np.int32}, tiles.points)
    seen = np.zeros(6000, int)
    for tile in tiles:
        seen[tile.number[tile.core]] += 1
        assert (tile.columns["value"] == tile.number).all()
        assert (tile.xyz_m == xyz[tile.number]).all()
        tree = cKDTree(tile.xyz_m[:, :2])
        near = tree.query_ball_point(tile.xyz_m[tile.core][:, :2], 1.5, return_length=True)
        found.put(tile.number[tile.core], {"near": near})
    assert (seen == 1).all()
    expected = cKDTree(xyz[:, :2]).query_ball_point(xyz[:, :2], 1.5, return_length=True)
    assert (found.take(0, 6000)["near"] == expected).all()


def test_squares_hold_so_many_points_and_are_never_small_beside_the_halo() -> None:
    side = side_for(10 * AT_ONCE, (0.0, 0.0), (1000.0, 1000.0), 2.0)
    assert np.isclose(side**2 / 1000.0**2 * 10 * AT_ONCE, AT_ONCE)
    assert side_for(10**9, (0.0, 0.0), (10.0, 10.0), 2.0) >= 16.0


def test_squares_of_a_thin_corridor_are_not_all_of_it() -> None:
    """What makes rasters of a square would fill the bounds of 40 km."""
    assert side_for(200_000, (0.0, 0.0), (33_000.0, 23_000.0), 10.0) == 1000.0
