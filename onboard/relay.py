"""Live downlink: what is received also goes to the ground by UDP, for a viewer or another swathd.

It may only ever lose its own data. The receivers put messages into a bounded queue and go on. This thread sends
without waiting; what the link does not take within half a second is dropped, oldest first, and counted. The rate
limit also does the pacing: a batch of 0.1 s is sent over that time and not at once. The daemon does not depend on
this thread.
"""

import errno
import logging
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flightlog import records
from flightlog.hdl32e import AZIMUTH_STEPS, DATA_BYTES
from onboard.config import DownlinkConfig
from onboard.status import DownlinkStatus
from onboard.worker import Worker

_log = logging.getLogger(__name__)

MAX_AGE_S: Final = 0.5
"""Older than this it is no live picture."""
_QUEUE_BYTES: Final = 4 << 20
"""Twice what that is in dual return mode; only a thread that hangs fills it."""
_TICK_S: Final = 0.01
_IDLE_S: Final = 0.1
_BUCKET_S: Final = 0.05
"""What was not sent may be caught up for this long."""
_FRAME_BYTES: Final = 42
"""Ethernet, IP and UDP around each datagram."""
_RETRY_S: Final = 1.0
_SECTOR: Final = 1000
"""Width of what is sent or left out together [0.01 deg]: five packets at 600 rpm."""
_JITTER: Final = 100
"""An azimuth that falls by more than this begins a new turn [0.01 deg]."""
_FULL: Final = (errno.EAGAIN, errno.ENOBUFS)


