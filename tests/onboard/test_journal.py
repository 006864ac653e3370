import logging
import subprocess
import sys
from collections.abc import Mapping

import pytest

from onboard import journal


def record(level: int, text: str, extra: Mapping[str, object] | None = None) -> logging.LogRecord:
    return logging.getLogger("x").makeRecord("x", level, "file.py", 7, text, (), None, "func", dict(extra or {}))


def test_an_event_has_fields_that_a_search_finds() -> None:
    found = journal.fields(record(logging.ERROR, "no", journal.event("hang", worker="lidar", silent_s=6.5)))
    expected = {"PRIORITY": "3", "CODE_FILE": "file.py", "CODE_LINE": 7, "CODE_FUNC": "func"}
    assert {key: found[key] for key in expected} == expected
    assert {key: value for key, value in found.items() if key.startswith("SWATH_") and key != "SWATH_THREAD"} == {
        "SWATH_EVENT": "hang", "SWATH_WORKER": "lidar", "SWATH_SILENT_S": "6.5",
    }  # fmt: skip


@pytest.mark.parametrize(("level", "number"), [(10, 7), (20, 6), (30, 4), (40, 3), (50, 2), (35, 4)])
def test_levels_are_the_priorities_of_syslog(level: int, number: int) -> None:
    assert journal.priority(level) == number


def test_without_the_library_each_line_carries_its_priority() -> None:
    assert journal.PriorityFormatter().format(record(logging.WARNING, "one\ntwo")) == "<4>one\n<4>two"


def test_on_a_terminal_lines_have_a_time(tmp_path: object) -> None:
    code = "import logging; from onboard import journal; journal.start(); logging.warning('well')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={"JOURNAL_STREAM": "1:2"})
    assert done.stderr.endswith(" WARNING well\n")
    assert done.stderr[:2] == "20"


def test_what_the_journal_does_not_take_is_said_on_standard_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sent: list[tuple[str, dict[str, str]]] = []
    monkeypatch.setattr(journal, "_send", lambda text, **named: sent.append((text, named)))
    journal.JournalHandler().emit(record(logging.INFO, "hello", journal.event("ready")))
    assert sent[0][0] == "hello"
    assert sent[0][1]["SWATH_EVENT"] == "ready"

    def away(text: str, **named: str) -> None:
        raise ConnectionRefusedError

    monkeypatch.setattr(journal, "_send", away)
    journal.JournalHandler().emit(record(logging.ERROR, "lost"))
    assert capsys.readouterr().err == "<3>lost\n"
