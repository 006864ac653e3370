"""Memory is lent again when nobody looks at it any more, and never before."""

import mmap
import threading
from pathlib import Path

import numpy as np
import pytest

from groundproc.numerics.memory import Pool, untouched

MANY = 1 << 20


def place(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def test_memory_is_lent_again_when_the_array_is_gone() -> None:
    pool = Pool()
    first = pool.empty((MANY, 3), np.float32)
    there = place(first)
    del first
    assert place(pool.empty(3 * MANY - 5, np.int32)) == there


def test_arrays_that_live_at_once_share_nothing() -> None:
    pool = Pool()
    arrays = [pool.empty(MANY, np.int64) for _ in range(6)]
    for number, array in enumerate(arrays):
        array[:] = number
    assert [int(array.min()) for array in arrays] == [int(array.max()) for array in arrays] == list(range(6))


def test_any_view_keeps_the_memory() -> None:
    pool = Pool()
    views = []
    for make in (
        lambda a: a[5:10],
        lambda a: a[::-7, 1],
        lambda a: a[2:].T.reshape(3, -1)[1:][:1],
        lambda a: a.view(np.uint8)[100:],
        lambda a: np.frombuffer(a.data.cast("B"), np.uint8)[3:],
        lambda a: np.asarray(memoryview(a))[1:],
    ):
        array = pool.empty((MANY, 3), np.float64)
        array[:] = len(views)
        views.append((make(array), make(array).copy()))
        del array
        for _ in range(3):
            pool.empty((MANY, 3), np.float64)[:] = np.nan
    for view, before in views:
        np.testing.assert_array_equal(view, before)


def test_small_arrays_and_empty_ones_are_those_of_numpy() -> None:
    pool = Pool()
    assert pool.empty(0, np.int64).shape == (0,)
    assert pool.empty((0, 3), np.float32).shape == (0, 3)
    assert pool.empty((7, 3), np.float32).dtype == np.float32


def test_threads_never_get_the_same_memory() -> None:
    pool, wrong = Pool(), []

    def work(number: int) -> None:
        for _ in range(200):
            array = pool.empty(1 << 15, np.int64)
            array[:] = number
            if (array != number).any():
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux tells there what is resident")
def test_zeros_take_memory_where_they_are_touched() -> None:
    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE

    before = resident()
    made = untouched((1 << 24, 4), np.float32)
    assert made.shape == (1 << 24, 4)
    made[: 1 << 20] = 1.0
    assert not made[1 << 20].any()
    assert resident() - before < 48 << 20  # of 256 MB
    del made
    assert resident() - before < 16 << 20
