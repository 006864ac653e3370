"""Voxels with a plane around a place: those that a plain search finds, on both sides of zero and across the edges of cubes."""

import numpy as np

from groundproc.cloud import mixing
from groundproc.cloud.surroundings import Surroundings


def test_the_voxels_with_a_plane_around_a_place_are_found() -> None:
    rng = np.random.default_rng(8)
    # two slanted surfaces through the origin, of which some voxels are flat, and single points around
    place = rng.uniform([-6, -6, -0.01], [6, 6, 0.01], (60_000, 3))
    place[:, 2] += np.where(rng.random(len(place)) < 0.5, 0.2 * place[:, 0], -0.3 * place[:, 1])
    xyz_m = np.concatenate([place, rng.uniform(-6, 6, (3000, 3))])
    around = Surroundings()
    around.add(xyz_m, np.arange(len(xyz_m), dtype=np.int64) * 1000, np.full(xyz_m.shape, [0.0, 0.0, 50.0]))
    around.find_planes()
    planes = mixing.Mixing(around)._planes
    flat = (around.voxels.normal[: around.used] != 0.0).any(axis=1)
    assert 0.2 < flat.mean() < 0.9
    middles = np.floor(xyz_m / around.edge_m).astype(int)
    at = np.empty((around.used, 3), int)
    at[around.of(xyz_m)] = middles
    out = np.empty(27, np.int64)
    asked = rng.integers(-26, 26, (3000, 3))
    asked[:1000] = at[rng.integers(0, around.used, 1000)]
    found = 0
    for i, j, k in asked.tolist():
        many = mixing._flat_around(i, j, k, planes, out)
        beside = (np.abs(at - [i, j, k]) <= 1).all(axis=1) & flat
        assert sorted(out[:many].tolist()) == np.flatnonzero(beside).tolist()
        found += many
    assert found > 1000
