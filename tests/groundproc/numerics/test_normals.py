import numpy as np

from groundproc.numerics.normals import normals


def test_normals_of_some_points_are_those_of_all() -> None:
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(0.0, 6.0, (4000, 2)), rng.normal(0.0, 0.01, 4000)])
    wall = np.column_stack([rng.uniform(0.0, 6.0, 2000), rng.normal(3.0, 0.01, 2000), rng.uniform(0.0, 4.0, 2000)])
    xyz = np.concatenate([flat, wall])
    every = normals(xyz)
    assert np.isfinite(every.sigma_rad).mean() > 0.9
    rows = rng.permutation(len(xyz))[:500]
    for asked in (rows, slice(7, None, 11)):
        for some, of_all in zip(normals(xyz, of=asked), every, strict=True):
            np.testing.assert_array_equal(some, of_all[asked])
    upright = np.abs(every.normal[: len(flat), 2]) > np.cos(np.radians(3.0))
    far = np.abs(flat[:, 1] - 3.0) > 1.0
    assert upright[far].all()
