"""Small files that are made to cost much: what they take is linear in their size."""

import struct
import zlib
from pathlib import Path

import pytest
import zstandard

from flightlog import container
from flightlog.container import MAGIC, RECORD_HEAD, Opcode
from flightlog.logfile import LogReader, LogWriter
from flightlog.salvage import examine
from flightlog.walk import Walk


def chunk(plain: bytes, *, pack: bool = True, crc: int | None = None) -> bytes:
    packed = zstandard.ZstdCompressor().compress(plain) if pack else plain
    name = b"zstd" if pack else b""
    head = struct.pack("<QQQI", 0, 1, len(plain), zlib.crc32(plain) if crc is None else crc)
    content = head + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return RECORD_HEAD.pack(Opcode.CHUNK, len(content)) + content


def head() -> bytes:
    return MAGIC + RECORD_HEAD.pack(Opcode.HEADER, 8) + bytes(8)


def record(opcode: int, content: bytes) -> bytes:
    return RECORD_HEAD.pack(opcode, len(content)) + content


def test_a_chunk_of_records_that_no_chunk_holds_ends_at_the_first(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(head() + chunk(record(Opcode.HEADER, b"") * 1_000_000))
    found = examine(path)
    assert found.messages == {}
    assert found.bad_chunks == 1
    assert "a record of opcode 1 within a chunk" in found.places[0]


def test_what_a_file_unpacks_to_has_a_ceiling(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    message = record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, 0, 0))
    one = chunk(message * ((16 << 20) // len(message)))
    path.write_bytes(head() + one * 10)
    with LogReader(path) as log:
        assert sum(1 for _ in log.messages()) == 0  # a channel that nobody announced
        assert log.damage.bad_chunks == 7, "three of 16 MiB are below 48 MiB"
        assert any("unpacks to more than any log of its size" in place for place in log.damage.places)


def test_the_ceiling_is_beyond_what_telemetry_packs_to(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={}, compression="zstd")
        for i in range(20_000):  # 40 MB of zeros, as much alike as messages can be
            writer.write("/mavlink/ins", i, bytes(2_000))
        writer.finish()
    found = examine(path)
    assert found.whole
    assert found.messages == {"/mavlink/ins": 20_000}


def test_chunks_within_chunks_are_searched_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # each looks like a chunk that reaches to the end of the file, and none is good
    count, content = 3_000, b""
    for _ in range(count):
        content = chunk(content or b"x", pack=False, crc=1)
    data = head() + b"\xff" + content
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    unpacked: list[int] = []
    real = container.open_chunk
    monkeypatch.setattr(container, "open_chunk", lambda raw: (unpacked.append(len(raw)), real(raw))[1])
    with path.open("rb") as file:
        list(Walk(file, len(data)))
    assert len(data) > 100_000
    assert sum(unpacked) <= 5 * len(data) + (1 << 20)
