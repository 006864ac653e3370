"""A log cut at many places, with bits flipped and stretches missing: what comes out is whole, judged by the mcap library."""

import json
import random
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from flightlog import records
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from flightlog.salvage import SALVAGE, examine, salvage

CHUNKS = 12


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A finished log: a chunk for each of 12 flushes, with two messages each."""
    dice = random.Random(3)
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = LogWriter(
            stream, metadata={"swath.session": {"boot_id": "b"}}, attachments={"mount.yaml": b"m"}, compression="none"
        )
        for i in range(CHUNKS):
            writer.write("/mavlink/ins", i, records.encode_raw(i, [(i, dice.randbytes(50))], "ins"))
            writer.write("/mavlink/fc", i, records.encode_raw(i, [(i, dice.randbytes(5000))], "fc"))
            writer.flush()
        writer.finish()
    return path


def contents(path: Path) -> list[tuple[str, int, bytes]]:
    with LogReader(path) as log:
        return [(topic, time_ns, bytes(data)) for topic, time_ns, data in log.messages()]


def by_the_library(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = reader.iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in found]


def chunk_places(path: Path) -> list[tuple[int, int]]:
    """Offset and length of the chunks as the library has them."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [(chunk.chunk_start_offset, chunk.chunk_length) for chunk in summary.chunk_indexes]


def test_a_whole_log_has_nothing_to_mend(source: Path) -> None:
    found = examine(source)
    assert found.whole
    assert not found.lossy
    assert found.messages == {"/mavlink/ins": CHUNKS, "/mavlink/fc": CHUNKS}
    assert (found.start_ns, found.end_ns) == (0, CHUNKS - 1)


def test_a_log_cut_anywhere_gives_all_chunks_that_were_complete(source: Path, tmp_path: Path) -> None:
    whole, sent, places = source.read_bytes(), contents(source), chunk_places(source)
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    for size in range(places[0][0], len(whole) - 1, 1777):
        cut.write_bytes(whole[:size])
        found = salvage(cut, out)
        complete = sum(offset + length <= size for offset, length in places)
        assert by_the_library(out) == contents(out) == sent[: 2 * complete]
        assert found.truncated
        assert found.torn_tail_only
        assert found.bad_chunks == 0
        assert cut.read_bytes() == whole[:size]
        with LogReader(out) as log:
            assert not log.damage
            assert log.attachments == {"mount.yaml": b"m"}
            assert log.metadata["swath.session"] == {"boot_id": "b"}
            assert log.metadata[SALVAGE]["source"] == "cut.mcap"
        out.unlink()


