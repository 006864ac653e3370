"""Arrays in a temporary file: they come back as they were, or with an error."""

import numpy as np
import pytest

from groundproc.machine.scratch import Scratch


def test_arrays_come_back_in_their_order_and_from_any_byte() -> None:
    scratch, first, second = Scratch(), np.arange(100_000, dtype=np.int32), np.linspace(0.0, 1.0, 7)
    for each in (first, second, first[:0]):
        scratch.write(each)
    scratch.seek(first.nbytes)
    np.testing.assert_array_equal(scratch.read(7, np.float64), second)
    scratch.seek(0)
    np.testing.assert_array_equal(scratch.read(100_000, np.int32), first)


def test_what_was_never_written_is_an_error() -> None:
    scratch = Scratch()
    scratch.write(np.arange(3, dtype=np.int32))
    scratch.seek(0)
    with pytest.raises(OSError, match="4 bytes are missing"):
        scratch.read(4, np.int32)
