"""An aircraft, or whoever sits on its address, that answers with what it should not: real processes in the place of ssh."""

import hashlib
import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

import pytest

from groundproc.field import bounded, pull

GOOD: dict[str, Any] = {"file": "00001-000.mcap", "size": 5, "sha256": hashlib.sha256(b"12345").hexdigest()}


@pytest.fixture
def answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A script that is found as `ssh`: it answers the gate's commands with what stands in files, and serves rsync from a folder."""
    there = tmp_path / "there"
    there.mkdir()
    (there / "health").write_text('{"armed": false}')
    script = tmp_path / "bin" / "ssh"
    script.parent.mkdir()
    script.write_text(
        f"""#!/bin/sh
for word; do last=$word; done
cd {there}
case "$*" in
*"rsync --server"*) while [ "$1" != rsync ]; do shift; done; exec "$@" ;;
*health*) cat health ;;
*manifest*) if [ -f endless ]; then yes '{json.dumps(GOOD)}'; else cat manifest; fi ;;
*ack*) echo acknowledged ;;
esac
"""
    )
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{script.parent}:{os.environ['PATH']}")
    return there


def manifest(there: Path, *lines: bytes) -> None:
    (there / "manifest").write_bytes(b"\n".join(lines) + b"\n")


def sentence(directory: Path) -> str:
    with pytest.raises(pull.PullError) as error:
        pull.pull(pull.Vehicle("a@b"), directory, lambda _: None)
    text = str(error.value)
    assert text.isprintable()
    return text


def test_the_stand_in_is_pulled_from_as_an_aircraft_is(answer: Path, tmp_path: Path) -> None:
    manifest(answer, json.dumps(GOOD).encode())
    (answer / "00001-000.mcap").write_bytes(b"12345")
    here = tmp_path / "here"
    here.mkdir()
    outcome = pull.pull(pull.Vehicle("a@b"), here, lambda _: None)
    assert outcome.troubles == []
    assert (here / "00001-000.mcap").read_bytes() == b"12345"


@pytest.mark.parametrize(
    "line",
    [
        b"[" * 60_000,
        b'{"file":' * 9_000,
        b"\xff\xfe\x00 \x1b[2J",
        json.dumps(GOOD | {"size": 2**70}).encode(),
        json.dumps(GOOD | {"size": True}).encode(),
        json.dumps(GOOD | {"size": 1e3}).encode(),
        b'{"file": "' + b"x" * 1_000_000 + b'"}',
        b"null",
        b"[1, 2]",
    ],
    ids=["deep", "deep objects", "no text", "huge size", "size true", "size 1e3", "long", "null", "list"],
)
def test_a_line_that_is_none_is_one_sentence(answer: Path, tmp_path: Path, line: bytes) -> None:
    manifest(answer, json.dumps(GOOD).encode(), line)
    assert "line 2 of its manifest is none" in sentence(tmp_path)


