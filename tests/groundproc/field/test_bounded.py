"""A child process whose words, time and files have bounds: real children."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from groundproc.field import bounded
from groundproc.field.bounded import Done, TooLateError, TooMuchError

MEGABYTE = 1 << 20


def shell(script: str, most_bytes: int = 1000, seconds: float = 120.0) -> Done:
    return bounded.run(["sh", "-c", script], most_bytes=most_bytes, seconds=seconds)


def test_what_a_child_says_and_how_it_ends_is_told() -> None:
    assert shell("printf out; printf err >&2; exit 3") == Done(3, b"out", "err")
    assert shell("kill -9 $$").code == -9
    with pytest.raises(FileNotFoundError):
        bounded.run(["no-such-command"], most_bytes=1, seconds=120.0)


def test_a_child_hears_nothing() -> None:
    """What speaks through it is asked for nothing, and given nothing that was meant for us."""
    ours, their_end = os.pipe()
    os.write(their_end, b"secret")
    os.close(their_end)
    kept = os.dup(0)
    try:
        os.dup2(ours, 0)
        assert shell("cat") == Done(0, b"", "")
    finally:
        os.dup2(kept, 0)
        os.close(kept)
        os.close(ours)


def test_bytes_that_are_no_text_do_no_harm() -> None:
    assert shell(r"printf '\377\200'; printf 'a\377b' >&2") == Done(0, b"\xff\x80", "a\ufffdb")


def test_as_many_bytes_as_it_may_and_not_one_more() -> None:
    assert shell("head -c 1000 /dev/zero").output == bytes(1000)
    with pytest.raises(TooMuchError):
        shell("head -c 1001 /dev/zero")
    with pytest.raises(TooMuchError):
        shell("yes", most_bytes=MEGABYTE)


def test_of_its_errors_the_last_64_kib_are_kept() -> None:
    done = shell("head -c 100000 /dev/zero | tr '\\0' a >&2; printf end >&2")
    assert done.errors == "a" * (65536 - 3) + "end"


@pytest.mark.parametrize("script", ["sleep 600", "while :; do echo; sleep 0.05; done", "exec >&- 2>&-; sleep 600"])
def test_who_is_not_done_in_time_is_killed(script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that says nothing, one that never ends its words, and one that closes them and stays."""
    children: list[subprocess.Popen[bytes]] = []
    begin = subprocess.Popen

    def kept(*words: Any, **options: Any) -> "subprocess.Popen[bytes]":
        children.append(begin(*words, **options))
        return children[-1]

    monkeypatch.setattr(subprocess, "Popen", kept)
    with pytest.raises(TooLateError):
        shell(script, most_bytes=MEGABYTE, seconds=0.5)
    (child,) = children
    assert child.returncode == -signal.SIGKILL


def test_no_pipe_stays_open() -> None:
    before = sum(1 for _ in Path("/proc/self/fd").iterdir())
    for _ in range(3):
        shell("echo; echo >&2")
        with pytest.raises(TooMuchError):
            shell("yes")
    assert sum(1 for _ in Path("/proc/self/fd").iterdir()) == before


def test_words_may_go_to_the_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    done = bounded.run(["sh", "-c", "echo seen; echo kept >&2"], most_bytes=0, seconds=120.0, shown=True)
    assert done == Done(0, b"", "kept\n")
    assert capfd.readouterr().out == "seen\n"


def test_a_child_may_be_kept_from_large_files_and_from_much_memory(tmp_path: Path) -> None:
    script = "import resource as r; print(*r.getrlimit(r.RLIMIT_FSIZE), *r.getrlimit(r.RLIMIT_AS))"
    words = [sys.executable, "-S", "-c", script]
    unbound = bounded.run(words, most_bytes=1000, seconds=120.0)
    assert unbound.output.split()[0] == b"-1"
    bound = bounded.run(words, most_bytes=1000, seconds=120.0, file_bytes=5000)
    assert [int(word) for word in bound.output.split()] == [5000, 5000, 2 << 30, 2 << 30]
    written = tmp_path / "a"
    done = bounded.run(
        ["dd", "if=/dev/zero", f"of={written}", "bs=1000", "count=9"], most_bytes=0, seconds=120.0, file_bytes=5000
    )
    assert done.code != 0
    assert written.stat().st_size == 5000