def test_a_bit_flipped_in_a_chunk_costs_that_chunk_and_is_told(source: Path, tmp_path: Path) -> None:
    whole, sent, places = source.read_bytes(), contents(source), chunk_places(source)
    for number in (0, 5, CHUNKS - 1):
        offset, length = places[number]
        damaged = bytearray(whole)
        damaged[offset + length // 2] ^= 8
        (tmp_path / "bad.mcap").write_bytes(damaged)
        found = salvage(tmp_path / "bad.mcap", tmp_path / f"{number}.mcap")
        assert by_the_library(tmp_path / f"{number}.mcap") == sent[: 2 * number] + sent[2 * number + 2 :]
        assert (found.truncated, found.bad_chunks, found.lost_bytes) == (False, 1, length)
        assert not found.torn_tail_only
        assert found.places[0].startswith(f"byte {offset}: a damaged chunk")


def test_a_hole_of_zeros_as_a_card_leaves_it_costs_what_it_covers(source: Path, tmp_path: Path) -> None:
    whole, sent, places = bytearray(source.read_bytes()), contents(source), chunk_places(source)
    begin = places[4][0] + 100
    whole[begin : begin + 6000] = bytes(6000)  # into the sixth
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: places[10][0] + 70])
    found = salvage(cut, tmp_path / "out.mcap")
    assert by_the_library(tmp_path / "out.mcap") == sent[:8] + sent[12:20]
    assert found.lossy
    assert not found.torn_tail_only


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n"[:5], b"no log"])
def test_what_is_no_log_is_one_sentence_and_leaves_nothing(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(LogError, match="is no MCAP file"):
        salvage(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert not (tmp_path / "b.mcap").exists()


def test_nothing_is_overwritten(source: Path, tmp_path: Path) -> None:
    (tmp_path / "b.mcap").write_bytes(b"precious")
    with pytest.raises(LogError, match="File exists"):
        salvage(source, tmp_path / "b.mcap")
    assert (tmp_path / "b.mcap").read_bytes() == b"precious"


def test_the_new_log_is_read_by_a_stream_reader_with_every_checksum(source: Path, tmp_path: Path) -> None:
    salvage(source, tmp_path / "b.mcap", compression="lz4")
    with (tmp_path / "b.mcap").open("rb") as stream:
        assert sum(1 for _ in StreamReader(stream, validate_crcs=True).records) > 2 * CHUNKS


def test_a_person_is_told_what_there_was_and_what_is_lost(source: Path, tmp_path: Path) -> None:
    whole, places = source.read_bytes(), chunk_places(source)
    assert examine(source).sentences() == ["24 messages over 0.000 s; the log is whole"]
    cut, flipped = tmp_path / "cut.mcap", tmp_path / "flipped.mcap"
    offset, length = places[3]
    cut.write_bytes(whole[:offset])
    assert examine(cut).sentences() == [
        "6 messages over 0.000 s recovered; the log was cut off",
        "nothing that was in the file is lost; only its index was missing",
    ]
    damaged = bytearray(whole)
    damaged[offset + length // 2] ^= 8
    flipped.write_bytes(damaged)
    found = examine(flipped)
    assert found.sentences() == [
        "22 messages over 0.000 s recovered",
        f"lost: {length:,} bytes, 1 damaged chunks",
        f"  {found.places[0]}",
    ]
    assert found.to_mapping() == {
        "truncated": False, "bad_chunks": 1, "lost_bytes": length, "places": list(found.places),
    }  # fmt: skip


def test_the_new_log_says_what_it_was_made_of(source: Path, tmp_path: Path) -> None:
    damaged = bytearray(source.read_bytes())
    offset, length = chunk_places(source)[3]
    damaged[offset + length // 2] ^= 8
    (tmp_path / "bad.mcap").write_bytes(damaged)
    found = salvage(tmp_path / "bad.mcap", tmp_path / "good.mcap")
    with LogReader(tmp_path / "good.mcap") as log:
        said = dict(log.metadata[SALVAGE])
        assert sorted(log.metadata) == ["swath.log", SALVAGE, "swath.session"]
    assert said["source"] == "bad.mcap"
    assert json.loads(said["found"]) == found.to_mapping()
    with (tmp_path / "good.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().library == "swath recover"
        names = [entry.name for entry in reader.iter_metadata()]
    assert names.count("swath.log") == 1, "what the writer adds by itself is not copied beside it"
    assert names.count(SALVAGE) == 1


def test_times_are_those_of_the_messages_whatever_their_order_and_a_length_is_in_seconds(tmp_path: Path) -> None:
    path, seconds = tmp_path / "a.mcap", 10**9
    with path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={})
        for time_s in (50, 30, 90, 70):
            writer.write("/mavlink/ins", time_s * seconds, records.encode_raw(0, [], "ins"))
        writer.finish()
    found = examine(path)
    assert (found.start_ns, found.end_ns) == (30 * seconds, 90 * seconds)
    assert found.sentences() == ["4 messages over 60.000 s; the log is whole"]
    assert salvage(path, tmp_path / "b.mcap", compression="none").end_ns == 90 * seconds
    assert b"none" not in (tmp_path / "b.mcap").read_bytes()


def test_progress_is_told_in_bytes_of_the_source(source: Path, tmp_path: Path) -> None:
    for work in (lambda done: examine(source, done), lambda done: salvage(source, tmp_path / "b.mcap", progress=done)):
        done: list[int] = []
        work(done.append)
        assert sum(done) == source.stat().st_size
        assert len(done) > CHUNKS


def test_what_fails_half_way_leaves_nothing(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "b.mcap"
    for error, raised, said in (
        (
            OSError(28, "No space left on device"),
            LogError,
            rf"^{target}: cannot be written \(No space left on device\)$",
        ),
        (KeyboardInterrupt(), KeyboardInterrupt, "^$"),
    ):

        def fail(_: int, error: BaseException = error) -> None:
            raise error

        monkeypatch.setattr("os.fsync", fail)
        with pytest.raises(raised, match=said):
            salvage(source, target)
        assert not target.exists()
    with pytest.raises(LogError, match=r"none/b\.mcap: cannot be written \(No such file or directory\)$"):
        salvage(source, tmp_path / "none" / "b.mcap")


def test_damage_at_the_end_alone_is_told_from_damage_before_it(source: Path, tmp_path: Path) -> None:
    """A torn tail is a power cut, and expected; a hole before it is a card that fails."""
    whole, places = source.read_bytes(), chunk_places(source)
    path = tmp_path / "a.mcap"
    path.write_bytes(whole[: places[8][0] + 70])
    assert examine(path).torn_tail_only
    damaged = bytearray(whole[: places[8][0] + 70])
    damaged[places[3][0] + 200] ^= 1
    path.write_bytes(damaged)
    assert not examine(path).torn_tail_only
    damaged = bytearray(whole)
    damaged[places[3][0] + 200] ^= 1
    path.write_bytes(damaged)
    assert not examine(path).torn_tail_only
