"""What a restricted key may ask for."""

import contextlib
import hashlib
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightlog.errors import LogError
from onboard import cli, gate
from onboard.gate import RefusedError, Wish, wish
from onboard.logfolder import ACKNOWLEDGED, MANIFEST

SUM = hashlib.sha256(b"one").hexdigest()


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("health", Wish("health")),
        ("health --json", Wish("health", ("--json",))),
        ("manifest", Wish("manifest")),
        ("rsync --server --sender -logDtpre.iLsfxCIvu . 00001-000.mcap", Wish("rsync")),
        (f"ack {SUM}", Wish("ack", (SUM,))),
    ],
)
def test_what_is_allowed(command: str, expected: Wish) -> None:
    assert wish(command) == expected


@pytest.mark.parametrize(
    "command",
    [
        "", "sh", "bash -i", "health; id", "health --watch", "health --config /etc/shadow", "manifest x", "cat /etc/passwd",
        "rsync --server -logDtpre.iLsfxCIvu . x", "rsync --daemon", "rsync", "ack", "ack x", f"ack {SUM} $(id)", f"ack {SUM.upper()}",
        "swathd health", "/usr/bin/rsync --server --sender . /", "health\nid", "'health", "scp -f /etc/passwd", "internal-sftp",
    ],
)  # fmt: skip
def test_what_is_not(command: str) -> None:
    with pytest.raises(RefusedError):
        wish(command)


@given(st.text(max_size=60))
def test_any_text_is_a_wish_or_refused(command: str) -> None:
    verb = ""
    with contextlib.suppress(RefusedError):
        verb = wish(command).verb
    assert verb in {"", "health", "manifest", "rsync", "ack"}


def put(folder: Path, name: str, data: bytes, mode: int = 0o440) -> str:
    (folder / name).write_bytes(data)
    (folder / name).chmod(mode)
    line = {"file": name, "size": len(data), "sha256": hashlib.sha256(data).hexdigest(), "messages": 7}
    with (folder / MANIFEST).open("a") as file:
        file.write(json.dumps(line) + "\n")
    return str(line["sha256"])


def test_the_manifest_shows_what_is_here_closed_and_who_has_it(tmp_path: Path) -> None:
    assert gate.manifest(tmp_path) == []
    first, second = put(tmp_path, "00001-000.mcap", b"one"), put(tmp_path, "00001-001.mcap", b"two")
    put(tmp_path, "00001-002.mcap", b"open", mode=0o640)
    put(tmp_path, "00001-003.mcap", b"pruned")
    (tmp_path / "00001-003.mcap").unlink()
    with (tmp_path / MANIFEST).open("a") as file:
        file.write('{"file": "00001-004.mca')  # the power went
    assert gate.acknowledge(tmp_path, (first,)) == 1
    found = gate.manifest(tmp_path)
    assert [(line["file"], line["sha256"], line["acknowledged"], line["messages"]) for line in found] == [
        ("00001-000.mcap", first, True, 7), ("00001-001.mcap", second, False, 7),
    ]  # fmt: skip


def test_acknowledged_once_and_only_what_the_manifest_has(tmp_path: Path) -> None:
    first, second = put(tmp_path, "00001-000.mcap", b"one"), put(tmp_path, "00001-001.mcap", b"two")
    assert gate.acknowledge(tmp_path, (first, first)) == 1
    assert gate.acknowledge(tmp_path, (second, first)) == 1
    with pytest.raises(RefusedError, match="no segment"):
        gate.acknowledge(tmp_path, ("0" * 64,))
    lines = [json.loads(line) for line in (tmp_path / ACKNOWLEDGED).read_text().splitlines()]
    assert lines == [{"file": "00001-000.mcap", "sha256": first}, {"file": "00001-001.mcap", "sha256": second}]


def test_a_folder_that_cannot_be_read_or_written_is_one_sentence(tmp_path: Path) -> None:
    first = put(tmp_path, "00001-000.mcap", b"one")
    (tmp_path / ACKNOWLEDGED).mkdir()
    with pytest.raises(LogError, match=rf"^{tmp_path}: cannot be read \(Is a directory\)$"):
        gate.manifest(tmp_path)
    with pytest.raises(LogError, match=rf"^{tmp_path}/{ACKNOWLEDGED}: cannot be written \(Is a directory\)$"):
        gate.acknowledge(tmp_path, (first,))


def test_a_segment_that_cannot_be_looked_at_is_not_offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a card that fails: it was there a moment ago."""
    put(tmp_path, "00001-000.mcap", b"one")
    monkeypatch.setattr(Path, "is_file", lambda self: True)
    (tmp_path / "00001-000.mcap").unlink()
    assert gate.manifest(tmp_path) == []


def test_a_refusal_ends_with_the_code_of_a_command_that_may_not_be_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SSH_ORIGINAL_COMMAND", "rm -rf /")
    assert cli.main(["gate"]) == 126
    assert capsys.readouterr().err.startswith("swathd: 'rm -rf /' refused")