def test_a_manifest_without_end_takes_little_memory_and_ends(answer: Path, tmp_path: Path) -> None:
    (answer / "endless").touch()
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "more than 32 MB came for `manifest`" in sentence(tmp_path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 300_000


def test_more_than_the_manifest_says_is_not_taken(answer: Path, tmp_path: Path) -> None:
    manifest(answer, json.dumps(GOOD).encode())
    (answer / "00001-000.mcap").write_bytes(b"x" * 50_000_000)
    here = tmp_path / "here"
    here.mkdir()
    outcome = pull.pull(pull.Vehicle("a@b"), here, lambda _: None)
    (trouble,) = outcome.troubles
    assert trouble.startswith("00001-000.mcap: ")
    assert outcome.acknowledged == 0
    assert sum(path.stat().st_size for path in here.rglob("*") if path.is_file()) <= 6


def test_no_more_than_a_byte_beyond_the_manifest_ever_lies_on_the_disk(
    answer: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest(answer, json.dumps(GOOD).encode())
    (answer / "00001-000.mcap").write_bytes(b"x" * 50_000_000)
    here = tmp_path / "here"
    here.mkdir()
    run, lay = bounded.run, []

    def watched(*words: Any, **limits: Any) -> bounded.Done:
        done = run(*words, **limits)
        lay.append(sum(path.stat().st_size for path in here.rglob("*") if path.is_file()))
        return done

    monkeypatch.setattr(bounded, "run", watched)
    pull.pull(pull.Vehicle("a@b"), here, lambda _: None)
    assert max(lay) <= GOOD["size"] + 1


def test_a_line_may_have_so_many_letters_and_no_more(answer: Path, tmp_path: Path) -> None:
    line = json.dumps(GOOD).encode()
    manifest(answer, line + b" " * ((1 << 16) - len(line)))
    (answer / "00001-000.mcap").write_bytes(b"12345")
    assert pull.segments(pull.Vehicle("a@b"))[0].size == 5
    manifest(answer, line + b" " * ((1 << 16) + 1 - len(line)))
    assert "line 1 of its manifest is none" in sentence(tmp_path)


@pytest.mark.parametrize("left", [b"12", b"1x"])
def test_what_happens_is_said(answer: Path, tmp_path: Path, left: bytes) -> None:
    """What an earlier pull left is gone on with; where that was spoilt, so that the sum is wrong, it is said too."""
    data = left[:1] * 1_000_000 + b"2" * 1_500_000
    good = GOOD | {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    manifest(answer, json.dumps(good).encode())
    (answer / "00001-000.mcap").write_bytes(data)
    part = tmp_path / "here" / pull.INCOMING / "00001-000.mcap"
    part.parent.mkdir(parents=True)
    spoilt = left == b"1x"
    part.write_bytes(left[1:] + data[1:] if spoilt else data[:1_000_000])
    if spoilt:
        stamp = (answer / "00001-000.mcap").stat().st_mtime
        os.utime(part, (stamp, stamp))  # of the same size and time it is whole to rsync
    said: list[str] = []
    outcome = pull.pull(pull.Vehicle("a@b"), tmp_path / "here", said.append)
    assert outcome.troubles == []
    assert (tmp_path / "here" / "00001-000.mcap").read_bytes() == data
    assert said[0] == f"00001-000.mcap: goes on at {2.5 if spoilt else 1.0} of 2.5 MB"
    assert said[1:] == ["00001-000.mcap: the sum is wrong; what differs is brought again"] * spoilt


@pytest.mark.parametrize("quiet", [True, False])
def test_progress_is_shown_where_it_is_wanted(
    answer: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], quiet: bool
) -> None:
    data = bytes(100_000)
    manifest(answer, json.dumps(GOOD | {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}).encode())
    (answer / "00001-000.mcap").write_bytes(data)
    here = tmp_path / "here"
    here.mkdir()
    pull.pull(pull.Vehicle("a@b"), here, lambda _: None, quiet=quiet)
    assert ("100%" in capfd.readouterr().out) is not quiet


def test_space_is_asked_for_before_anything_comes(answer: Path, tmp_path: Path) -> None:
    manifest(answer, json.dumps(GOOD | {"size": 1 << 40}).encode())
    text = sentence(tmp_path)
    assert "1099.51 GB are to come" in text
    assert not (tmp_path / pull.INCOMING).exists()


def test_a_health_that_goes_deep_is_no_knowledge(answer: Path, tmp_path: Path) -> None:
    (answer / "health").write_text("[" * 20_000)
    assert "whether it is armed is not known" in sentence(tmp_path)


def test_a_child_that_hangs_is_ended() -> None:
    with pytest.raises(bounded.TooLateError):
        bounded.run(["sleep", "600"], most_bytes=1, seconds=0.3)


def test_a_child_that_complains_without_end_takes_little_memory() -> None:
    script = "import sys\nfor _ in range(40): sys.stderr.write('x' * (1 << 20))\nsys.stderr.write('the end')"
    done = bounded.run([sys.executable, "-c", script], most_bytes=1, seconds=60.0)
    assert done.code == 0
    assert done.errors.endswith("the end")
    assert len(done.errors) <= 1 << 16


def test_a_child_cannot_write_a_file_beyond_its_limit(tmp_path: Path) -> None:
    words = ["dd", "if=/dev/zero", f"of={tmp_path / 'x'}", "bs=1k", "count=100"]
    done = bounded.run(words, most_bytes=1, seconds=60.0, file_bytes=2048)
    assert done.code != 0
    assert (tmp_path / "x").stat().st_size <= 2048


def test_words_of_the_other_side_do_not_act_on_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "ssh"
    script.write_text("#!/bin/sh\nprintf 'denied\\033[2J\\007 forged' >&2\nexit 255\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert sentence(tmp_path) == r"a@b: denied\x1b[2J\x07 forged"
