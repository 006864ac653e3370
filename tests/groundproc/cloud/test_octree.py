"""Nodes of an octree: every point in one node that contains it, parents coarser than children, in bounded pieces."""

import tracemalloc
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.cloud import octree
from groundproc.cloud.octree import Key, Octree
from groundproc.cloud.spool import Spool

RECORD = np.dtype([("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("number", "<u4")])
SCALES = np.full(3, 0.001)


def records(count: int, extent_m: tuple[float, float, float], seed: int = 1) -> npt.NDArray[np.void]:
    """Points on a rolling surface with a dense spot, in millimetres about an origin, numbered."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.5, 0.5, (count, 3)) * extent_m
    places[: count // 3, :2] = rng.normal(0.0, 0.4, (count // 3, 2))
    places[:, 2] = extent_m[2] * np.sin(places[:, 0] / 7.0) * 0.5 + rng.normal(0, 0.02, count)
    out = np.empty(count, RECORD)
    for axis, name in enumerate("XYZ"):
        out[name] = np.rint(places[:, axis] / 0.001)
    out["number"] = np.arange(count)
    return rng.permutation(out)


def built(points: npt.NDArray[np.void], folder: Path) -> tuple[octree.Cube, dict[Key, npt.NDArray[np.void]]]:
    tree = Octree(RECORD, SCALES, folder)
    for piece in np.array_split(points, 5):
        tree.add(piece)
    cube = tree.cube()
    nodes: dict[Key, npt.NDArray[np.void]] = {}
    for key, some in tree.nodes():
        assert key not in nodes, "a node comes once"
        nodes[key] = some.copy()
    return cube, nodes


def check(points: npt.NDArray[np.void], cube: octree.Cube, nodes: dict[Key, npt.NDArray[np.void]]) -> None:
    """Every point once, unchanged, and within its node."""
    together = np.concatenate(list(nodes.values()))
    assert len(together) == len(points)
    np.testing.assert_array_equal(np.sort(together, order="number"), np.sort(points, order="number"))
    for (level, *place), some in nodes.items():
        side = cube.side_m / 2**level / 0.001
        for axis, name in enumerate("XYZ"):
            low = cube.corner[axis] + place[axis] * side
            assert (some[name] >= low - 1e-6).all()
            assert (some[name] <= low + side + 1e-6).all()


def test_every_point_is_in_one_node_that_contains_it(tmp_path: Path) -> None:
    points = records(200_000, (90.0, 60.0, 8.0))
    cube, nodes = built(points, tmp_path)
    assert cube.side_m == pytest.approx(90.0, abs=0.01)
    check(points, cube, nodes)
    assert (0, 0, 0, 0) in nodes
    assert max(len(some) for some in nodes.values()) <= octree.LEAF + 8 * 1_000 + 128**2


def test_points_of_a_level_keep_the_distance_of_its_voxels(tmp_path: Path) -> None:
    """No two points of a node that has children share one of its 128 voxels along a side, but for handfuls given back to it."""
    cube, nodes = built(records(200_000, (90.0, 60.0, 8.0)), tmp_path)
    root = nodes[0, 0, 0, 0]
    voxel = cube.side_m / 0.001 / 128
    cells = np.stack([(root[name] - cube.corner[axis]) // voxel for axis, name in enumerate("XYZ")], axis=1)
    assert len(np.unique(cells, axis=0)) == len(cells)
    # the root shows all of the area: each voxel column that has points has one in the root

    def area(some: npt.NDArray[np.void]) -> set[tuple[int, int]]:
        columns = [np.minimum((some[name] - cube.corner[axis]) // voxel, 127) for axis, name in enumerate("XY")]
        return set(zip(*(each.astype(int).tolist() for each in columns), strict=True))

    assert area(root) == area(np.concatenate(list(nodes.values())))


def test_squares_with_very_many_points_are_split_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(octree, "_LARGEST_PIECE", 5_000)
    points = records(60_000, (40.0, 40.0, 3.0))
    check(points, *built(points, tmp_path))


def test_an_area_of_kilometres_has_its_topmost_levels(tmp_path: Path) -> None:
    points = records(50_000, (9_000.0, 5_000.0, 30.0))
    cube, nodes = built(points, tmp_path)
    check(points, cube, nodes)
    assert len(nodes[0, 0, 0, 0]) > 20


@pytest.mark.parametrize("count", [1, 2, 40_000])
def test_points_at_one_place_make_a_tree_too(count: int, tmp_path: Path) -> None:
    points = np.zeros(count, RECORD)
    points["number"] = np.arange(count)
    _, nodes = built(points, tmp_path)
    assert sum(map(len, nodes.values())) == count


def test_a_spool_gives_back_what_it_took_though_it_wrote_in_between(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("groundproc.cloud.spool._WAITING_BYTES", 20_000)
    spool, rng = Spool(RECORD, tmp_path), np.random.default_rng(3)
    points = records(20_000, (50.0, 50.0, 2.0))
    place = rng.integers(0, 9, len(points)).astype(np.int32)
    for some, number in zip(np.array_split(points, 50), np.array_split(place, 50), strict=True):
        spool.add_sorted(some, number, [(each, -each) for each in range(9)])
    assert not list(tmp_path.iterdir()), "the file has no name"
    for each in range(9):
        np.testing.assert_array_equal(spool.take((each, -each)), points[place == each])
    assert not spool.counts


def test_a_spool_keeps_no_more_in_memory_than_what_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each piece has one record of a square that is hardly met, which waits on: the rest of the piece does not wait with it."""
    monkeypatch.setattr("groundproc.cloud.spool._WAITING_BYTES", 1 << 20)
    spool = Spool(RECORD, tmp_path)
    points = records(20_000, (50.0, 50.0, 2.0))
    number = np.zeros(len(points), np.int32)
    number[0] = 1
    spool.add_sorted(points, number, [(0, 0), (1, -1)])  # compiled code takes memory too
    spool._write()
    tracemalloc.start()
    try:
        for each in range(100):
            spool.add_sorted(points, number, [(0, 0), (1, each)])
        held = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert held < (1 << 20) + 4 * points.nbytes < 20 * points.nbytes
