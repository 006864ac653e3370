"""The HDL-32E's two UDP ports: packets checked, stamped, masked, batched, handed to the recorder; every loss counted."""

import logging
import socket
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import hdl32e, records
from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.records import SCAN_PACKET_DTYPE, LidarAccount
from onboard import fovmask
from onboard.config import LidarConfig
from onboard.datagrams import Receiver, granted_buffer_bytes, open_udp
from onboard.fovmask import Window
from onboard.timesync import KernelTime, LogTime, read_clocks
from onboard.worker import Worker

_log = logging.getLogger(__name__)

BATCH_NS: Final = 100 * NS_PER_MS
"""A message of the log spans about this much."""
_DATA_SLOTS: Final = 512
_SMALL_BUFFER_BYTES: Final = 1 << 20
_SMALL_BUFFER_POLL_S: Final = 0.02
"""Debian's default buffer holds 50 ms of packets."""
_IDLE_POLL_S: Final = 0.02
"""While nothing comes: what comes next may come at any rate."""
_POSITION_SLOTS: Final = 128

Put = Callable[[str, int, bytes, bool], bool]
"""Hands a message to the recorder: topic, log time, bytes, whether it is small and must not be lost; False if it was refused."""


@dataclass(slots=True)
class LidarCounts:
    """What became of everything that arrived at the lidar's ports since the start."""

    received: int = 0
    kept: int = 0
    masked_packets: int = 0
    masked_blocks: int = 0
    kernel_drops: int = 0
    queue_drops: int = 0
    position_received: int = 0
    position_kept: int = 0
    position_kernel_drops: int = 0
    position_queue_drops: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    """By reason."""
    newest_ns: int = 0
    """Log time of the newest good data packet [ns]."""
    pps: int = 0
    """The newest position packet's PPS state; what it means is in hdl32e.PpsState."""
    nmea: str = ""
    """The newest position packet's sentence."""


