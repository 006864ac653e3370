"""Tables and verdicts: plain where somebody else reads them, lines and colours on a real terminal, and no word of a file steers it."""

import os
import pty
import re
import subprocess
import sys

import pytest

from groundproc.machine import screen

HOSTILE = "name\x1b[2J\x1b]0;title\x07"
CODE = """
from groundproc.machine import screen
with screen.cleaned():
    screen.table(["flight", "verdict", "points"], [["a", "good", "1,000"], [%r, "bad", "2"]])
    screen.summary([("points", "7 points [bold]in[/bold] EPSG:32633"), ("", %r)])
    screen.verdict("verdict: doubtful: " + "few points, " * 30, "doubtful")
"""


def on_a_terminal(**variables: str) -> str:
    """What the code writes to a terminal of 100 columns."""
    leader, follower = pty.openpty()
    environment = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "FORCE_COLOR")}
    run = subprocess.Popen(
        [sys.executable, "-c", CODE % (HOSTILE, HOSTILE)], stdout=follower, stderr=follower,
        env=environment | {"TERM": "xterm-256color", "COLUMNS": "100"} | variables,
    )  # fmt: skip
    os.close(follower)
    written = b""
    while True:
        try:
            part = os.read(leader, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        written += part
    os.close(leader)
    assert run.wait() == 0, written
    return written.decode()


def test_a_table_is_aligned_text_where_no_terminal_is(capsys: pytest.CaptureFixture[str]) -> None:
    screen.table(["flight", "points"], [["a", "1,000"], ["bb", "2"]])
    assert capsys.readouterr().out == "flight  points\na        1,000\nbb           2\n"
    screen.verdict("verdict: good", "good")
    assert capsys.readouterr().out == "verdict: good\n"


def test_a_terminal_shows_verdicts_in_colour_and_labels_beside_sentences() -> None:
    shown = on_a_terminal()
    assert re.search(r"\x1b\[32m *good", shown)
    assert re.search(r"\x1b\[31m *bad", shown)
    assert "\x1b[1;33mverdict: doubtful" in shown
    assert "7 points [bold]in[/bold] EPSG:32633" in shown  # brackets are text, not markup


def test_no_colour_is_no_colour() -> None:
    assert "\x1b[3" not in on_a_terminal(NO_COLOR="1")


def test_words_of_a_file_do_not_steer_the_terminal() -> None:
    shown = on_a_terminal()
    assert "\x1b[2J" not in shown
    assert "\x1b]0" not in shown
    assert "\x07" not in shown
    assert "name\\x1b[2J" in shown
