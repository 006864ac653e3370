"""Arrays that idle for long, in files mapped into memory: what the system holds of such a file is none of the process's memory."""

import mmap
import tempfile
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.machine.system import read_now_and_then

_SMALL: Final = 1 << 16
"""Fewer bytes are not worth a file."""
_PLACE: Final = 64
"""Arrays begin at multiples of so many bytes."""


def aside(*arrays: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], ...]:
    """The same arrays in one file, which goes with the last of them; where a file has no room, they themselves.

    They are arrays like others, of numbers. What of them is read is in memory until `system.let_go`. Where the folder for temporary files
    lies in memory (tmpfs), nothing is won but in the figures of the process: TMPDIR names another.
    """
    places = np.cumsum([0, *(-(-each.nbytes // _PLACE) * _PLACE for each in arrays)]).tolist()
    if places[-1] < _SMALL:
        return arrays
    try:
        with tempfile.TemporaryFile() as file:
            # written, not mapped: a full disk is an error then, and no signal
            for place, each in zip(places, arrays, strict=False):
                file.seek(place)
                file.write(np.ascontiguousarray(each).data)
            file.truncate(places[-1])
            file.flush()
            room = read_now_and_then(mmap.mmap(file.fileno(), places[-1]))
    except OSError:
        return arrays
    return tuple(
        np.frombuffer(room, each.dtype, each.size, place).reshape(each.shape)
        for place, each in zip(places, arrays, strict=False)
    )