class LidarPort(Worker):
    """Polls both sockets.

    Parameters
    ----------
    config : LidarConfig
    log_time : LogTime
    put : callable
        The recorder's.

    Raises
    ------
    SourceError
        A port cannot be opened.
    """

    def __init__(self, config: LidarConfig, log_time: LogTime, put: Put) -> None:
        super().__init__("lidar")
        self.counts = LidarCounts()
        self.window = Window.from_degrees(config.fov.start_deg, config.fov.end_deg)
        self._put = put
        buffer_bytes = config.receive_buffer_kb * 1024
        self._data_socket = open_udp(config.address, config.data_port, buffer_bytes)
        try:
            self._position_socket = open_udp(config.address, config.position_port, buffer_bytes // 8)
        except BaseException:
            self._data_socket.close()
            raise
        self._poll_s = self._pause_for_buffer(config.poll_ms / 1e3, buffer_bytes)
        self._data = _Batch(
            self._data_socket, SCAN_PACKET_DTYPE, 8, hdl32e.DATA_BYTES, _DATA_SLOTS, log_time, self._poll_s
        )
        self._position = _Batch(
            self._position_socket,
            hdl32e.POSITION_DTYPE,
            0,
            hdl32e.POSITION_BYTES,
            _POSITION_SLOTS,
            log_time,
            BATCH_NS / NS_PER_S,
        )
        self._told: set[str] = set()

    def _pause_for_buffer(self, poll_s: float, asked_bytes: int) -> float:
        """Time between two polls that the receive buffer stands; a small one is told of."""
        granted = granted_buffer_bytes(self._data_socket)
        if granted < asked_bytes:
            _log.warning(
                "the kernel grants a receive buffer of %d kB of the %d kB asked for; raise net.core.rmem_max to %d",
                granted // 1024, asked_bytes // 1024, asked_bytes,
            )  # fmt: skip

        return min(poll_s, _SMALL_BUFFER_POLL_S) if granted < _SMALL_BUFFER_BYTES else poll_s

    def close(self) -> None:
        """Close the sockets of a port that was never started."""
        self._data_socket.close()
        self._position_socket.close()

    def work(self) -> None:
        """Poll until asked to stop, then hand over what is left."""
        try:
            position_due_ns = 0
            before_ns = time.monotonic_ns()
            while not self.stopping:
                found = self._poll(self._data, self._close_data)
                now_ns = time.monotonic_ns()
                if now_ns >= position_due_ns:
                    self._poll(self._position, self._close_position)
                    position_due_ns = now_ns + BATCH_NS // 2
                self.progress()
                time.sleep(self._pause_s(found, now_ns - before_ns))
                before_ns = now_ns
            self._poll(self._data, self._close_data)
            self._poll(self._position, self._close_position)
            for batch in (self._data, self._position):
                batch.receiver.count_last_drops()
            self._close_data(self._data)
            self._close_position(self._position)
        finally:
            self.close()

    def _pause_s(self, found: int, within_ns: int) -> float:
        """How long to wait after a poll, so that at this rate of packets the next one finds no more than the slots hold."""
        if not found:
            return min(self._poll_s, _IDLE_POLL_S)
        return min(self._poll_s, _DATA_SLOTS * within_ns / (found * NS_PER_S))

    def _poll(self, batch: "_Batch", close: "Callable[[_Batch], None]") -> int:
        """Empty a socket; gives the number of datagrams found."""
        found = batch.fill()
        while batch.full and not self.stopping:  # there may be more
            close(batch)
            self.progress()
            found += batch.fill()
        if batch.due():
            close(batch)
        return found

    # Data packets -------------------------------------------------------------------------------------------------

    def _close_data(self, batch: "_Batch") -> None:
        """Sort a batch, hand it over with its account, begin the next."""
        packets, sizes, time_ns = batch.take()
        drops = batch.new_drops()
        if not len(packets) and not drops:
            return
        right_size = sizes == hdl32e.DATA_BYTES
        whole = fovmask.select(packets, right_size) if not right_size.all() else packets
        good = hdl32e.is_data(whole["data"])
        if not good.all():
            self._tell_foreign(whole["data"][~good])
            whole = fovmask.select(whole, good)
        masked = fovmask.apply(whole, self.window)
        stamp_ns = int(time_ns[-1]) if len(time_ns) else batch.now_ns()
        written = len(masked.packets) > 0 and self._put(
            records.LIDAR.topic, stamp_ns, records.encode_scan(stamp_ns, masked.packets), False
        )
        account = LidarAccount(
            received=len(packets),
            kept=len(masked.packets) if written else 0,
            masked_packets=masked.masked_packets,
            masked_blocks=masked.masked_blocks,
            rejected_length=len(packets) - int(right_size.sum()),
            rejected_content=int(right_size.sum()) - len(whole),
            kernel_drops=drops,
            queue_drops=0 if written else len(masked.packets),
            fov_start_deg=self.window.start / 100 if self.window.width else 0.0,
            fov_end_deg=self.window.end / 100 if self.window.width else 0.0,
        )
        self._put(records.LIDAR_ACCOUNT.topic, stamp_ns, records.encode_account(stamp_ns, account), True)
        self._count(account, stamp_ns if len(whole) else 0)

    def _count(self, account: LidarAccount, newest_ns: int) -> None:
        counts = self.counts
        counts.received += account.received
        counts.kept += account.kept
        counts.masked_packets += account.masked_packets
        counts.masked_blocks += account.masked_blocks
        counts.kernel_drops += account.kernel_drops
        counts.queue_drops += account.queue_drops
        counts.newest_ns = newest_ns or counts.newest_ns
        self._reject("data packet of a wrong length", account.rejected_length)

    def _tell_foreign(self, packets: npt.NDArray[np.void]) -> None:
        """Name what has a data packet's length and is none of an HDL-32E."""
        flagged = (packets["blocks"]["flag"] == hdl32e.BLOCK_FLAG).all(axis=1)
        self._reject("data packet without block flags", int((~flagged).sum()))
        for product, count in Counter(packets["product"][flagged].tolist()).items():
            name = hdl32e.OTHER_PRODUCTS.get(product, f"unknown return mode or product 0x{product:02x}")
            self._reject(f"data packet of another sensor: {name}", count)

    def _reject(self, reason: str, count: int) -> None:
        if not count:
            return
        self.counts.rejected[reason] += count
        if reason not in self._told:
            self._told.add(reason)
            _log.warning("rejected from now on, and counted: %s", reason)

    # Position packets ---------------------------------------------------------------------------------------------

    def _close_position(self, batch: "_Batch") -> None:
        packets, sizes, time_ns = batch.take()
        self.counts.position_kernel_drops += batch.new_drops()
        if not len(packets):
            return
        right_size = sizes == hdl32e.POSITION_BYTES
        good = right_size & hdl32e.is_position(packets)
        self._reject("position packet of a wrong length", int((~right_size).sum()))
        self._reject("position packet with other content", int((right_size & ~good).sum()))
        self.counts.position_received += len(packets)
        kept, kept_ns = fovmask.select(packets, good), time_ns[good]
        if not len(kept):
            return
        stamp_ns = int(kept_ns[-1])
        chunks = [(stamp, packet.tobytes()) for stamp, packet in zip(kept_ns.tolist(), kept, strict=True)]
        if self._put(records.POSITION.topic, stamp_ns, records.encode_raw(stamp_ns, chunks, "velodyne"), False):
            self.counts.position_kept += len(kept)
        else:
            self.counts.position_queue_drops += len(kept)
        self.counts.pps = int(kept["pps"][-1])
        self.counts.nmea = kept["nmea"][-1].split(b"\0")[0].decode("ascii", "replace").strip()


class _Batch:
    """Slots that fill up from poll to poll, with the receive times of what is in them."""

    def __init__(
        self,
        sock: socket.socket,
        dtype: np.dtype[np.void],
        offset: int,
        size: int,
        slots: int,
        log_time: LogTime,
        poll_s: float,
    ) -> None:
        self._slots = np.zeros(slots, dtype)
        self._time_ns = np.zeros(slots, np.int64)
        self._count = 0
        self._poll_ns = round(poll_s * NS_PER_S)
        self._drops_told = 0
        self._log_time = log_time
        self._now = read_clocks()
        self._kernel_time = KernelTime(log_time, self._now)
        self.receiver = Receiver(sock, self._slots, offset, size)

    @property
    def full(self) -> bool:
        """Whether no slot is left."""
        return self._count == len(self._slots)

    def fill(self) -> int:
        """Take what is waiting, as far as there are slots; gives the number of datagrams."""
        first = self._count
        count = self.receiver.receive(first)
        if count:
            self._now = read_clocks()
            part = slice(first, first + count)
            stamps_ns = self.receiver.stamps_ns[part]
            stamps_ns[stamps_ns == 0] = self._now.realtime_ns
            self._time_ns[part] = self._kernel_time.convert(
                stamps_ns, self._now, emptied=first + count < len(self._slots)
            )
            self._count += count
        return count

    def due(self) -> bool:
        """Whether what is in here will be as old as a message may be before anyone looks again."""
        if not self._count:
            return False
        age_ns = self._log_time.anchor_ns + time.monotonic_ns() - int(self._time_ns[0])
        return age_ns >= BATCH_NS - self._poll_ns // 2

    def take(self) -> tuple[npt.NDArray[np.void], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Datagrams with receive time (in data packets also inside), their sizes; valid until the next `fill`."""
        part = slice(0, self._count)
        self._count = 0
        packets, time_ns = self._slots[part], self._time_ns[part]
        if packets.dtype == SCAN_PACKET_DTYPE:
            records.set_receive_time_ns(packets, time_ns)
        return packets, self.receiver.sizes[part], time_ns

    def new_drops(self) -> int:
        """Datagrams the kernel dropped since this was last asked."""
        new = self.receiver.drops - self._drops_told
        self._drops_told = self.receiver.drops
        return new

    def now_ns(self) -> int:
        """Log time [ns]."""
        return self._log_time.at(read_clocks())
