"""Small files that are made to cost much: what they take is linear in their size."""

import struct
import zlib
from pathlib import Path

import pytest
import zstandard

from flightlog import container
from flightlog.container import MAGIC, RECORD_HEAD, Opcode
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
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
    message = record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, 0, 0) + bytes(1 << 20))
    path.write_bytes(head() + chunk(message * 16) * 10)
    with LogReader(path) as log:
        assert sum(1 for _ in log.messages()) == 0  # a channel that nobody announced
        assert log.damage.bad_chunks == 7, "three of 16 MiB are below 48 MiB and 256 times a few kilobytes"
        assert any("unpacks to more than any log of its size" in place for place in log.damage.places)


def test_the_number_of_records_has_a_ceiling_too(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    message = record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, 0, 0))
    path.write_bytes(head() + chunk(message * 500_000) * 10)
    with LogReader(path) as log:
        for _ in range(2):  # a second reading counts nothing twice
            assert sum(1 for _ in log.messages()) == 0
        assert log.damage.bad_chunks == 10 - ((1 << 20) + path.stat().st_size) // 500_000
        assert any("more records than any log of its size" in place for place in log.damage.places)


def test_the_ceiling_is_beyond_what_a_lidar_packs_to_that_stands_still_without_noise(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    returns = struct.pack("<HB", 6_000, 40) * 32
    with path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={}, compression="zstd")
        for i in range(200):  # stamps and azimuths alone tell its packets apart
            packets = range(i * 180, (i + 1) * 180)
            blocks = [
                [struct.pack("<HH", 0xEEFF, (n * 12 + b) * 19 % 36_000) + returns for b in range(12)] for n in packets
            ]
            scan = b"".join(
                b"".join(each) + struct.pack("<IH", n * 553, 0x2137) for n, each in zip(packets, blocks, strict=True)
            )
            writer.write("/velodyne_packets", i, scan)
        writer.finish()
    assert path.stat().st_size * 30 < 200 * len(scan)
    found = examine(path)
    assert found.whole
    assert found.messages == {"/velodyne_packets": 200}


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
