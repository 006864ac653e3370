"""Bags of ROS 1 and ROS 2 (bag, db3, MCAP): packets of the lidar and MAVLink frames, whatever the topics are called.

Read by `rosbags`; of the definitions in a bag none is needed, because the messages that hold raw packets are few and known.
"""

import heapq
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flightlog import hdl32e, records
from flightlog.constants import NS_PER_S
from flightlog.errors import CaptureError
from flightlog.words import clean
from groundproc import packed
from groundproc.flight.importers import bagunpacking
from groundproc.flight.importers.captures import PROBE_PACKETS
from groundproc.flight.importers.inputs import hash_of
from groundproc.flight.importers.joining import Event
from groundproc.flight.importers.kinds import BAG, HEAD_BYTES, MCAP, Kind, kind_of
from groundproc.flight.importers.mavlinkstreams import frame_bytes
from groundproc.flight.importers.mended import mended
from groundproc.flight.importers.sources import facts_of
from groundproc.flight.importers.starting import Start, start_of
from groundproc.flight.importers.steady import Steady
from groundproc.flight.importers.topics import topic_sender
from groundproc.machine import system

_DEFINITIONS: Final = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
    "nebula_msgs/msg/NebulaPacket": "builtin_interfaces/Time stamp\nuint8[] data\n",
    "nebula_msgs/msg/NebulaPackets": "std_msgs/Header header\nnebula_msgs/NebulaPacket[] packets\n",
    "udp_msgs/msg/UdpPacket": "std_msgs/Header header\nstring address\nint32 src_port\nuint8[] data\n",
    "swath_msgs/msg/RawChunk": "builtin_interfaces/Time stamp\nuint8[] data\n",
    "swath_msgs/msg/RawBatch": "std_msgs/Header header\nswath_msgs/RawChunk[] chunks\n",
    "mavros_msgs/msg/Mavlink": (
        "std_msgs/Header header\nuint8 framing_status\nuint8 magic\nuint8 len\nuint8 incompat_flags\nuint8 compat_flags\nuint8 seq\n"
        "uint8 sysid\nuint8 compid\nuint32 msgid\nuint16 checksum\nuint64[] payload64\nuint8[] signature\n"
    ),
}
"""Messages that hold raw packets: of the drivers of ROS, Autoware's, of a plain UDP receiver, of ours, and of MAVROS."""
_FARTHEST_NS: Final = 10 * NS_PER_S
"""A packet's own stamp further from the time at which it was recorded is no time of reception."""


@dataclass(frozen=True, slots=True)
class _Piece:
    """Bytes of a message: a packet, or a part of a MAVLink stream; the stamp is 0 where it has none."""

    stamp_ns: int
    data: bytes


def _packets(message: Any) -> list[_Piece]:
    parts = message.packets if hasattr(message, "packets") else message.chunks
    return [_Piece(_ns(part.stamp), part.data.tobytes()) for part in parts]


def _one(message: Any) -> list[_Piece]:
    stamp = message.stamp if hasattr(message, "stamp") else message.header.stamp
    return [_Piece(_ns(stamp), message.data.tobytes())]


def _frame(message: Any) -> list[_Piece]:
    return [_Piece(_ns(message.header.stamp), frame_bytes(message))]


_READ: Final[dict[str, Callable[[Any], list[_Piece]]]] = {
    "velodyne_msgs/msg/VelodyneScan": _packets, "velodyne_msgs/msg/VelodynePacket": _one, "nebula_msgs/msg/NebulaPackets": _packets,
    "udp_msgs/msg/UdpPacket": _one, "swath_msgs/msg/RawBatch": _packets, "mavros_msgs/msg/Mavlink": _frame,
}  # fmt: skip


def _ns(stamp: Any) -> int:
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


