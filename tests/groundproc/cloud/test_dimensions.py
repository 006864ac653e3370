"""The table of point attributes against laspy and the LAS standard's own words."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pytest

from flightlog.errors import UsageError
from groundproc.cloud import dimensions, reader
from groundproc.cloud.dimensions import TABLE, Dimension, dimension, in_order
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter

START_NS = 1_779_272_223_000_000_000
TOY = Dimension("depth", "u2", "above ground", "Height above the ground below.", "a toy", "m", 0.01, no_data=65_535)

STANDARD = {
    "intensity": ("u2", 0), "return_number": ("u1", 4), "number_of_returns": ("u1", 4), "classification": ("u1", 0),
    "user_data": ("u1", 0), "scan_angle": ("i2", 0), "point_source_id": ("u2", 0), "gps_time": ("f8", 0), "red": ("u2", 0),
    "green": ("u2", 0), "blue": ("u2", 0), "nir": ("u2", 0), "X": ("i4", 0), "Y": ("i4", 0), "Z": ("i4", 0),
}  # fmt: skip
"""Tables 16 to 20 of LAS 1.4 R15: type of each field, and its bits where they are less than a byte."""


def values_of(entry: Dimension, count: int) -> npt.NDArray[Any]:
    """Values over all that a column can hold, its ends among them."""
    if entry.stored.kind == "f":
        return np.linspace(-1e3, 1e3, count).astype(entry.column)
    low, high = entry.steps()
    steps = np.linspace(low, high, count).round().astype(np.int64)
    return (steps * (entry.scale or 1)).astype(entry.column)


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> tuple[Dimension, ...]:
    """The table with an attribute of a toy: one entry more, and nothing else of the program changed."""
    monkeypatch.setattr(dimensions, "TABLE", (*TABLE, TOY))
    monkeypatch.setattr(reader, "TABLE", (*TABLE, TOY))
    return dimensions.TABLE


def written(path: Path, table: tuple[Dimension, ...], count: int = 1000) -> Points:
    columns = {entry.name: values_of(entry, count) for entry in table}
    points = Points(START_NS + np.arange(count) * 1000, np.arange(3.0 * count).reshape(-1, 3) / 7, columns)
    with CloudWriter(path, columns) as cloud:
        cloud.write(points)
    return points


def test_laspy_finds_every_attribute_as_the_table_says(table: tuple[Dimension, ...], tmp_path: Path) -> None:
    points = written(tmp_path / "all.laz", table)
    cloud = laspy.read(tmp_path / "all.laz")
    (described,) = cloud.header.vlrs.get("ExtraBytesVlr")
    records = described.extra_bytes_structs
    extras = {found.name: found for found in cloud.point_format.extra_dimensions}
    assert list(extras) == [entry.name for entry in table if not entry.field]
    for entry in (*table, *dimensions.PLACED):
        found = cloud.point_format.dimension_by_name(entry.field or entry.name)
        if entry.field:
            dtype, bits = STANDARD[entry.field]
            assert entry.stored == np.dtype(dtype)
            assert not bits or found.num_bits == bits
            assert found.is_standard
        else:
            assert found.dtype == entry.stored
            assert found.description == entry.description
            assert (None if found.scales is None else float(found.scales[0])) == entry.scale
            record = next(each for each in records if each.name.rstrip(b"\0").decode() == entry.name)
            assert (None if record.no_data is None else int(record.no_data[0])) == entry.no_data
            # nothing is said of least and largest values
            assert record.min is None
            assert record.max is None
    for entry in table:
        stored = np.asarray(cloud[entry.field or entry.name], np.float64)
        # laspy scales extra bytes, and leaves fields of the standard as they are
        scale = entry.scale if entry.field and entry.scale else 1.0
        np.testing.assert_allclose(stored * scale, points[entry.name], rtol=2e-7)


def test_what_was_written_comes_back_in_the_tables_units(table: tuple[Dimension, ...], tmp_path: Path) -> None:
    points = written(tmp_path / "all.laz", table)
    cloud = reader.look(tmp_path / "all.laz")
    assert cloud.columns == tuple(entry.name for entry in table)
    (chunk,) = reader.chunks(cloud, Clock())
    np.testing.assert_allclose(chunk.points.xyz_m, points.xyz_m, rtol=0.0, atol=0.0005 + 1e-9)
    # a double of 4.6e8 s is good to 6e-8 s
    assert np.abs(chunk.points.time_ns - points.time_ns).max() < 100
    for entry in table:
        again = chunk.points[entry.name]
        assert again.dtype == entry.column
        np.testing.assert_allclose(again, points[entry.name], rtol=2e-7)


def test_an_attribute_is_one_entry_and_the_stage_that_fills_it(table: tuple[Dimension, ...], tmp_path: Path) -> None:
    placed = Points(np.full(3, START_NS), np.zeros((3, 3)), {"intensity": np.ones(3, np.uint8)})
    assert table[-1] is TOY
    with pytest.raises(UsageError, match=r"depth \(above ground\) .* which have intensity; a toy fills it"):
        placed["depth"]
    filled = placed.with_columns(depth=np.array([0.0, 12.34, np.nan], np.float32))
    with CloudWriter(tmp_path / "a.laz", filled.columns) as cloud:
        cloud.write(filled)
    stored = laspy.read(tmp_path / "a.laz")
    assert stored.points.array["depth"].tolist() == [0, 1234, 65_535]
    # only what something fills is written
    assert [found.name for found in stored.point_format.extra_dimensions] == ["depth"]
    (chunk,) = reader.chunks(reader.look(tmp_path / "a.laz"))
    np.testing.assert_array_equal(chunk.points["depth"], filled["depth"])


def test_names_are_unique_and_unknown_ones_are_our_mistake() -> None:
    assert len({entry.name for entry in (*TABLE, *dimensions.PLACED)}) == len(TABLE) + 4
    assert in_order(["range", "intensity"]) == [dimension("intensity"), dimension("range")]
    with pytest.raises(KeyError, match="colour"):
        Points(np.zeros(1, np.int64), np.zeros((1, 3)), {"colour": np.zeros(1)})
    with pytest.raises(AssertionError, match="laser"):
        Points(np.zeros(1, np.int64), np.zeros((1, 3)), {"laser": np.zeros(1)})


def test_points_are_masked_together() -> None:
    columns = {"laser": np.arange(4, dtype=np.uint8), "range": np.arange(4, dtype=np.float32)}
    points = Points(np.arange(4), np.arange(12.0).reshape(4, 3), columns)
    some = points.masked(np.array([False, True, False, True]))
    assert len(some) == 2
    assert some.time_ns.tolist() == some["laser"].tolist() == some["range"].tolist() == [1, 3]
    assert some.xyz_m.tolist() == [[3.0, 4.0, 5.0], [9.0, 10.0, 11.0]]
    assert "laser" in some
    assert "depth" not in some
