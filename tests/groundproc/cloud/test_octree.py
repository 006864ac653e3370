"""Nodes of an octree: every point in one node that contains it, parents coarser than children, in bounded pieces."""

import os
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.cloud import octree, octreelevels
from groundproc.cloud.octree import Key, Octree
from groundproc.cloud.octreeparts import Square, cells_of, count_cells, parts_of
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
    assert max(len(some) for some in nodes.values()) <= octreelevels.LEAF + 8 * 1_000 + 128**2


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


def test_a_place_flown_over_for_long_takes_no_more_memory_than_a_piece(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four squares of the ground get fifteen times as many points as are dealt with at once, and no array holds those of a square."""
    monkeypatch.setattr(octree, "_LARGEST_PIECE", 10_000)
    monkeypatch.setattr("groundproc.cloud.spool._WAITING_BYTES", 200_000)
    points = records(150_000, (14.0, 14.0, 2.0))
    built(points[:20_000], tmp_path)  # compiled code takes memory too
    tree = Octree(RECORD, SCALES, tmp_path)
    for piece in np.array_split(points, 60):
        tree.add(piece)
    count, largest = 0, 0
    tracemalloc.start()
    try:
        for _, some in tree.nodes():
            owner = some if some.base is None else some.base
            count, largest = count + len(some), max(largest, owner.nbytes)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert count == len(points)
    assert largest <= (octreelevels.LEAF + 8 * 1_000) * RECORD.itemsize
    assert peak < 2_200_000 < points.nbytes  # all in one array, and parts of it, were 12,300,000


def test_what_waits_is_parted_as_it_would_be_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every square but the smallest is quartered while it holds too much: parts found by counting are those, one after the other."""
    points = records(30_000, (20.0, 20.0, 2.0))
    within = np.stack([points[name].astype(np.int64) + 10_000 for name in "XY"], axis=1)
    square = Square((0, 0), 15)
    counts, first = cells_of(square, 4)
    assert (counts.shape, first) == ((32, 32), Square((0, 0), 10))
    count_cells(within, first, counts)
    np.testing.assert_array_equal(counts, np.histogram2d(within[:, 1], within[:, 0], np.arange(33) * 1024)[0])
    parts, number = parts_of(square, counts, 2_000)
    sides = [1 << each.bits for each in parts]
    inside = [(within // side == each.place).all(axis=1).nonzero()[0] for each, side in zip(parts, sides, strict=True)]
    cell = within // 1024
    for each, some in enumerate(inside):
        assert len(some) > 0
        assert len(some) <= 2_000 or parts[each].bits == 10
        assert (number[cell[some, 1], cell[some, 0]] == each).all()
        parent = 2 << parts[each].bits
        assert ((within // parent == np.array(parts[each].place) // 2).all(axis=1)).sum() > 2_000
    assert sum(map(len, inside)) == len(points)


def test_a_million_points_within_a_millimetre_are_shared_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They fill the deepest node, and of what is too much each batch a larger one around it: no node grows with their number."""
    monkeypatch.setattr(octree, "_LARGEST_PIECE", 100_000)
    points = records(1_050_000, (200.0, 200.0, 8.0))
    for name in "XYZ":
        points[name][50_000:] = 7
    cube, nodes = built(points, tmp_path)
    check(points, cube, nodes)
    assert max(map(len, nodes.values())) < 100_000 + 2 * octreelevels.LEAF
    monkeypatch.setattr(octree, "MOST", 10_000)
    points = points[np.r_[:2, 50_000:250_000]]
    monkeypatch.setattr(octree, "_LARGEST_PIECE", 100)
    with pytest.raises(octree.CrowdError) as found:
        built(points, tmp_path)
    assert found.value.steps == (7, 7, 7)
    assert found.value.count > 10_000


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


def test_a_spool_can_be_looked_through_and_gives_back_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("groundproc.cloud.spool._WAITING_BYTES", 100_000)
    spool, points = Spool(RECORD, tmp_path), records(60_000, (50.0, 50.0, 2.0))
    for some in np.array_split(points, 20):
        spool.add((0, 0), some)

    def on_disk() -> int:
        return os.fstat(spool._file.fileno()).st_blocks * 512

    before = on_disk()
    assert before > 100_000
    for _ in range(2):
        np.testing.assert_array_equal(np.concatenate(list(spool.look((0, 0)))), points)
    assert (on_disk(), spool.counts) == (before, {(0, 0): len(points)})
    np.testing.assert_array_equal(np.concatenate(list(spool.pieces((0, 0)))), points)
    if sys.platform == "linux":  # no other system is asked to make holes
        assert on_disk() < before / 10


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