class Bag:
    """A bag.

    Attributes
    ----------
    first_packets : dict of bytes to list of bytes
        The first data packets of each topic.

    Raises
    ------
    CaptureError
        It cannot be read, or holds no message with raw packets.
    """

    kind = "bag"

    def __init__(self, path: Path, link: str, folder: Path) -> None:
        self.path = path
        self.steady = Steady()
        self.first_packets: dict[bytes, list[bytes]] = {}
        self.mavlink_frames = 0
        self.unreadable = 0
        self._link = link
        self._content, self._damage = _named(path, folder)
        self._is_ros1 = self._content.suffix == ".bag"
        self._types = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.ROS2_HUMBLE)
        for name, text in _DEFINITIONS.items():
            self._types.register(get_types_from_msg(text, name))
        bagunpacking.BUDGET.begin()
        with _as_sentence(path, self._damage):
            for database in [self._content] if self._content.is_file() else sorted(self._content.glob("*.db3")):
                if database.suffix == ".db3":
                    bagunpacking.check_tables(database)
            self._reader = rosbag1.Reader(self._content) if self._is_ros1 else rosbag2.Reader(self._content)
            self._reader.open()
            self._connections = [each for each in self._reader.connections if each.msgtype in _READ]
        if not self._connections:
            others = _what_else(self._reader.connections)
            self.close()
            raise CaptureError(f"{path}: {others}")
        try:
            self._probe()
        except CaptureError:
            self.close()
            raise

    def _probe(self) -> None:
        """Look at the first packets of each topic."""
        for connection in self._connections:
            for event in self._events(connection):
                if event.topic == records.LIDAR.topic:
                    first = self.first_packets.setdefault(event.sender, [])
                    first.append(event.data)
                    if len(first) >= PROBE_PACKETS:
                        break
                elif event.topic != records.LIDAR.topic:
                    break
        self.mavlink_frames = self.unreadable = 0

    def events(self) -> Iterator[Event]:
        """The packets of lidar and autopilot, in the order in which they were sent, with times that never step back."""
        return self.steady(self._as_stamped())

    def start(self) -> Start | None:
        """What the first stamps say."""
        found = start_of(self._as_stamped)
        self.mavlink_frames = self.unreadable = 0
        return found

    def _as_stamped(self) -> Iterator[Event]:
        return heapq.merge(*map(self._events, self._connections), key=attrgetter("time_ns"))

    def _events(self, connection: Connection) -> Iterator[Event]:
        with _as_sentence(self.path, self._damage):
            for _, recorded_ns, raw in self._reader.messages([connection]):
                yield from self._message(connection, recorded_ns, raw)

    def _message(self, connection: Connection, recorded_ns: int, raw: bytes) -> list[Event]:
        decode = self._types.deserialize_ros1 if self._is_ros1 else self._types.deserialize_cdr
        try:
            pieces = _READ[connection.msgtype](decode(raw, connection.msgtype))
        except Exception:  # whatever foreign bytes make a foreign decoder raise
            self.unreadable += 1
            return []
        found = []
        last = len(pieces) - 1
        for i, piece in enumerate(pieces):
            topic = self._topic(connection, piece.data)
            if topic is not None:
                close = abs(piece.stamp_ns - recorded_ns) < _FARTHEST_NS
                # without stamps of their own: a scan is recorded with its last packet
                time_ns = piece.stamp_ns if close else recorded_ns - (last - i) * hdl32e.PACKET_NS
                sender = topic_sender(connection.topic) if topic == records.LIDAR.topic else b""
                found.append(Event(time_ns, topic, piece.data, sender))
        return found

    def _topic(self, connection: Connection, data: bytes) -> str | None:
        """Where a piece belongs in the log; None for what is neither the lidar's nor an autopilot's."""
        if connection.topic.startswith(records.MAVLINK.topic) or connection.msgtype == "mavros_msgs/msg/Mavlink":
            self.mavlink_frames += 1
            return records.MAVLINK.topic + self._link
        if len(data) == hdl32e.DATA_BYTES:
            return records.LIDAR.topic
        return records.POSITION.topic if len(data) == hdl32e.POSITION_BYTES else None

    def facts(self) -> dict[str, Any]:
        """See Source."""
        counters = {"unreadable": self.unreadable} | asdict(self.steady)
        whole = self.path if self.path.is_file() else None
        size = whole.stat().st_size if whole else sum(each.stat().st_size for each in self.path.iterdir())
        return facts_of(self, size, hash_of(whole) if whole else "", counters)

    def notes(self) -> list[str]:
        """See Source."""
        found = [f"{self.path}: {self._damage}"] if self._damage else []
        if self.unreadable:
            found.append(f"{self.path}: {self.unreadable} messages cannot be read and are left out")
        return found + [f"{self.path}: {said}" for said in mended(self.steady)]

    def close(self) -> None:
        """See Source."""
        with _as_sentence(self.path, self._damage):
            self._reader.close()


class _as_sentence:  # noqa: N801 - a context manager, used as a statement
    """Turns what the library raises on bytes that are no bag into one sentence: it lets errors of many kinds through."""

    def __init__(self, path: Path, damage: str) -> None:
        self._path, self._damage = path, damage

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, Exception) and not (
            isinstance(error, CaptureError) and str(error).startswith(str(self._path))
        ):
            reason = self._damage or clean(" ".join(str(error).split())) or type(error).__name__
            help_is = "; rosbag reindex mends a bag that was not closed" if "index" in reason else ""
            raise CaptureError(f"{self._path}: cannot be read as a bag ({reason}){help_is}") from None


def _named(path: Path, folder: Path) -> tuple[Path, str]:
    """The bag under a name by which the library recognises it, unpacked where it is compressed; and what is wrong with it.

    Raises
    ------
    CaptureError
        It is no bag.
    """
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise CaptureError(f"{path}: is a folder without metadata.yaml, so no ROS 2 bag; give the files in it")
        return path, ""
    content, damage = packed.unpacked(path, folder)
    with content.open("rb") as file:
        head = file.read(HEAD_BYTES)
    kind = kind_of(head)
    if kind.name not in (BAG, MCAP):
        raise CaptureError(f"{path}: {damage or _no_bag(kind)}")
    suffix = ".mcap" if kind.name == MCAP else ".bag" if head.startswith(b"#ROSBAG") else ".db3"
    if content.suffix == suffix:
        return content, damage
    link = folder / f"{len(list(folder.iterdir()))}{suffix}"
    system.linked(link, content)
    return link, damage


def _no_bag(kind: Kind) -> str:
    remedy = f"; {kind.remedy}" if kind.remedy else ""
    return f"is {kind.what}, expected a bag of ROS 1 (.bag) or ROS 2 (.db3, .mcap, or the folder){remedy}"


def _what_else(connections: list[Connection]) -> str:
    topics = ", ".join(f"{clean(each.topic)} ({clean(each.msgtype)})" for each in connections[:10]) or "none"
    return f"holds no raw packets, expected velodyne_msgs/VelodyneScan on any topic; its topics are {topics}"
