import json
from pathlib import Path

import pytest

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from groundproc.cli import main


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "flight.mcap"
    with path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={})
        for i in range(10):
            writer.write("/mavlink/ins", i * 10**9, records.encode_raw(i, [(i, bytes(50))], "ins"))
            writer.flush()
        writer.finish()
    return path


def test_a_whole_log_is_said_to_be_whole_and_nothing_is_written(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["recover", str(log)]) == 0
    assert "is whole" in capsys.readouterr().out
    assert list(log.parent.iterdir()) == [log]


def test_a_torn_log_is_recovered_beside_it_with_exit_code_3_and_an_account(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log.write_bytes(log.read_bytes()[:1800])
    assert main(["recover", str(log)]) == 3
    said = capsys.readouterr().out
    assert "the log was cut off" in said
    assert "lost: " in said
    with LogReader(log.with_name("flight.recovered.mcap")) as found:
        assert not found.damage
        assert 0 < len(list(found.messages())) < 10
        assert json.loads(found.metadata["swath.salvage"]["found"])["truncated"] is True


def test_a_log_without_its_index_only_loses_nothing_and_the_exit_code_is_0(log: Path, tmp_path: Path) -> None:
    with LogReader(log) as found:
        chunk = found._chunks[-1]
    log.write_bytes(log.read_bytes()[: chunk.offset + chunk.size])
    assert main(["recover", str(log), "-o", str(tmp_path / "out.mcap")]) == 0
    with LogReader(tmp_path / "out.mcap") as found:
        assert len(list(found.messages())) == 10


def test_what_is_no_log_ends_with_1_and_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.mcap").write_bytes(b"")
    assert main(["recover", str(tmp_path / "x.mcap")]) == 1
    assert "is empty; expected a flight log" in capsys.readouterr().err
