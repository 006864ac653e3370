"""Walks through voxels, against the crossings of all walls sorted along the line."""

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.numerics.voxelwalk import begin, next_axis

Array = npt.NDArray[np.float64]


def walked(place: Array, way: Array, edge_m: float) -> list[tuple[int, ...]]:
    """The voxels that a line goes through."""
    at = np.floor(place / edge_m).astype(np.int64)
    step, following, each = np.empty(3, np.int64), np.empty(3), np.empty(3)
    begin(place, way, at, edge_m, step, following, each)
    found = [tuple(at.tolist())]
    while True:
        axis = next_axis(following)
        if following[axis] >= 1.0:
            return found
        at[axis] += step[axis]
        following[axis] += each[axis]
        found.append(tuple(at.tolist()))


def crossed(place: Array, way: Array, edge_m: float) -> list[tuple[int, ...]]:
    """The same, from the middles between all crossings of walls."""
    ends = place / edge_m, (place + way) / edge_m
    shares = [0.0, 1.0]
    for axis in range(3):
        low, high = sorted((ends[0][axis], ends[1][axis]))
        walls = np.arange(np.floor(low) + 1, np.ceil(high))
        shares += ((walls * edge_m - place[axis]) / way[axis]).tolist()
    middles = np.convolve(np.sort(shares), [0.5, 0.5], "valid")
    return [tuple(each) for each in np.floor((place + middles[:, None] * way) / edge_m).astype(int).tolist()]


@pytest.mark.parametrize("edge_m", [1.0, 0.3])
def test_a_line_goes_through_the_voxels_between_its_crossings(edge_m: float) -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        place, way = rng.uniform(-5.0, 5.0, 3), rng.normal(0.0, 4.0, 3)
        assert walked(place, way, edge_m) == crossed(place, way, edge_m)


@pytest.mark.parametrize("way", [(3.0, 0.0, 0.0), (0.0, -3.0, 0.0), (0.0, 0.0, 3.0)])
def test_a_line_along_an_axis_stays_in_its_row(way: tuple[float, float, float]) -> None:
    found = np.array(walked(np.full(3, 0.5), np.array(way), 1.0))
    np.testing.assert_array_equal(found, np.arange(4)[:, None] * np.sign(way).astype(int))


def test_a_line_of_no_length_stays_in_its_voxel() -> None:
    assert walked(np.full(3, 0.5), np.zeros(3), 1.0) == [(0, 0, 0)]
