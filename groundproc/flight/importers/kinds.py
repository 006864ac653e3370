"""What a file is by its first bytes, and which command takes it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flightlog import dataflash
from flightlog.container import MAGIC
from flightlog.errors import CaptureError
from groundproc import packed
from groundproc.flight.importers import tlog

HEAD_BYTES: Final = 1 << 16
CAPTURE, TLOG, DATAFLASH, MCAP, BAG, PACKED = "capture", "tlog", "dataflash", "mcap", "bag", "packed"

_CAPTURES: Final = (
    b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x0a\x0d\x0d\x0a",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of file.

    Attributes
    ----------
    name : str
        CAPTURE, TLOG and so on; empty for what no command takes.
    what : str
        As a sentence goes on after "is".
    remedy : str
        The command that takes it; empty where there is none.
    """

    name: str
    what: str
    remedy: str = ""


_CAPTURE: Final = Kind(CAPTURE, "a packet capture", "swath import --pcap makes a log of it")
_STARTS: Final[tuple[tuple[bytes, Kind], ...]] = (
    *((magic, _CAPTURE) for magic in _CAPTURES),
    (MAGIC, Kind(MCAP, "an MCAP file", "swath import --bag takes it where it is no flight log of ours")),
    (b"#ROSBAG V2", Kind(BAG, "a ROS 1 bag", "swath import --bag makes a log of it")),
    (b"SQLite format 3\x00", Kind(BAG, "a ROS 2 bag (db3)", "swath import --bag makes a log of it")),
    (b"PK\x03\x04", Kind("", "a ZIP archive", "unpack it")),
    (b"7z\xbc\xaf\x27\x1c", Kind("", "a 7-Zip archive", "unpack it")),
    (b"Rar!", Kind("", "a RAR archive", "unpack it")),
    (b"LASF", Kind("", "a point cloud (LAS, LAZ)", "swath adjust takes clouds")),
    (b"snoop\x00", Kind("", "a Solaris snoop capture", "Wireshark saves it as pcap")),
    (b"GMBU", Kind("", "a capture of Microsoft Network Monitor", "Wireshark saves it as pcap")),
    (b"RTSS", Kind("", "a capture of Microsoft Network Monitor", "Wireshark saves it as pcap")),
    (b"\x34\xcd\xb2\xa1", Kind("", "a pcap of Kuznetzov's modified form", "Wireshark saves it as pcap")),
)
_TLOG: Final = Kind(TLOG, "a telemetry log", "swath import --mavlink makes a log of it")
_DATAFLASH: Final = Kind(DATAFLASH, "a dataflash log of ArduPilot", "swath import --mavlink makes a log of it")


def kind_of(head: bytes) -> Kind:
    """The kind of a file that begins so; `head` is its first HEAD_BYTES."""
    if packing := packed.packing(head):
        return Kind(PACKED, f"a {packing} file", "swath import takes compressed recordings as they are")
    for magic, kind in _STARTS:
        if head.startswith(magic):
            return kind
    if head[257:262] == b"ustar":
        return Kind("", "a tar archive", "unpack it")
    if dataflash.is_dataflash(head):
        return _DATAFLASH
    if tlog.is_tlog(head):
        return _TLOG
    return Kind("", "nothing that is known" if head else "empty")


def head_of(path: Path) -> bytes:
    """The first HEAD_BYTES of a file, of what is in it where it is compressed.

    Raises
    ------
    CaptureError
        It cannot be opened or read.
    """
    try:
        with path.open("rb") as file:
            plain, _ = packed.opened(file, str(path))
            return plain.read(HEAD_BYTES)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be opened ({error.strerror or error})") from None
    except ValueError:
        raise CaptureError(f"{str(path)!r}: is no name of a file") from None
