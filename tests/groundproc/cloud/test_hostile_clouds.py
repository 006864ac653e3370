"""LAS and LAZ files whose heads and tables lie: each is one sentence, and asks for no memory that the file cannot fill."""

import contextlib
import random
import resource
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from flightlog.errors import CaptureError, SourceError
from groundproc.cloud import laz, reader
from groundproc.cloud.gpstime import Clock

COUNT = 120_000
"""Points of three chunks."""
LIMIT_BYTES = 6 << 30
"""Of address space while they are read; what some of these files ask for is ten times as much."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A cloud in layers, as format 6 packs it."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    cloud = laspy.LasData(header)
    cloud.points = laspy.ScaleAwarePointRecord.zeros(COUNT, header=header)
    rng = np.random.default_rng(1)
    for name in "XYZ":
        cloud.points.array[name] = rng.integers(-10_000, 10_000, COUNT)
    cloud.points.array["gps_time"] = 1e8 + np.arange(COUNT) * 1e-4
    path = tmp_path_factory.mktemp("clouds") / "whole.laz"
    cloud.write(path)
    return path.read_bytes()


def points_at(data: bytes) -> int:
    return int(struct.unpack_from("<I", data, 96)[0])


def packing_at(data: bytes) -> int:
    """Where the record of the packing begins."""
    return data.index(b"laszip encoded") + 52


def table_at(data: bytes) -> int:
    return int(struct.unpack_from("<q", data, points_at(data))[0])


def layers_at(data: bytes) -> int:
    """Sizes of the first chunk's layers, behind its first point and its number of points."""
    return points_at(data) + 8 + 30 + 4


LIES: dict[str, tuple[Callable[[bytes], int], str, int]] = {
    "chunks in the table": (lambda data: table_at(data) + 4, "<I", 0xFFFF_FFFF),
    "many chunks in the table": (lambda data: table_at(data) + 4, "<I", 100_000_000),
    "the table far behind the end": (points_at, "<q", 1 << 62),
    "the table before the file": (points_at, "<q", -2),
    "bytes of a layer": (layers_at, "<I", 0xFFFF_FFF0),
    "points of a chunk": (lambda data: packing_at(data) + 12, "<I", 0),
    "bytes of an item": (lambda data: packing_at(data) + 36, "<H", 0xFFFF),
    "items": (lambda data: packing_at(data) + 32, "<H", 0xFFFF),
    "points": (lambda data: 247, "<Q", 1 << 60),
    "points that would fit": (lambda data: 247, "<Q", 2 * COUNT),
    "bytes of a point": (lambda data: 105, "<H", 0xFFFF),
    "where the points begin": (lambda data: 96, "<I", 0xFFFF_FFFF),
    "the points begin in the head": (lambda data: 96, "<I", 0),
    "bytes of the head": (lambda data: 94, "<H", 0),
    "variable length records": (lambda data: 100, "<I", 0xFFFF_FFFF),
    "extended records": (lambda data: 243, "<I", 0xFFFF_FFFF),
    "one extended record, behind the end": (lambda data: 235, "<QI", 0),
    "no scale": (lambda data: 131, "<d", 0),
}


def read(path: Path) -> int:
    """All of it, as `swath adjust` does; gives the number of points."""
    cloud = reader.look(path)
    count = 0
    for chunk in reader.chunks(cloud, Clock(week=2300)):
        assert np.isfinite(chunk.points.xyz_m).all()
        count += len(chunk.points)
    return count


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_about_sizes_or_counts_is_one_sentence(tmp_path: Path, whole: bytes, lie: str) -> None:
    where, form, value = LIES[lie]
    data = bytearray(whole)
    values = (len(data) - 10, 1) if form == "<QI" else (value,)
    struct.pack_into(form, data, where(whole), *values)
    path = tmp_path / "a.laz"
    path.write_bytes(data)
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, before[1]))
    try:
        with pytest.raises(CaptureError, match=r"a\.laz: ") as caught:
            read(path)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert len(str(caught.value)) < 500
    assert "\n" not in str(caught.value)


def test_damage_in_the_last_chunk_is_found_when_it_is_reached(tmp_path: Path, whole: bytes) -> None:
    data = bytearray(whole)
    place = table_at(whole) - 20_000
    data[place : place + 10_000] = random.Random(1).randbytes(10_000)
    path = tmp_path / "a.laz"
    path.write_bytes(data)
    with contextlib.suppress(CaptureError):
        assert read(path) == COUNT  # LAZ has no checksum: points may be wrong and whole in number


def test_what_is_unpacked_apart_is_what_laspy_unpacks(
    tmp_path: Path, whole: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(whole)
    theirs = laspy.read(path)
    monkeypatch.setattr(reader, "CHUNK", 7_001)  # pieces that end within chunks, the last one short
    cloud = reader.look(path)
    pieces = [chunk.record.array for chunk in reader.chunks(cloud)]
    assert [len(piece) for piece in pieces] == [7_001] * 17 + [COUNT - 17 * 7_001]
    assert np.array_equal(np.concatenate(pieces), theirs.points.array)


def test_huge_chunks_are_unpacked_point_by_point(tmp_path: Path, whole: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(whole)
    monkeypatch.setattr(laz, "_CHUNK_BYTES", 1000)
    cloud = reader.look(path)
    records = [chunk.record.array for chunk in reader.chunks(cloud)]
    assert np.array_equal(np.concatenate(records), laspy.read(path).points.array)


def test_reading_ends_with_the_reader_and_leaves_no_process(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(whole)
    with reader.opened(path) as opened:
        opened.read_points(COUNT)
        child = opened.point_source._child
    assert child.returncode is not None


def test_times_beyond_any_calendar_are_refused(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(whole)
    cloud = laspy.read(path)
    cloud.gps_time[7] = 1e300
    cloud.write(path)
    with pytest.raises(CaptureError, match="gps_time is 1e\\+300 for some points"):
        read(path)


def test_mutated_clouds_are_points_or_one_sentence(tmp_path: Path, whole: bytes) -> None:
    dice = random.Random(3)
    path = tmp_path / "a.laz"
    for _ in range(25):
        data = bytearray(whole)
        for _ in range(dice.choice((1, 2, 8))):
            place = dice.choice(
                (dice.randrange(500), points_at(whole) + dice.randrange(200), dice.randrange(len(data)))
            )
            data[place] = dice.randrange(256)
        path.write_bytes(data)
        with contextlib.suppress(CaptureError):
            read(path)


def test_the_cases_that_aborted_are_one_sentence(cases: Path) -> None:
    for name in ("laz_abort.laz", "las_memory.las"):
        with pytest.raises(CaptureError, match="is damaged"):
            read(cases / "hostile" / name)


def test_a_process_that_is_killed_is_no_damage(whole: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A system without memory kills the one that unpacks: the file may be sound."""
    start = laz.start

    def killed(task: Any) -> Any:
        child = start(task)
        child.kill()
        child.wait()
        return child

    monkeypatch.setattr(laz, "start", killed)
    path = tmp_path / "sound.laz"
    path.write_bytes(whole)
    with pytest.raises(SourceError, match=r"sound\.laz: the process that unpacks its points was killed \(SIGKILL\)"):
        list(reader.chunks(reader.look(path)))
