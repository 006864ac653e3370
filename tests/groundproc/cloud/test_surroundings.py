"""Planes around points, and the passes over a flight that find them."""

import gc
import weakref
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightlog.errors import ConfigError
from flightlog.mount import Mount
from groundproc.cloud import attributes, surroundings
from groundproc.cloud.points import Points
from groundproc.cloud.pointsigma import MountErrors
from groundproc.cloud.surroundings import Surroundings
from groundproc.cloud.voxels import VoxelMap
from groundproc.geodesy import LocalFrame
from groundproc.sensors.model import Ranging
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

START_NS = 1_779_272_223_000_000_000
SENSOR = np.array([0.0, 0.0, 20.0])


def around(xyz: Array) -> Surroundings:
    """The surroundings of points that came one by one."""
    made = Surroundings()
    for some in np.array_split(xyz, 7):
        if len(some):
            made.add(np.ascontiguousarray(some), START_NS + np.arange(len(some)), np.tile(SENSOR, (len(some), 1)))
    made.find_planes()
    return made


def incidence(made: Surroundings, xyz: Array) -> npt.NDArray[np.float32]:
    return made.incidence_deg(xyz, np.tile(SENSOR, (len(xyz), 1)), made.of(xyz))


@settings(max_examples=25, deadline=None)
@given(st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)), st.integers(0, 99))
def test_on_a_noisy_plane_the_angle_is_that_of_the_plane(direction: tuple[float, float, float], seed: int) -> None:
    normal = np.array(direction)
    if np.linalg.norm(normal) < 0.1:
        return
    normal /= np.linalg.norm(normal)
    rng = np.random.default_rng(seed)
    one, two = np.linalg.svd(normal[None])[2][1:]
    place = rng.uniform(-4, 4, (12_000, 2))  # 190 points a square metre
    xyz = 3.0 * normal + place[:, :1] * one + place[:, 1:] * two + rng.normal(0, 0.018, (12_000, 1)) * normal
    found = incidence(around(xyz), xyz)
    way = xyz - SENSOR
    true = np.rad2deg(np.arccos(np.clip(np.abs(way @ normal) / np.linalg.norm(way, axis=1), 0, 1)))
    inner = np.abs(place).max(axis=1) < 3.0
    # whatever level tells it does so to 0.04 rad, one sigma at worst; where the plane passes through its middle to 0.3 deg
    assert np.isfinite(found[inner]).mean() > 0.999
    assert np.nanpercentile(np.abs(found - true)[inner], 95) < np.rad2deg(2 * 0.04)
    assert np.nanmedian(np.abs(found - true)[inner]) < 0.6


def test_beside_an_edge_each_side_has_its_own_plane() -> None:
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-5, 0, 8000), rng.uniform(-3, 3, 8000), rng.normal(0, 0.015, 8000)])
    wall = np.column_stack([rng.normal(0, 0.015, 8000), rng.uniform(-3, 3, 8000), rng.uniform(0, 5, 8000)])
    made = around(np.concatenate([ground, wall]))
    for side, normal in ((ground, [0, 0, 1]), (wall, [1, 0, 0])):
        way = side - SENSOR
        true = np.rad2deg(np.arccos(np.abs(way @ np.array(normal, float)) / np.linalg.norm(way, axis=1)))
        off = np.abs(incidence(made, side) - true)
        beside_edge = np.abs(side[:, 0] if normal[2] else side[:, 2]) < 1.0
        assert np.nanpercentile(off[~beside_edge], 95) < 2.0
        assert np.nanpercentile(off[beside_edge], 75) < 5.0


def test_leaves_and_a_wire_have_no_plane() -> None:
    rng = np.random.default_rng(2)
    leaves = rng.uniform(-2, 2, (3000, 3))
    wire = np.column_stack([rng.uniform(-20, 20, 400), rng.normal(30, 0.01, 400), rng.normal(8, 0.01, 400)])
    made = around(np.concatenate([leaves, wire]))
    assert np.isnan(incidence(made, leaves)).mean() > 0.95
    assert np.isnan(incidence(made, wire)).all()


def test_a_sparse_plane_is_told_by_the_larger_voxel() -> None:
    rng = np.random.default_rng(4)
    xyz = np.column_stack([rng.uniform(-20, 20, (6400, 2)), rng.normal(0, 0.01, 6400)])  # 4 points a square metre
    found = incidence(around(xyz), xyz)
    true = np.rad2deg(np.arctan2(np.hypot(xyz[:, 0], xyz[:, 1]), 20.0))
    assert np.isfinite(found).mean() > 0.9
    assert np.nanpercentile(np.abs(found - true), 90) < 1.5


def test_room_for_more_voxels_is_made_without_losing_any() -> None:
    rng = np.random.default_rng(5)
    xyz = rng.uniform(-60, 60, (200_000, 3))
    made = Surroundings()
    for some in np.array_split(xyz, 9):
        made.add(np.ascontiguousarray(some), START_NS + np.arange(len(some)), np.tile(SENSOR, (len(some), 1)))
    made.settle()
    cells = np.unique(np.floor(xyz / made.edge_m).astype(int), axis=0)
    assert made.used == len(cells)
    assert int(made.voxels.many[: made.used].sum()) == len(xyz)
    assert (made.of(xyz) >= 0).all()
    assert (made.of(xyz + 1000.0) == -1).all()


