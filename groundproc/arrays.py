"""Arrays of an NPZ file, read only where the file is as large as they say: the head of an array may claim any shape."""

import math
import zipfile
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import LogError

_RATIO: Final = 64
_LEAST_BYTES: Final = 64 << 20
"""An archive may unpack to so much, or to 64 times its size where that is more."""
_LONGEST_HEAD: Final = 1 << 14
_DAMAGE: Final = (
    ValueError, KeyError, EOFError, SyntaxError, TypeError, RuntimeError, OverflowError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What zipfile and numpy raise for damaged files; RuntimeError: it is encrypted, or packed in a way that zipfile does not know."""


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """All arrays of an NPZ, by name.

    Raises
    ------
    LogError
        It cannot be read, or claims to hold more than it can.
    """
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
            most = max(_LEAST_BYTES, _RATIO * path.stat().st_size)
            if total > most:
                raise LogError(f"{path}: unpacks to {total} bytes, expected {most} at most")
            return {entry.filename.removesuffix(".npy"): _array(archive, entry) for entry in archive.infolist()}
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error})") from None
    except _DAMAGE as error:
        raise LogError(f"{path}: is no file of arrays (npz): {error}") from None


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> npt.NDArray[Any]:
    """One array, its claims held against the bytes that are there."""
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file, _LONGEST_HEAD)
        size = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or min(shape, default=0) < 0 or size > entry.file_size:
            raise ValueError(f"{entry.filename}: {dtype} of shape {shape} in {entry.file_size} bytes")
        data = file.read(size)
        if len(data) < size:
            raise ValueError(f"{entry.filename}: ends after {len(data)} bytes of {size}")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy()
