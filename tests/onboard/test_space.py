"""The disk fills up: for real on a small tmpfs, and by what the file system says in the pure parts."""

import contextlib
import json
import os
import stat
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.records import HostClock
from onboard import logfolder
from onboard.config import RecorderConfig
from onboard.logfolder import Space, acknowledged, next_segment_path, read_manifest, space
from onboard.recorder import Recorder
from onboard.segment import Segment

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root to mount a small file system")


def opened(directory: Path) -> Segment:
    first = (records.HOST_CLOCK.topic, 5, records.encode_host_clock(HostClock(5, 6, 7, 8)))
    path = next_segment_path(directory, "boot")
    return Segment(path, {"swath.session": {"boot_id": "boot"}}, {}, ["/mavlink/ins", records.LIDAR.topic], first)


def recorder(directory: Path, **options: int) -> Recorder:
    config = RecorderConfig(str(directory), sync_ms=50, **options)  # type: ignore[arg-type]
    return Recorder(config, opened)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 24 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def wait_for(condition: object, seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end
        time.sleep(0.02)


def scan(count: int = 181) -> bytes:
    packets = np.zeros(count, records.SCAN_PACKET_DTYPE)
    return records.encode_scan(1, packets)


def mavlink(number: int) -> bytes:
    return records.encode_raw(number, [(number, number.to_bytes(4, "little"))], "ins")


def numbers(log: Path) -> list[int]:
    with LogReader(log) as reader:
        assert not reader.damage
        found = reader.messages(("/mavlink/",))
        return [int.from_bytes(records.decode_raw(m.data)[0][1], "little") for m in found]


def test_space_gets_low_then_full_and_is_better_only_with_some_to_spare() -> None:
    walk = [
        (200, "room"),
        (99, "low"),
        (120, "low"),
        (150, "room"),
        (24, "full"),
        (30, "full"),
        (38, "low"),
        (160, "room"),
    ]
    now = Space.ROOM
    for free, expected in walk:
        now = space(free, 100, now)
        assert now.value == expected, free


@pytest.mark.root
@needs_root
def test_below_the_floor_the_lidar_stops_mavlink_goes_on_and_the_log_is_closed_well(small_disk: Path) -> None:
    writing = recorder(small_disk, min_free_mb=12)
    writing.start()
    number = refused = 0
    while writing.counts.space is Space.ROOM:
        refused += not writing.put(records.LIDAR.topic, number, scan(), False)
        assert writing.put("/mavlink/ins", number, mavlink(number), True)
        number += 1
        time.sleep(0.01)
    assert writing.counts.space is Space.LOW
    assert not writing.put(records.LIDAR.topic, number, scan(), False)
    for _ in range(20):
        assert writing.put("/mavlink/ins", number, mavlink(number), True)
        number += 1
    (small_disk / "other").write_bytes(bytes(logfolder.free_bytes(small_disk) - (2 << 20)))  # somebody else's
    wait_for(lambda: writing.counts.space is Space.FULL)
    wait_for(lambda: read_manifest(small_disk))
    assert not writing.put("/mavlink/ins", number, mavlink(number), True)
    (line,) = read_manifest(small_disk).values()
    log = small_disk / line["file"]
    assert numbers(log) == list(range(number))  # closed, whole, and nothing that was taken is missing
    assert line["sha256"] == logfolder.sha256(log)
    assert line["messages"]["/mavlink/ins"] == number
    assert stat.S_IMODE(log.stat().st_mode) == 0o444
    (small_disk / "other").unlink()
    log.unlink()
    wait_for(lambda: writing.counts.space is Space.ROOM and writing.counts.segments == 2)
    assert writing.put(records.LIDAR.topic, number, scan(), False)
    writing.stop()
    assert writing.failure is None
    assert writing.counts.refused_for_space == 2 + refused


@pytest.mark.root
@needs_root
def test_a_disk_that_fills_up_between_two_looks_tears_no_record_and_what_is_lost_is_counted(small_disk: Path) -> None:
    writing = recorder(small_disk, min_free_mb=1)
    (small_disk / "other").write_bytes(bytes(logfolder.free_bytes(small_disk) - (3 << 20)))
    number = 0
    while writing.put(records.LIDAR.topic, 0, scan(), False):  # 24 MB, into 3
        assert writing.put("/mavlink/ins", number, mavlink(number), True)
        number += 1
    writing.start()
    wait_for(lambda: writing.counts.space is Space.FULL)
    writing.stop()
    assert writing.failure is None
    (line,) = read_manifest(small_disk).values()
    assert line["sha256"] == logfolder.sha256(small_disk / line["file"])
    found = numbers(small_disk / line["file"])
    assert found == list(range(len(found)))
    assert 5 < len(found) < number
    with LogReader(small_disk / line["file"]) as log:
        written = sum(1 for _ in log.messages())
    assert written - 1 + writing.counts.lost_on_disk == 2 * number
    assert line["drops"]["disk"] > 0


def test_the_reserve_is_space_that_is_really_taken_and_is_given_back(tmp_path: Path) -> None:
    logfolder.hold_reserve(tmp_path)
    (held,) = tmp_path.iterdir()
    assert held.stat().st_size >= 4 << 20
    assert held.stat().st_blocks * 512 >= 4 << 20  # blocks of the disk, and not a file with a hole
    logfolder.release_reserve(tmp_path)
    logfolder.release_reserve(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.root
@needs_root
def test_where_there_is_no_room_for_a_reserve_none_is_left_behind(small_disk: Path) -> None:
    (small_disk / "other").write_bytes(bytes(logfolder.free_bytes(small_disk) - (3 << 20)))
    logfolder.hold_reserve(small_disk)
    assert [path.name for path in small_disk.iterdir()] == ["other"]
    assert logfolder.free_bytes(small_disk) > 2 << 20


@pytest.mark.root
@needs_root
def test_a_log_on_a_disk_that_others_filled_to_the_last_byte_is_closed_out_of_the_reserve(small_disk: Path) -> None:
    writing = recorder(small_disk, min_free_mb=1)
    writing.start()
    for number in range(5):
        assert writing.put("/mavlink/ins", number, mavlink(number), True)
    wait_for(lambda: writing.counts.messages == 5)
    with (small_disk / "other").open("wb", buffering=0) as other, contextlib.suppress(OSError):
        while True:
            other.write(bytes(1 << 16))
    wait_for(lambda: writing.counts.space is Space.FULL)
    writing.stop()
    assert writing.failure is None
    (line,) = read_manifest(small_disk).values()
    assert line["sha256"] == logfolder.sha256(small_disk / line["file"])
    assert numbers(small_disk / line["file"]) == list(range(5))


def finished(directory: Path, count: int) -> list[str]:
    names = []
    for number in range(count):
        segment = opened(directory)
        segment.write("/mavlink/ins", 9, mavlink(number))
        names.append(segment.close().file)
    return names


def test_the_oldest_acknowledged_logs_make_room_and_no_others(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    names = finished(tmp_path, 4)
    sums = {name: line["sha256"] for name, line in read_manifest(tmp_path).items()}
    with (tmp_path / "acknowledged.jsonl").open("w") as file:
        file.writelines(json.dumps({"file": name, "sha256": sums[name]}) + "\n" for name in (names[3], names[1]))
        file.write('{"file": "torn')
    assert acknowledged(tmp_path) == {sums[names[1]], sums[names[3]]}
    looks = iter([False, False, True])
    assert logfolder.prune(tmp_path, lambda: next(looks)) == [names[1]]
    assert logfolder.prune(tmp_path, lambda: False) == [names[3]]
    assert [path.name for path in sorted(tmp_path.glob("*.mcap"))] == [names[0], names[2]]
    # who reads the manifest afterwards sees which were deleted, by name and sum
    lines = read_manifest(tmp_path)
    assert {name: line["pruned"] for name, line in lines.items() if "pruned" in line} == {
        names[1]: sums[names[1]], names[3]: sums[names[3]],
    }  # fmt: skip
    assert caplog.messages == [f"{name} deleted to make room; it was acknowledged" for name in (names[1], names[3])]
    assert next_segment_path(tmp_path, "boot").name == "00001-004.mcap"  # the name of a deleted one is not used again


def test_a_manifest_line_torn_by_a_power_cut_spoils_no_other(tmp_path: Path) -> None:
    first = finished(tmp_path, 1)
    manifest = tmp_path / "manifest.jsonl"
    manifest.write_bytes(manifest.read_bytes() + b'{"file": "00001-001.mcap", "si')
    second = finished(tmp_path, 1)
    assert list(read_manifest(tmp_path)) == first + second


def test_lines_of_any_bytes_spoil_no_other_and_where_there_is_no_folder_nothing_is_known(tmp_path: Path) -> None:
    names = finished(tmp_path, 2)
    manifest = tmp_path / "manifest.jsonl"
    manifest.write_bytes(b"\xff\xfe{\n[1]\n7\n" + manifest.read_bytes() + '{"file": "ä.mcap"}\n'.encode())
    assert list(read_manifest(tmp_path)) == [*names, "ä.mcap"]
    assert read_manifest(tmp_path / "nowhere") == read_manifest(manifest) == {}
    assert acknowledged(tmp_path / "nowhere") == acknowledged(manifest) == set()


def test_a_segment_ends_at_its_size_or_its_age_and_not_before(tmp_path: Path) -> None:
    writing = recorder(tmp_path, segment_mb=2, segment_s=60)
    for size, age_s, due in (
        ((2 << 20) - 1, 59.9, False), (2 << 20, 0.0, True), (0, 60.0, True), (0, 0.0, False),
    ):  # fmt: skip
        looks_like = SimpleNamespace(size=size, age_s=age_s)
        assert writing._rotation_due(looks_like) is due, (size, age_s)  # type: ignore[arg-type] # no other part is read
    writing.rotate()
    assert writing._rotation_due(SimpleNamespace(size=0, age_s=0.0))  # type: ignore[arg-type] # the same
    writing._close_segment()


def test_after_a_full_disk_the_writer_goes_on_and_waits_for_room(tmp_path: Path) -> None:
    writing = recorder(tmp_path)
    writing._stop_for_space()
    assert writing.counts.space is Space.FULL
    assert list(read_manifest(tmp_path)) == ["00001-000.mcap"]
    before = writing.counts.last_sync_ns
    writing._go_round()  # it looks again only some seconds later
    assert (writing.counts.space, writing.counts.segments) == (Space.FULL, 1)
    writing._retry_ns = 0
    writing.counts.last_sync_ns = before - 10**9
    writing._go_round()
    assert (writing.counts.space, writing.counts.segments) == (Space.ROOM, 2)
    writing._close_segment()


def test_segments_end_by_size_by_age_and_on_demand_and_no_message_falls_between_them(tmp_path: Path) -> None:
    writing = recorder(tmp_path, segment_mb=1)
    writing.start()
    for number in range(40):
        assert writing.put(records.LIDAR.topic, number, scan(60), False)
        assert writing.put("/mavlink/ins", number, mavlink(number), True)
        time.sleep(0.02)
    opened_before = writing.counts.segments
    writing.rotate()
    wait_for(lambda: writing.counts.segments > opened_before)
    writing.stop()
    logs = sorted(tmp_path.glob("*.mcap"))
    assert len(logs) >= 3
    assert [number for log in logs for number in numbers(log)] == list(range(40))
    lines = read_manifest(tmp_path)
    assert [line["how"] for line in lines.values()] == ["closed"] * len(logs)
    assert sum(line["messages"].get("/mavlink/ins", 0) for line in lines.values()) == 40
    for log in logs:
        assert lines[log.name]["sha256"] == logfolder.sha256(log)
        assert lines[log.name]["size"] == log.stat().st_size
        assert lines[log.name]["boot_id"] == "boot"
