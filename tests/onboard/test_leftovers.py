"""Logs that were left open: torn, damaged inside, empty, finished but not entered; mended beside a recording."""

import random
import stat
from pathlib import Path

import pytest
from mcap.reader import make_reader

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.records import HostClock
from onboard import leftovers, logfolder
from onboard.leftovers import Salvager
from onboard.logfolder import read_manifest
from onboard.segment import Segment

COUNT = 8


def left_open(directory: Path, number: int, *, finished: bool = False) -> Path:
    """A segment with 8 synced messages that nobody closed."""
    path = directory / f"00001-{number:03d}.mcap"
    dice = random.Random(number)
    first = (records.HOST_CLOCK.topic, 5, records.encode_host_clock(HostClock(5, 6, 7, 8)))
    segment = Segment(path, {"swath.session": {"boot_id": "before"}}, {"mount.yaml": b"m"}, ["/mavlink/ins"], first)
    for i in range(COUNT):
        segment.write("/mavlink/ins", i, records.encode_raw(i, [(i, dice.randbytes(6000))], "ins"))
        segment.sync()
    if finished:
        segment._writer.finish()
    segment._file.close()
    return path


def mend(directory: Path) -> Salvager:
    salvager = leftovers.begin(directory, 1 << 20, "none")
    salvager.run()
    return salvager


def times(log: Path) -> list[int]:
    with log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [message.log_time for _, _, message in reader.iter_messages("/mavlink/ins")]


def test_a_torn_log_is_made_whole_read_only_and_entered_with_what_was_lost(tmp_path: Path) -> None:
    path = left_open(tmp_path, 0)
    path.write_bytes(path.read_bytes()[:-1000])
    salvager = mend(tmp_path)
    assert times(path) == list(range(COUNT - 1))
    line = read_manifest(tmp_path)[path.name]
    assert (line["how"], line["boot_id"], line["sha256"]) == ("salvaged", "before", logfolder.sha256(path))
    assert line["lost"]["truncated"] is True
    assert line["lost"]["lost_bytes"] > 4000
    assert line["messages"]["/mavlink/ins"] == COUNT - 1
    assert stat.S_IMODE(path.stat().st_mode) == 0o444
    assert {p.name for p in tmp_path.iterdir()} == {path.name, "manifest.jsonl"}
    assert (salvager.counts.found, salvager.counts.mended, salvager.counts.left) == (1, 1, 0)
    assert mend(tmp_path).counts.found == 0


@pytest.mark.parametrize("interrupted_before", [False, True])
def test_a_damaged_original_is_kept_beside_what_could_be_read_of_it(tmp_path: Path, interrupted_before: bool) -> None:
    path = left_open(tmp_path, 0)
    before = bytearray(path.read_bytes())
    before[len(before) // 2] ^= 1
    path.write_bytes(before)
    if interrupted_before:
        path.with_name("00001-000.mcap.damaged").hardlink_to(path)
    salvager = mend(tmp_path)
    assert salvager.counts.lossy == 1
    assert len(times(path)) == COUNT - 1
    damaged = tmp_path / "00001-000.mcap.damaged"
    assert damaged.read_bytes() == before
    lines = read_manifest(tmp_path)
    assert {name: line["how"] for name, line in lines.items()} == {path.name: "salvaged", damaged.name: "damaged"}
    assert lines[damaged.name]["sha256"] == logfolder.sha256(damaged)


def test_a_whole_log_that_only_misses_its_line_is_not_touched(tmp_path: Path) -> None:
    path = left_open(tmp_path, 0, finished=True)
    before = path.read_bytes()
    mend(tmp_path)
    assert path.read_bytes() == before
    assert read_manifest(tmp_path)[path.name]["how"] == "whole"


@pytest.mark.parametrize("content", [b"", b"\x89MCAP", b"zeros" + bytes(5000)])
def test_what_is_no_log_is_set_aside_and_does_not_come_up_again(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "00001-000.mcap").write_bytes(content)
    torn = left_open(tmp_path, 1)
    salvager = mend(tmp_path)
    assert (tmp_path / "00001-000.mcap.unreadable").read_bytes() == content
    assert (salvager.counts.mended, salvager.counts.left) == (1, 1)
    assert len(times(torn)) == COUNT
    assert mend(tmp_path).counts.found == 0
    assert logfolder.next_segment_path(tmp_path, "x").name == "00002-000.mcap"


def test_without_space_a_leftover_stays_as_it_is_and_comes_up_again(tmp_path: Path) -> None:
    path = left_open(tmp_path, 0)
    before = path.read_bytes()
    salvager = leftovers.begin(tmp_path, 1 << 60, "none")
    salvager.run()
    assert salvager.counts.left == 1
    assert path.read_bytes() == before
    assert leftovers.begin(tmp_path, 0, "none").counts.found == 1


def test_a_segment_that_is_being_written_is_no_leftover(tmp_path: Path) -> None:
    first = (records.HOST_CLOCK.topic, 5, records.encode_host_clock(HostClock(5, 6, 7, 8)))
    segment = Segment(tmp_path / "00001-000.mcap", {}, {}, [], first)
    mend(tmp_path)
    assert not read_manifest(tmp_path)
    assert segment.close().how == "closed"


def test_what_an_interrupted_salvage_left_is_begun_anew(tmp_path: Path) -> None:
    path = left_open(tmp_path, 0)
    (tmp_path / "00001-000.mcap.salvage").write_bytes(b"half of it")
    mend(tmp_path)
    assert len(times(path)) == COUNT
    assert not (tmp_path / "00001-000.mcap.salvage").exists()


def test_a_stop_leaves_the_original_for_the_next_start(tmp_path: Path) -> None:
    path = left_open(tmp_path, 0)
    before = path.read_bytes()
    salvager = leftovers.begin(tmp_path, 0, "none")
    salvager.stop()
    salvager.run()
    assert path.read_bytes() == before
    assert not read_manifest(tmp_path)
    with LogReader(path) as log:
        assert log.damage.truncated
