import json
import os
import stat
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from flightlog import records
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from flightlog.records import HostClock
from onboard import logfolder
from onboard.backlog import Backlog
from onboard.config import RecorderConfig
from onboard.logfolder import next_segment_path, write_atomically
from onboard.recorder import Recorder
from onboard.segment import Segment

FIRST = (records.HOST_CLOCK.topic, 5, records.encode_host_clock(HostClock(5, 6, 7, 8)))


def segment(path: Path) -> Segment:
    return Segment(path, {"swath.session": {"host": "here"}}, {"mount.yaml": b"x: 1\n"}, ["/mavlink/ins"], FIRST)


def test_names_count_boots_and_segments_within_a_boot(tmp_path: Path) -> None:
    names = []
    for boot in ("a", "a", "b", "b", "c"):
        path = next_segment_path(tmp_path / "logs", boot)
        path.touch()
        names.append(path.name)
    assert names == [
        "00001-000.mcap", "00001-001.mcap", "00002-000.mcap", "00002-001.mcap", "00003-000.mcap",
    ]  # fmt: skip


def test_the_boot_counter_outlives_the_logs_and_the_logs_outlive_the_counter(tmp_path: Path) -> None:
    for boot in ("a", "b"):
        next_segment_path(tmp_path, boot).touch()
    for path in tmp_path.glob("*.mcap"):
        path.unlink()
    assert next_segment_path(tmp_path, "c").name == "00003-000.mcap"
    (tmp_path / "00007-002.mcap").touch()
    assert next_segment_path(tmp_path, "c").name == "00008-000.mcap"
    (tmp_path / "00008-000.mcap").touch()
    (tmp_path / "boot.json").write_text("{ damaged")
    assert next_segment_path(tmp_path, "d").name == "00009-000.mcap"


@pytest.mark.parametrize(
    "content", ["", "[]", "null", "{}", '{"boot_id": "a"}', '{"number": 3}', '{"boot_id": "a", "number": null}', "\x00"]
)
def test_a_counter_that_cannot_be_read_is_begun_anew_after_the_logs_that_are_there(
    tmp_path: Path, content: str
) -> None:
    folder = tmp_path / "deep" / "logs"
    assert next_segment_path(folder, "a").name == "00001-000.mcap"  # the folder is made, with those above it
    assert json.loads((folder / "boot.json").read_text()) == {"boot_id": "a", "number": 1}
    (folder / "boot.json").write_text(content)
    (folder / "00004-002.mcap").touch()
    assert next_segment_path(folder, "a").name == "00005-000.mcap"
    assert next_segment_path(folder, "a").name == "00005-000.mcap"
    assert json.loads((folder / "boot.json").read_text()) == {"boot_id": "a", "number": 5}


@pytest.mark.parametrize("folder", ["file/logs", "file"])
def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path: Path, folder: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(LogError, match=r"logs cannot be written there \((Not a directory|File exists)\)"):
        next_segment_path(tmp_path / folder, "a")


def test_an_existing_segment_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "00001-000.mcap").write_bytes(b"a flight")
    with pytest.raises(LogError, match="File exists"):
        segment(tmp_path / "00001-000.mcap")
    assert (tmp_path / "00001-000.mcap").read_bytes() == b"a flight"


def test_what_a_log_needs_to_be_read_is_in_the_file_as_soon_as_it_is_open(tmp_path: Path) -> None:
    opened = segment(tmp_path / "a.mcap")
    copy = tmp_path / "copy.mcap"
    copy.write_bytes((tmp_path / "a.mcap").read_bytes())  # what is on the disk now
    with LogReader(copy) as log:
        assert log.metadata["swath.session"] == {"host": "here"}
        assert log.attachments == {"mount.yaml": b"x: 1\n"}
        assert [message.topic for message in log.messages()] == [records.HOST_CLOCK.topic]
        assert log.damage.truncated
    opened.close()
    with LogReader(tmp_path / "a.mcap") as log:
        assert not log.damage


def test_a_full_backlog_refuses_at_once_and_keeps_room_for_small_messages() -> None:
    backlog = Backlog(1000)
    assert backlog.put("a", 1, bytes(600), vital=False)
    assert not backlog.put("b", 2, bytes(600), vital=False)
    assert backlog.put("c", 3, bytes(600), vital=True)
    assert (backlog.size_bytes, backlog.refused) == (1200, 1)
    assert [item.topic for item in backlog.get()] == ["a", "c"]
    assert backlog.get() == []
    assert backlog.size_bytes == 0


