"""A flight log that is still being written, read as it grows."""

import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

from flightlog import container, records
from flightlog.container import DAMAGE, MAGIC, RECORD_HEAD, Opcode
from flightlog.errors import LogError
from flightlog.logfile import Message
from groundproc.live.inbox import Inbox, Received
from groundproc.live.receivers import Counts

_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
_POLL_S: Final = 0.05
_LARGEST_RECORD: Final = 256 << 20


class Follower:
    """Gives the messages of a log's whole chunks as they appear; ends at its footer.

    Parameters
    ----------
    inbox : Inbox
        One that waits: a file that is there already is read as fast as it is worked on.
    path : Path
    link : str
        Which MAVLink link: "ins" or "fc".

    Raises
    ------
    LogError
        No such file, or no flight log.
    """

    def __init__(self, inbox: Inbox, path: Path, link: str) -> None:
        self._inbox, self._path, self._stop = inbox, path, threading.Event()
        self._mavlink = records.MAVLINK.topic + link
        self._topics: dict[int, str] = {}
        self._counts = Counts()
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise LogError(f"{path}: cannot be opened ({error.strerror})") from None
        self._thread = threading.Thread(target=self._work, name="follow", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """End the thread and close the file."""
        self._stop.set()
        self._inbox.end()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._file.close()

    def counts(self) -> Counts:
        """Chunks that could not be read count as rejected."""
        return self._counts

    def _work(self) -> None:
        try:
            for message in self._messages():
                self._put(message)
            self._inbox.end()
        except BaseException as error:
            self._inbox.end(error)

    def _put(self, message: Message) -> None:
        now_s = time.monotonic()
        if message.topic == records.LIDAR.topic:
            self._inbox.put(Received(message.topic, now_s, packets=records.decode_scan(message.data)))
        elif message.topic == records.POSITION.topic:
            self._inbox.put(Received(message.topic, now_s, chunks=records.decode_raw(message.data)))
        elif message.topic == self._mavlink:
            self._inbox.put(Received(records.MAVLINK.topic, now_s, chunks=records.decode_raw(message.data)))

    def _messages(self) -> Iterator[Message]:
        offset = len(MAGIC)
        while not self._stop.is_set():
            record = self._record(offset)
            if record is None:
                self._stop.wait(_POLL_S)
                continue
            opcode, content = record
            offset += RECORD_HEAD.size + len(content)
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            if opcode == Opcode.CHUNK:
                try:
                    yield from self._opened(container.open_chunk(content))
                except DAMAGE:
                    self._counts.rejected += 1

    def _record(self, offset: int) -> tuple[int, bytes] | None:
        """Opcode and content of the record at `offset`; None where it is not whole yet."""
        self._file.seek(offset)
        head = self._file.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return None
        opcode, size = RECORD_HEAD.unpack(head)
        if opcode == 0 or size > _LARGEST_RECORD:
            if opcode:
                raise LogError(f"{self._path}: byte {offset}: a record of {size} bytes; the log is damaged here")
            return None  # a copy in progress may show zeros first
        content = self._file.read(size)
        return (opcode, content) if len(content) == size else None

    def _opened(self, content: bytes) -> Iterator[Message]:
        view, offset = memoryview(content), 0
        while offset < len(content):
            opcode, size = RECORD_HEAD.unpack_from(content, offset)
            offset += RECORD_HEAD.size
            if opcode == Opcode.CHANNEL:
                number, topic = container.channel(content[offset : offset + size])
                self._topics[number] = topic
            elif opcode == Opcode.MESSAGE:
                number, _, time_ns, _ = _MESSAGE_HEAD.unpack_from(content, offset)
                if number in self._topics:
                    yield Message(self._topics[number], time_ns, view[offset + _MESSAGE_HEAD.size : offset + size])
            offset += size