class Thinner:
    """Chooses one packet in `thin`: by sectors of the turn, others in each turn, so that `thin` turns make a whole scan.

    The load stays even, each turn shows something, and viewers, which cut at the azimuth, see turns.

    Parameters
    ----------
    thin : int
        1 keeps everything.
    """

    def __init__(self, thin: int) -> None:
        self._thin = thin
        self._turn = 0
        self._last = 0

    def choose(self, azimuth: npt.NDArray[np.uint16]) -> npt.NDArray[np.bool_]:
        """Which packets to send.

        Parameters
        ----------
        azimuth : ndarray of uint16, shape (n,)
            Of each packet's first block, in order [0.01 deg].

        Returns
        -------
        ndarray of bool, shape (n,)
        """
        if self._thin == 1 or not len(azimuth):
            return np.ones(len(azimuth), np.bool_)
        steps = azimuth.astype(np.int64) % AZIMUTH_STEPS
        begins = np.diff(steps, prepend=self._last) < -_JITTER
        turns = self._turn + np.cumsum(begins)
        self._turn, self._last = int(turns[-1]), int(steps[-1])
        return np.asarray((steps // _SECTOR + turns) % self._thin == 0)


@dataclass(slots=True)
class RelayCounts:
    """What became of the datagrams since the start: offered = thinned + sent + unheard + dropped + those still waiting."""

    offered: int = 0
    thinned: int = 0
    sent: int = 0
    sent_bytes: int = 0
    unheard: int = 0
    """Sent, and refused by the ground: no program has the port there."""
    dropped: int = 0
    """The link or the cap on its rate was too slow, or there was no way to the ground."""
    trouble: str = ""


class _Waiting(NamedTuple):
    """A message of the recorder that is to go down."""

    offered_s: float
    topic: str
    data: bytes


@dataclass(slots=True)
class _Burst:
    """Datagrams to one port, some of them sent."""

    offered_s: float
    topic: str
    payloads: list[memoryview]
    next: int = 0

    @property
    def left(self) -> int:
        return len(self.payloads) - self.next


class Relay(Worker):
    """Sends to the ground what it is offered.

    Parameters
    ----------
    config : DownlinkConfig
        With an address.
    """

    def __init__(self, config: DownlinkConfig) -> None:
        super().__init__("downlink")
        assert config.address is not None
        self.counts = RelayCounts()
        self._address = config.address
        self._ports = config.ports()
        self._bytes_per_s = config.rate_kbit_s * 125.0
        self._thinner = Thinner(config.thin)
        self._lock = threading.Lock()
        self._queue: deque[_Waiting] = deque()
        self._queued_bytes = 0
        self._overrun = 0
        """Datagrams pushed out of the queue and not yet counted."""
        self._bursts: deque[_Burst] = deque()
        self._sockets: dict[str, socket.socket] = {}
        self._retry_s = 0.0

    def offer(self, topic: str, data: bytes) -> None:
        """Take a message of the recorder along, if its topic goes down; never waits."""
        if topic not in self._ports or self.failure is not None:
            return
        with self._lock:
            self._queue.append(_Waiting(time.monotonic(), topic, data))
            self._queued_bytes += len(data)
            while self._queued_bytes > _QUEUE_BYTES:
                oldest = self._queue.popleft()
                self._queued_bytes -= len(oldest.data)
                self._overrun += _datagrams(oldest)

    def status(self, per_second: Callable[[str, int], float]) -> DownlinkStatus:
        """What the daemon's status says of it; `per_second` makes a rate of a count."""
        counts = self.counts
        return DownlinkStatus(
            address=self._address,
            sent_s=per_second("downlink", counts.sent),
            kbit_s=round(per_second("downlink bytes", counts.sent_bytes) / 125, 1),
            sent=counts.sent,
            thinned=counts.thinned,
            dropped=counts.dropped,
            unheard=counts.unheard,
            trouble=self.failure or counts.trouble,
        )

    def work(self) -> None:
        """Send until asked to stop; what waits then is dropped."""
        before_s, tokens = time.monotonic(), 0.0
        try:
            while not self.stopping:
                self._take()
                now_s = time.monotonic()
                tokens = min(tokens + (now_s - before_s) * self._bytes_per_s, _BUCKET_S * self._bytes_per_s + 1500)
                before_s = now_s
                self._drop_old(now_s)
                tokens = self._send(tokens, now_s)
                self.progress()
                self.pause(_TICK_S if self._bursts else _IDLE_S / 2)
        finally:
            self._take()
            self._drop_old(float("inf"))
            self._close()

    # Queue --------------------------------------------------------------------------------------------------------

    def _take(self) -> None:
        """Empty the queue: what is to be sent becomes bursts."""
        with self._lock:
            waiting = list(self._queue)
            self._queue.clear()
            self._queued_bytes = 0
            overrun, self._overrun = self._overrun, 0
        self.counts.offered += overrun
        self.counts.dropped += overrun
        for message in waiting:
            payloads = self._payloads(message)
            if payloads:
                self._bursts.append(_Burst(message.offered_s, message.topic, payloads))

    def _payloads(self, message: _Waiting) -> list[memoryview]:
        if message.topic != records.LIDAR.topic:
            chunks = [memoryview(chunk) for _, chunk in records.decode_raw(message.data)]
            self.counts.offered += len(chunks)
            return chunks
        packets = records.decode_scan(message.data)["data"]
        chosen = self._thinner.choose(packets["blocks"]["azimuth"][:, 0])
        block = memoryview(packets[chosen].tobytes())
        self.counts.offered += len(packets)
        self.counts.thinned += len(packets) - int(chosen.sum())
        return [block[start : start + DATA_BYTES] for start in range(0, len(block), DATA_BYTES)]

    def _drop_old(self, now_s: float) -> None:
        while self._bursts and now_s - self._bursts[0].offered_s > MAX_AGE_S:
            self.counts.dropped += self._bursts.popleft().left

    # Sending ------------------------------------------------------------------------------------------------------

    def _send(self, tokens: float, now_s: float) -> float:
        """Send as long as the cap and the link allow; gives the bytes that may still be sent."""
        if not self._bursts or (not self._sockets and not self._open(now_s)):
            return tokens
        try:
            while self._bursts and tokens > 0:
                burst = self._bursts[0]
                tokens = self._send_burst(burst, tokens)
                if not burst.left:
                    self._bursts.popleft()
        except OSError as error:
            if error.errno not in _FULL:
                hint = "; IPAddressAllow= of the service must name it" if error.errno == errno.EPERM else ""
                self._tell(f"{self._address} cannot be sent to ({error.strerror}{hint})")
                self._close()
                self._retry_s = now_s + _RETRY_S
        return tokens

    def _send_burst(self, burst: _Burst, tokens: float) -> float:
        sock, payloads = self._sockets[burst.topic], burst.payloads
        while burst.left and tokens > 0:
            payload = payloads[burst.next]
            try:
                sock.send(payload, socket.MSG_DONTWAIT)
            except ConnectionRefusedError:  # the answer to one before; it says that nobody listens there
                self.counts.unheard += 1
            else:
                self.counts.sent += 1
                self.counts.sent_bytes += len(payload)
            burst.next += 1
            tokens -= len(payload) + _FRAME_BYTES
        return tokens

    def _open(self, now_s: float) -> bool:
        if now_s < self._retry_s:
            return False
        try:
            for topic, port in self._ports.items():
                sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
                self._sockets[topic] = sock
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
                sock.connect((self._address, port))
        except OSError as error:
            self._tell(f"there is no way to {self._address} ({error.strerror})")
            self._close()
            self._retry_s = now_s + _RETRY_S
            return False
        if self.counts.trouble:
            _log.info("downlink: there is a way to %s again", self._address)
        self.counts.trouble = ""
        return True

    def _tell(self, trouble: str) -> None:
        if trouble != self.counts.trouble:
            _log.warning("downlink: %s; trying again, recording goes on", trouble)
        self.counts.trouble = trouble

    def _close(self) -> None:
        for sock in self._sockets.values():
            sock.close()
        self._sockets.clear()


def _datagrams(message: _Waiting) -> int:
    """How many datagrams a message holds."""
    if message.topic == records.LIDAR.topic:
        return len(records.decode_scan(message.data))
    return len(records.decode_raw(message.data))
