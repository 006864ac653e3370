"""What the disk says while a cloud is written, as one sentence."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import lazrs

from flightlog.errors import SourceError

_NEXT_TO_NOTHING: Final = 1 << 20
"""lazrs keeps to itself why a write failed: with less space than this left [bytes], that was why."""


@contextlib.contextmanager
def storing(path: Path) -> Iterator[None]:
    """Turn what goes wrong on the disk into a SourceError that names the file."""
    try:
        yield
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None
    except lazrs.LazrsError as error:
        full = shutil.disk_usage(path.parent).free < _NEXT_TO_NOTHING
        raise SourceError(f"{path}: cannot be written ({'No space left on device' if full else error})") from None
