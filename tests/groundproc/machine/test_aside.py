"""Arrays set aside in files."""

import mmap
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundproc.machine.aside import aside
from groundproc.machine.system import let_go

STATUS = Path("/proc/self/status")


def resident_mb() -> float:
    """Resident memory of this process [MB]."""
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) * 1024 / 1e6


def test_what_is_aside_is_the_same_array() -> None:
    """Values, shapes and types stay, what is empty too; and it may be written to, as before."""
    rng = np.random.default_rng(1)
    given = (
        rng.normal(size=(5000, 3)), np.empty((0, 6)), rng.integers(0, 9, 7001).astype(np.int32), rng.normal(size=(11, 4)) > 0.0,
        np.asfortranarray(rng.normal(size=(90, 100))),
    )  # fmt: skip
    made = aside(*given)
    let_go()
    for before, after in zip(given, made, strict=True):
        assert after.dtype == before.dtype
        assert after.flags.writeable
        np.testing.assert_array_equal(after, before)
    made[0][7] = 1.0
    let_go()
    assert (made[0][7] == 1.0).all()


@pytest.mark.skipif(not STATUS.exists(), reason="only Linux tells what of a process is resident in this way")
def test_what_is_aside_takes_no_memory_until_it_is_read() -> None:
    """50 MB are gone with the array that they were of, there when they are read, and gone again."""
    # a mapping of its own: what the C library has free in its heap, it would take from there and keep
    array = np.frombuffer(mmap.mmap(-1, 50_000_000))
    array[:] = 1.0
    before = resident_mb()
    (array,) = aside(array)
    assert resident_mb() < before - 40.0
    aside_mb = resident_mb()
    assert array.sum() == len(array)
    assert resident_mb() > aside_mb + 40.0
    let_go()
    assert resident_mb() < aside_mb + 5.0
    assert array[-1] == 1.0


def test_without_room_arrays_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that is full, or has no folder for such files, is no reason to give up."""

    def none(*_: Any, **__: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", none)
    array = np.ones(100_000)
    assert aside(array)[0] is array
