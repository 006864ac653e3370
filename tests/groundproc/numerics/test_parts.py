"""Work shared out between threads."""

import threading

import pytest

from groundproc.numerics import parts
from groundproc.numerics.parts import at_once


@pytest.mark.parametrize("cores", [1, 2, 3, 20])
def test_all_parts_are_done_once_by_as_many_threads_as_there_are_cores(
    monkeypatch: pytest.MonkeyPatch, cores: int
) -> None:
    monkeypatch.setattr(parts.config, "NUMBA_NUM_THREADS", cores)
    done: list[tuple[int, str]] = []
    at_once(lambda part: done.append((part, threading.current_thread().name)), 8)
    assert sorted(part for part, _ in done) == list(range(8))
    assert {part % min(cores, 8) == 0 for part, name in done if name == threading.current_thread().name} == {True}


def test_an_error_in_a_part_comes_when_all_threads_have_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts.config, "NUMBA_NUM_THREADS", 2)

    def work(part: int) -> None:
        if part == 1:
            raise ValueError("of the second part")

    with pytest.raises(ValueError, match="second part"):
        at_once(work, 8)
    assert not [each for each in threading.enumerate() if each.name == "at once"]


def test_of_no_work_nothing_comes() -> None:
    """Over water there may not be a single row."""
    at_once(lambda part: pytest.fail(f"part {part} was asked for"), 0)