def test_what_was_handed_over_is_on_the_disk_within_two_syncs_and_complete_at_the_end(tmp_path: Path) -> None:
    recorder = Recorder(RecorderConfig(str(tmp_path), sync_ms=100), lambda _: segment(tmp_path / "a.mcap"))
    recorder.start()
    assert recorder.put("/mavlink/ins", 10, records.encode_raw(10, [(10, b"one")], "ins"), True)
    synced, end = recorder.counts.syncs, time.monotonic() + 90
    while recorder.counts.syncs < synced + 2:
        assert time.monotonic() < end
        time.sleep(0.02)
    copy = tmp_path / "copy.mcap"
    copy.write_bytes((tmp_path / "a.mcap").read_bytes())
    with LogReader(copy) as log:
        assert [records.decode_raw(message.data) for message in log.messages(("/mavlink/",))] == [[(10, b"one")]]
    recorder.put("/mavlink/ins", 11, records.encode_raw(11, [(11, b"two")], "ins"), True)
    recorder.stop()
    assert recorder.failure is None
    with LogReader(tmp_path / "a.mcap") as log:
        assert not log.damage
        assert len(list(log.messages(("/mavlink/",)))) == 2
    assert recorder.counts.syncs >= 2


def test_a_sync_follows_what_was_handed_over_when_it_is_nearly_due_and_no_sooner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ns = 10**12
    monkeypatch.setattr("onboard.recorder.time", SimpleNamespace(monotonic_ns=lambda: now_ns))
    recorder = Recorder(RecorderConfig(str(tmp_path), sync_ms=4000), lambda _: segment(tmp_path / "a.mcap"))
    begin_ns = now_ns
    # of 4 s, seven eighths are near; what nobody says is handed over waits for the end of the four
    for at_ms, told, syncs in ((100, True, 0), (3499, True, 0), (3500, True, 1), (7400, False, 1), (7500, False, 2)):
        now_ns = begin_ns + at_ms * 10**6
        recorder.put("/mavlink/ins", 10, records.encode_raw(10, [(10, b"one")], "ins"), True)
        if told:
            recorder.handed_over()
            assert recorder.backlog.pressing.is_set() == (at_ms >= 3500)
        recorder._go_round()
        assert recorder.counts.syncs == syncs, at_ms
    with LogReader(tmp_path / "a.mcap") as log:
        assert len(list(log.messages(("/mavlink/",)))) == 5
    recorder._close_segment()


@pytest.fixture
def forced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is forced on to the disk from here on, and what is renamed, by name and in order."""
    found: list[str] = []
    fsync, replace = os.fsync, os.replace

    def noted(descriptor: int) -> None:
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        found.append(
            path.name if path.is_dir() or path.suffix == ".mcap" else f"{path.name}: {path.read_text().strip()}"
        )
        fsync(descriptor)

    def renamed(source: str, target: Path) -> None:
        found.append(f"-> {target.name}")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(os, "replace", renamed)
    return found


def test_names_and_contents_are_forced_on_to_the_disk_in_the_order_that_a_power_cut_needs(
    tmp_path: Path, forced: list[str]
) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    logfolder.sync_directory(folder)
    assert forced == ["logs"]
    forced.clear()
    write_atomically(folder / "s", "one")  # the content, then the name, then the folder that holds it
    assert forced == [".s.new: one", "-> s", "logs"]
    forced.clear()
    write_atomically(folder / "s", "two", sync=False)
    assert forced == ["-> s"]
    forced.clear()
    logfolder.append_to_manifest(folder, {"file": "a"})
    assert forced == ['manifest.jsonl: {"file": "a"}', "logs"]


def test_a_segment_is_on_the_disk_by_name_before_it_is_used_and_whole_before_it_is_in_the_manifest(
    tmp_path: Path, forced: list[str]
) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    opened = segment(folder / "00001-000.mcap")
    assert forced == ["logs"]
    opened.close()
    assert [word.partition(":")[0] for word in forced] == ["logs", "00001-000.mcap", "logs", "manifest.jsonl", "logs"]


def test_a_file_replaced_atomically_is_never_seen_half_written(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        write_atomically(tmp_path / "s", "one")
        write_atomically(tmp_path / "s", "two", sync=False)
    finally:
        os.umask(before)
    assert (tmp_path / "s").read_text() == "two"
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o644  # others may read it, whatever the umask
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
