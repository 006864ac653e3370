"""Points as bytes: exact to the millimetre, the same bytes every time, and what a byte of an attribute means."""

import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from groundproc.viewer.packing import along_curve, pack
from groundproc.viewer.shades import NO_VALUE, TIME, shades_of


def unpack(packed: bytes, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """As the page does it: web/report.js."""
    raw = gzip.decompress(packed)
    count, planes = np.frombuffer(raw, "<u4", 2).tolist()
    bytes_ = np.frombuffer(raw, np.uint8, offset=8)
    parts = bytes_[: 3 * planes * count].reshape(3, planes, count).astype(np.int64)
    zigzag = sum(parts[:, k] << (8 * k) for k in range(planes))
    steps = np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1).T
    return steps, bytes_[3 * planes * count :].reshape(columns, count)


@given(arrays(np.int64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.integers(-(10**9), 10**9)))
def test_what_is_packed_is_there_to_the_millimetre(steps: np.ndarray) -> None:
    mark = np.arange(len(steps), dtype=np.uint8)
    places, columns = unpack(pack(steps / 1000.0, [mark]), 1)
    back = places[np.argsort(columns[0], kind="stable")] if len(steps) else places
    np.testing.assert_array_equal(back, steps)


def test_neighbours_in_space_are_neighbours_in_the_file_and_its_bytes_are_always_the_same() -> None:
    rng = np.random.default_rng(1)
    place = rng.uniform(0.0, 100.0, (20_000, 3))
    along = place[along_curve(np.rint(place * 1000).astype(np.int64))]
    step = np.linalg.norm(np.diff(along, axis=0), axis=1)
    # a cube's worth of space for each point is 3.7 m wide; unsorted, the mean is 66 m
    assert np.median(step) < 2 * (1e6 / 20_000) ** (1 / 3)
    assert pack(place, []) == pack(place, [])


def test_a_byte_says_what_the_value_was() -> None:
    columns = {
        "intensity": np.array([3, 200, 90], np.uint16),
        "classification": np.array([2, 6, 2], np.uint8),
        "point_source_id": np.array([7, 900, 7], np.uint16),
        "range": np.array([4.0, np.nan, 29.4], np.float32),
        "laser": np.array([5, 5, 5], np.uint8),
    }
    found = {shade.name: shade for shade in shades_of(columns, np.array([0.0, 1.0, 2.0]))}
    assert list(found) == [
        "intensity",
        "classification",
        "point_source_id",
        "range",
        TIME,
    ]  # all of one laser: tells nothing
    assert found["intensity"].kinds == ()
    assert (
        found["intensity"].low + found["intensity"].encode(columns["intensity"]) * found["intensity"].step
    ).tolist() == [3, 200, 90]
    assert found["classification"].encode(columns["classification"]).tolist() == [2, 6, 2]
    strips = found["point_source_id"]
    assert [strips.kinds[byte] for byte in strips.encode(columns["point_source_id"])] == [7, 900, 7]
    assert strips.encode(np.array([8], np.uint16)).tolist() == [NO_VALUE]  # one that came later
    ranges = found["range"].encode(columns["range"])
    assert ranges[1] == NO_VALUE
    assert found["range"].low + found["range"].step * ranges[[0, 2]] == pytest.approx(
        [4.0, 29.4], abs=found["range"].step / 2
    )
