"""Files that somebody compressed, read as what is in them: gzip, bzip2, xz, zstd, lz4, told by their first bytes.

A few kilobytes can unpack to gigabytes, so there is a ceiling. A file that was cut off or damaged gives what stands ahead
of the damage, and says so.
"""

import bz2
import gzip
import io
import lzma
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import lz4.frame
import zstandard

from flightlog.errors import CaptureError

EXPANSION: Final = 64
_MOST_BYTES: Final = 64 << 20
"""What is taken in unpacks to so many times its size and so many bytes; telemetry and packets do not reach a tenth of it."""
_LARGEST_WINDOW: Final = 1 << 27
"""Memory that a zstd file may ask for [bytes]; `zstd --ultra -22` asks for it."""
_DAMAGE: Final = (EOFError, OSError, RuntimeError, ValueError, lzma.LZMAError, zlib.error, zstandard.ZstdError)
HEAD_BYTES: Final = 6


def _zstd(file: BinaryIO) -> BinaryIO:
    unpacker = zstandard.ZstdDecompressor(max_window_size=_LARGEST_WINDOW)
    return cast(BinaryIO, unpacker.stream_reader(file, read_across_frames=True, closefd=False))


_KINDS: Final[tuple[tuple[bytes, str, Callable[[BinaryIO], BinaryIO]], ...]] = (
    (b"\x1f\x8b", "gzip", lambda file: cast(BinaryIO, gzip.GzipFile(fileobj=file))),
    (b"BZh", "bzip2", lambda file: cast(BinaryIO, bz2.BZ2File(file))),
    (b"\xfd7zXZ\x00", "xz", lambda file: cast(BinaryIO, lzma.LZMAFile(file))),  # noqa: SIM115 - the caller closes the file below
    (b"\x28\xb5\x2f\xfd", "zstd", _zstd),
    (b"\x04\x22\x4d\x18", "lz4", lambda file: cast(BinaryIO, lz4.frame.LZ4FrameFile(file))),
)


def most_bytes(taken: int) -> int:
    """To how many bytes so many compressed ones may unpack."""
    return _MOST_BYTES + EXPANSION * taken


def packing(head: bytes) -> str:
    """How a file that begins so is compressed; empty for one that is not."""
    return next((name for magic, name, _ in _KINDS if head.startswith(magic)), "")


class Unpacking(io.RawIOBase):
    """What is in a compressed file.

    Parameters
    ----------
    file : BinaryIO
        At its beginning; of one of the known kinds.
    place : str
        Its name, for errors.

    Attributes
    ----------
    damage : str
        What is wrong with it, empty where nothing is; known once all was read.
    """

    def __init__(self, file: BinaryIO, place: str) -> None:
        self._packed = _Counted(file)
        head = self._packed.peeked
        self.kind = packing(head)
        self.damage = ""
        self._place, self._given = place, 0
        opener = next(opener for magic, _, opener in _KINDS if head.startswith(magic))
        self._plain = opener(cast(BinaryIO, self._packed))

    def readable(self) -> bool:
        """It can be read."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Unpack the next bytes; none after damage.

        Raises
        ------
        CaptureError
            It unpacks to more than any recording does.
        """
        if self.damage:
            return 0
        try:
            piece = self._plain.read(min(len(buffer), 1 << 18))
        except _DAMAGE as error:
            self.damage = f"its {self.kind} data end early or are damaged ({error})"
            return 0
        self._given += len(piece)
        if self._given > most_bytes(self._packed.taken):
            raise CaptureError(
                f"{self._place}: unpacks to more than {EXPANSION} times its size, which no recording does; unpack it yourself"
            )
        buffer[: len(piece)] = piece
        return len(piece)


class _Counted(io.RawIOBase):
    """A file that counts what is taken of it; its first bytes can be looked at."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.peeked = file.read(HEAD_BYTES)
        self._rest = self.peeked
        self.taken = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        piece, self._rest = self._rest[: len(buffer)], self._rest[len(buffer) :]
        piece = piece or self._file.read(len(buffer))
        buffer[: len(piece)] = piece
        self.taken += len(piece)
        return len(piece)


def opened(file: io.BufferedReader, place: str) -> tuple[io.BufferedReader, Unpacking | None]:
    """A file as it is, or what is in it where it is compressed, with what unpacks it."""
    if not packing(file.peek(HEAD_BYTES)[:HEAD_BYTES]):
        return file, None
    unpacking = Unpacking(file, place)
    return io.BufferedReader(unpacking, 1 << 18), unpacking


def unpacked(path: Path, folder: Path) -> tuple[Path, str]:
    """The file itself, or a copy in `folder` of what is in it, under its name without the ending; and what is wrong with it.

    Raises
    ------
    CaptureError
        It cannot be opened or read, or unpacks to more than any recording does.
    """
    try:
        with path.open("rb") as file:
            plain, unpacking = opened(file, str(path))
            if unpacking is None:
                return path, ""
            copy = folder / f"{len(list(folder.iterdir()))}.{path.stem}"
            with copy.open("wb") as target:
                shutil.copyfileobj(plain, target, 1 << 20)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror or error})") from None
    return copy, unpacking.damage
