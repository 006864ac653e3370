"""Streams made ahead by a thread, and works done beside each other."""

import functools
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from groundproc.machine import readahead, system
from groundproc.machine.readahead import InOrder, ahead, beside, both, imported_meanwhile


@pytest.fixture(autouse=True)
def several_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever the tests run."""
    monkeypatch.setattr(readahead, "cores", lambda: 2)


def test_items_come_in_their_order() -> None:
    assert list(ahead(iter(range(1000)))) == list(range(1000))


def test_an_error_comes_where_the_item_would_have_come() -> None:
    def failing() -> Iterator[int]:
        yield 1
        yield 2
        raise ValueError("the third cannot be made")

    stream = ahead(failing())
    assert [next(stream), next(stream)] == [1, 2]
    with pytest.raises(ValueError, match="third"):
        next(stream)


def test_while_one_is_used_two_are_made_and_no_more() -> None:
    made: list[int] = []
    second = threading.Event()

    def counted() -> Iterator[int]:
        for number in range(10):
            made.append(number)
            if number == 1:
                second.set()
            yield number

    stream = ahead(counted())
    for number in stream:
        second.wait()
        assert len(made) <= number + 3
    assert made == list(range(10))


def test_a_stream_that_is_left_ends_its_thread_and_its_iterator() -> None:
    closed = threading.Event()

    def endless() -> Iterator[int]:
        try:
            while True:
                yield 0
        finally:
            closed.set()

    before = threading.active_count()
    stream = ahead(endless())
    next(stream)
    stream.close()
    assert closed.is_set()
    assert threading.active_count() == before


def test_streams_that_share_a_lock_are_made_one_at_a_time() -> None:
    lock, inside = threading.Lock(), []

    def guarded() -> Iterator[bool]:
        for _ in range(50):
            inside.append(1)
            alone = len(inside) == 1
            inside.pop()
            yield alone

    pairs = zip(ahead(guarded(), lock), ahead(guarded(), lock), strict=True)
    assert all(a and b for a, b in pairs)


def test_on_one_core_there_is_no_other_thread_and_what_is_left_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readahead, "cores", lambda: 1)
    closed: list[bool] = []

    def named() -> Iterator[str]:
        try:
            while True:
                yield threading.current_thread().name
        finally:
            closed.append(True)

    stream = ahead(named())
    assert next(stream) == threading.current_thread().name
    stream.close()
    assert closed == [True]


def test_threads_are_as_many_as_was_told_and_no_more_than_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(system.THREADS, raising=False)
    there = system.cores()
    for told, given in (("1", 1), ("100000", there), ("0", there), ("many", there)):
        monkeypatch.setenv(system.THREADS, told)
        assert system.cores() == given, told


def test_the_first_work_is_done_here_and_the_others_in_their_order_beside_it() -> None:
    done: list[str] = []
    others = threading.Event()

    def first() -> None:
        assert others.wait(30.0), "the others do not wait for the first"
        done.append(threading.current_thread().name)

    def last() -> None:
        done.append("last")
        others.set()

    beside([first, lambda: done.append("second"), last])
    assert done == ["second", "last", threading.current_thread().name]


def test_on_one_core_works_are_done_in_their_order_by_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readahead, "cores", lambda: 1)
    done: list[tuple[int, str]] = []
    beside([lambda number=number: done.append((number, threading.current_thread().name)) for number in range(4)])
    assert done == [(number, threading.current_thread().name) for number in range(4)]


def test_an_error_of_a_work_beside_comes_when_the_first_is_done() -> None:
    first = threading.Event()

    def fails() -> None:
        raise ValueError("cannot be drawn")

    with pytest.raises(ValueError, match="cannot be drawn"):
        beside([first.set, fails])
    assert first.is_set()


def test_an_interrupt_of_the_first_lets_one_work_end_and_begins_no_other() -> None:
    begun, ended = list[int](), list[int]()

    def first() -> None:
        while not begun:
            time.sleep(0.001)
        raise KeyboardInterrupt

    def other(number: int) -> None:
        begun.append(number)
        time.sleep(0.001)
        ended.append(number)

    many = 100_000
    with pytest.raises(KeyboardInterrupt):
        beside([first, *(functools.partial(other, number) for number in range(many))])
    assert begun == ended, "the one that was being done is whole"
    assert len(begun) < many


def test_works_in_order_are_done_by_one_thread_while_others_go_on() -> None:
    works, done = InOrder(), []
    go_on = threading.Event()

    def first() -> None:
        go_on.wait()
        done.append(threading.current_thread())

    begun = works.do(first)
    works.do(lambda: done.append(threading.current_thread()))
    assert begun is not None
    assert not begun.done(), "it waits for what this thread does next"
    go_on.set()
    begun.result()
    works.wait()
    assert len(done) == 2
    assert done[0] is done[1] is not threading.current_thread()


def test_an_error_of_a_work_in_order_is_not_lost_behind_one_that_does_well() -> None:
    works, go_on = InOrder(), threading.Event()

    def failing() -> None:
        go_on.wait()
        raise ValueError("it cannot be done")

    works.do(failing)
    works.do(go_on.is_set)  # type: ignore[arg-type] # what it gives is of no use
    go_on.set()
    with pytest.raises(ValueError, match="cannot be done"):
        works.wait()


def test_on_one_core_works_in_order_are_done_where_they_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readahead, "cores", lambda: 1)
    works, done = InOrder(), []
    assert works.do(lambda: done.append(threading.current_thread())) is None
    assert done == [threading.current_thread()]
    works.wait()


def test_two_works_give_what_they_give() -> None:
    assert both(lambda: 1, lambda: "b") == (1, "b")


def test_modules_are_imported_meanwhile_and_one_that_is_not_there_is_told_where_it_is_used(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "wanted_later.py").write_text("HERE = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    imported_meanwhile(["wanted_later", "nowhere_at_all"])
    for thread in threading.enumerate():
        if thread.name == "imports":
            thread.join()
    assert sys.modules.pop("wanted_later").HERE == 1
    monkeypatch.setattr(readahead, "cores", lambda: 1)
    imported_meanwhile(["wanted_later"])
    assert "wanted_later" not in sys.modules
