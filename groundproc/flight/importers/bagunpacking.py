"""What bags unpack to, held to the ceiling of compressed files: the library unpacks whatever a chunk says, to any size.

A few kilobytes of a bag can unpack to gigabytes, in a chunk of a ROS 1 bag or an MCAP file, in each message or in a whole
file of a ROS 2 bag. The library keeps what it unpacks with in tables of its modules; ours takes its place in them.
"""

import contextlib
import io
import sqlite3
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import reader as ros2
from rosbags.rosbag2 import storage_mcap

from flightlog.errors import CaptureError
from groundproc import packed

_TABLES: Final = ("messages", "topics", "schema", "metadata", "message_definitions")


@dataclass(slots=True)
class _Budget:
    """Bytes that were unpacked of a bag, and those that they were unpacked of, as often as each was."""

    taken: int = 0
    given: int = 0

    def begin(self) -> None:
        self.taken = self.given = 0


BUDGET: Final = _Budget()
"""Of the bag that was opened last; bags are read one after the other."""


def plain(data: bytes) -> bytes:
    """What is in the compressed bytes of a chunk or a message.

    Raises
    ------
    CaptureError
        It is more than any bag holds.
    ValueError
        It is damaged.
    """
    if not packed.packing(data[: packed.HEAD_BYTES]):
        raise ValueError("compressed data begin with no mark that is known")
    room = packed.most_bytes(BUDGET.taken + len(data)) - BUDGET.given
    unpacking = packed.Unpacking(io.BytesIO(data), "a chunk")
    found = io.BufferedReader(unpacking, 1 << 18).read(max(room, 0) + 1)
    if len(found) > room:
        raise CaptureError(f"unpacks to more than {packed.EXPANSION} times its size, which no bag does")
    if unpacking.damage:
        raise ValueError(unpacking.damage)
    BUDGET.taken += len(data)
    BUDGET.given += len(found)
    return found


class _Zstd:
    """In the place of the library's module: what unpacks is ours."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)

    decompress = staticmethod(plain)

    @staticmethod
    def open(file: BinaryIO, mode: str = "rb") -> BinaryIO:
        """A compressed file, to be read."""
        head = file.read(packed.HEAD_BYTES)
        file.seek(0)
        if mode != "rb" or not packed.packing(head):
            raise ValueError("compressed data begin with no mark that is known")
        return io.BufferedReader(packed.Unpacking(file, "the bag"), 1 << 18)


def install() -> None:
    """Put ours in the place of what the library unpacks with."""
    for name in (ros1.Compression.BZ2, ros1.Compression.LZ4):
        ros1.decompressors[name.value] = plain
    storage_mcap.DECOMPRESSORS["lz4"] = lambda data, size: plain(data)
    for module in (ros2, storage_mcap):
        if not isinstance(module.zstd, _Zstd):
            setattr(module, "zstd", _Zstd(module.zstd))  # noqa: B010 - the types of the library know nothing of it


install()


def check_tables(path: Path) -> None:
    """Refuse an SQLite file whose tables are made by what stands in it: reading one row of such a table may never end.

    Raises
    ------
    CaptureError
    """
    try:
        with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as bag:
            kinds = bag.execute("SELECT name, type FROM sqlite_master").fetchall()
            made = [name for name, kind in kinds if name in _TABLES and kind != "table"]
            computed = [
                name
                for name, kind in kinds
                if name in _TABLES and any(column[-1] for column in bag.execute(f"PRAGMA table_xinfo({name})"))
            ]
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: cannot be read as a bag ({error})") from None
    if made or computed:
        raise CaptureError(
            f"{path}: its {(made + computed)[0]} are computed, expected a plain table as rosbag2 writes it"
        )