def scene() -> attributes.Scene:
    time_ns = START_NS + np.array([0, 100 * 10**9], np.int64)
    zero, quat = np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1))
    trajectory = Trajectory(
        LocalFrame(58.4, 15.5, 60.0), time_ns, np.tile(SENSOR, (2, 1)), zero, quat, zero, zero + 0.02, zero + 1e-3,
        np.array([True, False]),
    )  # fmt: skip
    return attributes.Scene(trajectory, Mount(), MountErrors(np.zeros(3), np.zeros(3)), Ranging(0.015, 2.8e-3, 0.6))


def pieces(count: int = 20) -> list[Points]:
    """Pieces of a flight that moves on over flat ground; the third is empty."""
    made = []
    for number in range(count):
        rng = np.random.default_rng(number)
        size = 0 if number == 2 else 4000
        xyz = np.column_stack(
            [rng.uniform(0, 6, size) + 5.0 * number, rng.uniform(-3, 3, size), rng.normal(0, 0.01, size)]
        )
        time_ns = START_NS + number * 10**9 + np.arange(size) * 1000
        made.append(Points(time_ns, xyz, {"range": np.full(size, 20.0, np.float32)}))
    return made


def stream() -> Iterator[Points]:
    return iter(pieces())


def test_points_come_in_their_order_whatever_the_stretches(monkeypatch: pytest.MonkeyPatch) -> None:
    names = attributes.wanted(None)
    whole = list(attributes.described(stream, scene(), names))
    monkeypatch.setattr(surroundings, "MOST", 1500)
    cut = list(attributes.described(stream, scene(), names))
    for found in (whole, cut):
        assert [len(some) for some in found] == [len(some) for some in pieces()]
        for some, before in zip(found, pieces(), strict=True):
            np.testing.assert_array_equal(some.xyz_m, before.xyz_m)
            if len(some):
                assert set(some.columns) == {"range", *(name for each in attributes.NAMES.values() for name in each)}
                assert np.isfinite(some["incidence"]).mean() > 0.95


def test_one_stretch_at_a_time_is_in_memory_however_long_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but what holds a stretch keeps it: it is gone with its last point, and does not wait for the collector of cycles."""
    alive: weakref.WeakSet[VoxelMap] = weakref.WeakSet()
    most: list[int] = []

    begin = VoxelMap.__init__

    def counted(made: VoxelMap, edge_m: float, room: int) -> None:
        begin(made, edge_m, room)
        alive.add(made)
        most.append(sum(each.edge_m == surroundings.EDGE_M for each in alive))

    monkeypatch.setattr(VoxelMap, "__init__", counted)
    monkeypatch.setattr(surroundings, "MOST", 1500)
    found = attributes.Found()
    gc.collect()
    gc.disable()
    try:
        for some in attributes.described(stream, scene(), attributes.wanted(None), found):
            assert len(some) == 0 or len(alive) == 1  # the larger voxels are gone before points are handed on
    finally:
        gc.enable()
    assert len(most) > 20
    assert max(most) == 1
    assert not alive
    assert len(found.stretches) > 4
    assert not any(hasattr(each, "of_voxel") for each in found.stretches)


def test_a_stretch_takes_as_much_memory_as_it_has_voxels() -> None:
    made = around(np.random.default_rng(6).uniform(-20, 20, (60_000, 3)))
    size = surroundings.MOST + 1
    assert len(made.voxels.key) > size
    assert 2 * made.used <= len(made.table) <= 8 * made.used
    for number, (cubes, parent) in made.levels.items():
        assert len(parent) == made.used
        assert len(cubes.voxels.key) <= made.used
        assert len(cubes.table) <= 8 * made.used, number
    made.keep_planes_only()
    assert not made.levels
    held = {name for name, array in made.voxels._asdict().items() if len(array)}
    assert held == {"key", "sums", "normal"}


def test_points_of_a_flight_line_have_its_number() -> None:
    lines = replace(scene(), line_begins_ns=START_NS + np.array([5, 12]) * 10**9)
    found = list(attributes.described(stream, lines, attributes.wanted(("strip",))))
    told = [np.unique(some["point_source_id"]).tolist() for some in found if len(some)]
    assert told == [[1]] * 4 + [[2]] * 7 + [[3]] * 8


def test_what_needs_no_surroundings_takes_one_pass() -> None:
    passes = 0

    def counted() -> Iterator[Points]:
        nonlocal passes
        passes += 1
        return stream()

    found = list(attributes.described(counted, scene(), attributes.wanted(("sigma",))))
    assert passes == 1 == attributes.passes(attributes.wanted(("sigma",)))
    assert set(found[0].columns) == {"range", "sigma_h", "sigma_v"}
    assert not attributes.wanted(())


def test_an_attribute_that_there_is_not_is_named() -> None:
    with pytest.raises(ConfigError, match="'colour' found, expected some of scan_angle"):
        attributes.wanted(("sigma", "colour"))
