"""The segment is deleted, the folder goes, the disk turns read-only: for real, under a recorder that is writing."""

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.records import HostClock
from onboard import logfolder
from onboard.config import RecorderConfig
from onboard.logfolder import next_segment_path, read_manifest
from onboard.recorder import Recorder
from onboard.segment import Segment

CLOCK = records.encode_host_clock(HostClock(5, 6, 7, 8))
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root to mount a small file system")


def opened(directory: Path) -> Segment:
    path = next_segment_path(directory, "boot")
    return Segment(
        path, {"swath.session": {"boot_id": "boot"}}, {}, ["/mavlink/ins"], (records.HOST_CLOCK.topic, 5, CLOCK)
    )


@pytest.fixture
def start() -> Iterator[Callable[..., Recorder]]:
    running: list[Recorder] = []

    def begin(directory: Path, *folders: Path) -> Recorder:
        recorder = Recorder(
            RecorderConfig(str(directory), folders=tuple(map(str, folders)), sync_ms=50, min_free_mb=1), opened
        )
        recorder.start()
        running.append(recorder)
        return recorder

    yield begin
    for recorder in running:
        recorder.stop()
        assert recorder.failure is None


def until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def stamps(path: Path) -> list[int]:
    with LogReader(path) as log:
        return [message.log_time_ns for message in log.messages(("/mavlink/ins",))]


def put(recorder: Recorder, *times_ns: int) -> None:
    for time_ns in times_ns:
        assert recorder.put("/mavlink/ins", time_ns, records.encode_raw(time_ns, [(time_ns, b"x")], "ins"), True)


def test_a_deleted_segment_is_noticed_and_recording_goes_on_in_a_new_one(
    tmp_path: Path, start: Callable[..., Recorder]
) -> None:
    recorder = start(tmp_path)
    put(recorder, 1)
    until(lambda: recorder.counts.messages == 1)
    (tmp_path / recorder.counts.segment).unlink()
    until(lambda: recorder.counts.segments == 2)
    assert recorder.counts.abandoned == 1
    put(recorder, 2)
    recorder.stop()
    (name,) = read_manifest(tmp_path)
    assert stamps(tmp_path / name) == [2]
    assert recorder.counts.trouble == ""


@pytest.mark.parametrize("what", ["segment", "folder"])
def test_a_segment_that_is_moved_ends_there_and_recording_goes_on_where_people_look(
    tmp_path: Path, start: Callable[..., Recorder], what: str
) -> None:
    folder = tmp_path / "logs"
    recorder = start(folder)
    put(recorder, 1)
    until(lambda: recorder.counts.messages == 1)
    name = recorder.counts.segment
    here, there = (folder / name, folder / "mine.mcap") if what == "segment" else (folder, tmp_path / "moved")
    here.rename(there)
    until(lambda: recorder.counts.segments == 2)
    assert recorder.counts.abandoned == 1
    put(recorder, 2)
    recorder.stop()
    (name_after,) = read_manifest(folder)
    assert stamps(folder / name_after) == [2]
    with LogReader(there if what == "segment" else there / name) as log:
        assert not log.damage.truncated
        assert [message.log_time_ns for message in log.messages(("/mavlink/ins",))] == [1]


def test_a_folder_that_is_removed_is_made_again(tmp_path: Path, start: Callable[..., Recorder]) -> None:
    folder = tmp_path / "logs"
    recorder = start(folder)
    shutil.rmtree(folder)
    until(lambda: recorder.counts.segments == 2)
    put(recorder, 7)
    recorder.stop()
    (name,) = read_manifest(folder)
    assert stamps(folder / name) == [7]


@needs_root
@pytest.mark.root
def test_a_disk_that_turns_read_only_is_one_sentence_and_nothing_is_lost_when_it_is_back(
    tmp_path: Path, start: Callable[..., Recorder]
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(disk)], check=True)
    try:
        recorder = start(disk)
        put(recorder, 1)
        until(lambda: recorder.counts.messages == 1)
        opened_before = recorder.counts.segments
        # what is open for writing keeps a file system from being remounted: so the segment is gone first
        (disk / recorder.counts.segment).unlink()
        subprocess.run(["mount", "-o", "remount,ro,size=64m", str(disk)], check=False)
        until(lambda: recorder.counts.abandoned == 1)
        if not os.access(disk, os.W_OK) or os.statvfs(disk).f_flag & os.ST_RDONLY:
            until(lambda: "Read-only" in recorder.counts.trouble)
            put(recorder, 2, 3)
            subprocess.run(["mount", "-o", "remount,rw,size=64m", str(disk)], check=True)
        else:
            put(recorder, 2, 3)
        until(lambda: recorder.counts.segments > opened_before and recorder.counts.trouble == "")
        recorder.stop()
        assert [stamp for name in read_manifest(disk) for stamp in stamps(disk / name)] == [2, 3]
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


def test_another_folder_takes_over_where_one_is_named(tmp_path: Path, start: Callable[..., Recorder]) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    recorder = start(first, second)
    shutil.rmtree(first)
    first.touch()  # no folder any more, and none can be made
    until(lambda: recorder.counts.trouble.startswith(f"recording to {second} instead: {first}: logs cannot be written"))
    put(recorder, 9)
    recorder.stop()
    (name,) = read_manifest(second)
    assert stamps(second / name) == [9]


def test_the_thousandth_segment_of_a_boot_has_its_number_and_its_place(tmp_path: Path) -> None:
    for number in (998, 999, 1000, 1001):
        path = next_segment_path(tmp_path, "boot") if number != 998 else tmp_path / "00001-998.mcap"
        assert path.name == f"00001-{number}.mcap"
        path.touch()
        if number == 998:
            (tmp_path / "boot.json").write_text('{"boot_id": "boot", "number": 1}')
    assert [path.name for path in logfolder.leftovers(tmp_path)] == [
        "00001-998.mcap", "00001-999.mcap", "00001-1000.mcap", "00001-1001.mcap",
    ]  # fmt: skip
    (tmp_path / "100000-000.mcap").touch()
    assert next_segment_path(tmp_path, "next").name == "100001-000.mcap"


def test_what_nobody_needs_any_more_goes_in_the_order_of_numbers(tmp_path: Path) -> None:
    for number in (1000, 999):
        path = tmp_path / f"00001-{number}.mcap"
        path.touch()
        logfolder.append_to_manifest(tmp_path, {"file": path.name, "sha256": f"{number:064d}"})
    (tmp_path / logfolder.ACKNOWLEDGED).write_text("".join(f'{{"sha256": "{n:064d}"}}\n' for n in (999, 1000)))
    gone = logfolder.prune(tmp_path, lambda: len(list(tmp_path.glob("*.mcap"))) == 1)
    assert gone == ["00001-999.mcap"]
