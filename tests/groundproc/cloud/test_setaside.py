"""Parts of a cloud set aside as it is written: the same records as the file holds, and nothing is unpacked for them."""

import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundproc.cloud import laz, reader
from groundproc.cloud.points import Points
from groundproc.cloud.setaside import SetAside
from groundproc.cloud.writer import BUFFER_POINTS, CloudWriter

RECORD = np.dtype([("x", "<i4"), ("class", "u1")])


def records(count: int) -> Any:
    made = np.zeros(count, RECORD)
    made["x"], made["class"] = np.arange(count), np.arange(count) % 7
    return made


@pytest.mark.parametrize("pieces", [[1000], [1, 99, 400, 500], [250, 250, 250, 250], [333, 333, 334]])
def test_parts_come_back_however_the_records_came(pieces: list[int]) -> None:
    parts = [(0, 100), (100, 150), (251, 1), (400, 500), (999, 1)]
    aside, all_, at = SetAside(lambda: parts), records(1000), 0
    for count in pieces:
        assert not aside.has(parts)
        aside.see(all_[at : at + count])
        at += count
    assert aside.has(parts)
    assert not aside.has(parts[:-1])
    assert not aside.has([])
    for first, count in [*parts, *reversed(parts)]:
        np.testing.assert_array_equal(aside.read((first, count), RECORD), all_[first : first + count])


def test_of_a_cloud_that_ended_early_nothing_is_told() -> None:
    aside = SetAside(lambda: [(0, 10), (90, 20)])
    aside.see(records(100))
    assert not aside.has([(0, 10), (90, 20)])


def test_a_full_disk_keeps_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    aside = SetAside(lambda: [(0, 10)])
    aside.see(records(100))
    aside.see(records(100))
    assert not aside.has([(0, 10)])


def test_a_disk_that_fills_up_has_its_room_back_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The cloud itself is written to it."""

    class Filling(io.BytesIO):
        def write(self, given: Any) -> int:
            if self.tell() >= 50:
                raise OSError(28, "No space left on device")
            return super().write(bytes(given)[:50])

    file = Filling()
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: file)
    aside = SetAside(lambda: [(0, 100)])
    aside.see(records(100))
    assert file.closed
    aside.see(records(100))
    assert not aside.has([(0, 100)])


def test_a_writer_sets_aside_what_its_file_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count = BUFFER_POINTS + 20_000  # a part lies across two buffers
    rng = np.random.default_rng(3)
    columns: dict[str, Any] = {
        "intensity": rng.integers(0, 256, count).astype(np.uint16),
        "range": rng.uniform(1, 90, count).astype(np.float32),
    }
    points = Points(10**18 + np.arange(count), rng.uniform(-50, 50, (count, 3)), columns)
    parts = [(1000, 50_000), (BUFFER_POINTS - 5000, 10_000)]
    aside = SetAside(lambda: parts)
    path = tmp_path / "cloud.laz"
    with CloudWriter(path, columns, aside=aside) as writer:
        writer.write(points)
    cloud = reader.look(path)
    of_file = list(reader.chunks(cloud, parts=parts))
    monkeypatch.setattr(laz, "start", lambda task: pytest.fail("nothing is to be unpacked"))
    kept = list(reader.chunks(cloud, parts=parts, aside=aside))
    for each, own in zip(kept, of_file, strict=True):
        np.testing.assert_array_equal(each.record.array, own.record.array)
        np.testing.assert_array_equal(each.points.xyz_m, own.points.xyz_m)
        assert each.points.columns.keys() == own.points.columns.keys()
        for name, values in own.points.columns.items():
            np.testing.assert_array_equal(each.points[name], values)
