"""Nodes of COPC files: laspy's reader is the witness; damaged files give one sentence."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest

from flightlog.errors import CaptureError
from groundproc.cloud import exports, reader
from groundproc.cloud.nodes import NodeReader, is_copc, octree_of
from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter


@pytest.fixture(scope="module")
def octree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("nodes")
    rng = np.random.default_rng(8)
    place = rng.uniform(0, [60, 40, 8], (120_000, 3))
    columns = {
        "intensity": rng.integers(0, 999, 120_000).astype(np.uint16),
        "range": rng.uniform(1, 9, 120_000).astype(np.float32),
    }
    with CloudWriter(folder / "plain.laz", columns) as writer:
        writer.write(Points(10**18 + np.arange(120_000), place, columns))
    exports.write(reader.look(folder / "plain.laz"), folder / "a.copc.laz", folder / "a.copc.laz", lambda done: None)
    return folder / "a.copc.laz"


def test_all_nodes_together_are_the_cloud(octree: Path) -> None:
    assert is_copc(octree)
    assert not is_copc(octree.with_name("plain.laz"))
    cloud, found = reader.look(octree), octree_of(octree)
    assert sum(node.points for node in found.nodes.values()) == cloud.points == 120_000
    told, times = [], []
    with NodeReader(cloud, found) as nodes:
        for (level, x, y, z), node in sorted(found.nodes.items(), reverse=True):  # any order
            points, time_s = nodes.read(node, ["intensity"])
            side = found.side_m / 2**level
            corner = np.array(found.corner_m) + np.array([x, y, z]) * side
            assert (points.xyz_m >= corner - 0.002).all()
            assert (points.xyz_m <= corner + side + 0.002).all()
            assert list(points.columns) == ["intensity"]
            told.append(np.column_stack([points.xyz_m, points["intensity"]]))
            times.append(time_s)
    whole = laspy.read(octree)
    order, own = np.lexsort(np.concatenate(told).T), np.lexsort([whole.intensity, whole.z, whole.y, whole.x])
    assert np.concatenate(told).shape == (120_000, 4)
    np.testing.assert_allclose(np.concatenate(told)[order, :3].sum(axis=0), whole.xyz[own].sum(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(np.sort(np.concatenate(times)), np.sort(np.asarray(whole.gps_time)))
    with laspy.CopcReader.open(octree) as witness:
        root = witness.query(level=0)
    with NodeReader(cloud, found) as nodes:
        first, _ = nodes.read(found.nodes[0, 0, 0, 0])
    np.testing.assert_array_equal(first.xyz_m, np.stack([root.x, root.y, root.z], axis=1))


def test_a_damaged_node_is_said_and_the_others_are_still_read(octree: Path, tmp_path: Path) -> None:
    found = octree_of(octree)
    key, node = max(found.nodes.items())
    raw = bytearray(octree.read_bytes())
    raw[node.place + 40 : node.place + node.size] = b"\xff" * (node.size - 40)
    bad = tmp_path / "bad.copc.laz"
    bad.write_bytes(raw)
    with NodeReader(reader.look(bad), octree_of(bad)) as nodes:
        with pytest.raises(CaptureError, match="node {} is damaged".format("-".join(map(str, key)))):
            nodes.read(node)
        assert len(nodes.read(found.nodes[0, 0, 0, 0])[0]) == found.nodes[0, 0, 0, 0].points


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (40, struct.pack("<Q", 10**15), "a page of its hierarchy has"),
        (48, struct.pack("<Q", 10**15), "a page of its hierarchy has"),
        (48, struct.pack("<Q", 33), "a page of its hierarchy has 33 bytes"),
        (0, struct.pack("<d", float("nan")), "its octree lies at nan"),
        (24, struct.pack("<d", -1.0), "m wide"),
    ],
)
def test_a_hierarchy_that_cannot_be_is_refused(
    octree: Path, tmp_path: Path, place: int, value: bytes, said: str
) -> None:
    raw = bytearray(octree.read_bytes())
    raw[429 + place : 429 + place + len(value)] = value
    bad = tmp_path / "bad.copc.laz"
    bad.write_bytes(raw)
    with pytest.raises(CaptureError, match=said):
        octree_of(bad)


@pytest.mark.parametrize(
    ("at", "form", "value"), [(0, "<i", -2), (4, "<i", 9), (28, "<i", 10**7), (24, "<i", 2**30), (28, "<i", -7)]
)
def test_an_entry_that_cannot_be_is_refused(octree: Path, tmp_path: Path, at: int, form: str, value: int) -> None:
    raw = bytearray(octree.read_bytes())
    root, size = struct.unpack_from("<2Q", raw, 429 + 40)
    assert size % 32 == 0
    struct.pack_into(form, raw, root + at, value)
    bad = tmp_path / "bad.copc.laz"
    bad.write_bytes(raw)
    with pytest.raises(CaptureError, match="is damaged"):
        octree_of(bad)
