"""Files of points begun and ended, and what the disk says meanwhile as one sentence."""

import contextlib
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import laspy
import lazrs

from flightlog.errors import SourceError
from groundproc.machine.stopping import heard

_NEXT_TO_NOTHING: Final = 1 << 20
"""lazrs keeps to itself why a write failed: with less space than this left [bytes], that was why."""


@contextlib.contextmanager
def storing(path: Path) -> Iterator[None]:
    """Turn what goes wrong on the disk into a SourceError that names the file."""
    try:
        with heard():
            yield
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None
    except lazrs.LazrsError as error:
        full = shutil.disk_usage(path.parent).free < _NEXT_TO_NOTHING
        raise SourceError(f"{path}: cannot be written ({'No space left on device' if full else error})") from None


def begun(path: Path, header: laspy.LasHeader, compressed: bool = True) -> Any:
    """A file of laspy to write points to, compressed on all cores.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    try:
        return laspy.open(
            path, mode="w", header=header, laz_backend=laspy.LazBackend.LazrsParallel, do_compress=compressed
        )
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror})") from None


def ended(las: Any, path: Path, failed: bool, records: Sequence[laspy.VLR] = ()) -> None:
    """Close a file, with records behind its points; one that has `failed` is only let go.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    if failed:  # nothing of it is kept: what closing would still write may fail for the same reason
        with contextlib.suppress(OSError):
            las.dest.close()
        return
    with storing(path):
        if records:
            las.write_evlrs(laspy.vlrs.vlrlist.VLRList(records))
        las.close()
