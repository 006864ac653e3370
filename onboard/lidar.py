"""The HDL-32E's two UDP ports: packets checked, stamped, masked, batched, handed to the recorder; every loss counted."""

import logging
import select
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import hdl32e, records
from flightlog.constants import HOUR_NS, NS_PER_S, NS_PER_US
from flightlog.records import SCAN_PACKET_DTYPE, LidarAccount
from onboard import fovmask, lidarstate
from onboard.backlog import Put
from onboard.batch import BATCH_NS, Batch
from onboard.clocksync import Envelope
from onboard.config import LidarConfig
from onboard.datagrams import granted_buffer_bytes, open_udp
from onboard.fovmask import Window
from onboard.lidarcounts import LidarCounts
from onboard.lidarsender import LidarSender
from onboard.positionpackets import PositionPackets
from onboard.sensorview import SensorView, sectors_seen, view
from onboard.timesync import LogTime
from onboard.worker import Worker

_log = logging.getLogger(__name__)

_DATA_SLOTS: Final = 1024
_SMALL_BUFFER_BYTES: Final = 1 << 20
_SMALL_BUFFER_POLL_S: Final = 0.02
"""Debian's default buffer holds 50 ms of packets."""
_FIRST_POLL_S: Final = 0.02
"""After silence: what comes now may come at any rate."""
_GROWTH: Final = 2.0
"""A pause may be so much longer than the one before."""
_POSITION_SLOTS: Final = 128
_STAMP_NS: Final = 50 * NS_PER_US
"""What a lidar's clock is good for when it follows a pulse (M-A p. 9)."""
_CLOCK_NS: Final = NS_PER_S // 2
"""How often the lidar's clock is looked at."""
_LOOKS: Final = 64
"""Polls of which the directions are kept until somebody asks how the lidar is set; a second has half as many at 20 times its rate."""

_NOTHING: Final = LidarAccount()
_GOOD_KINDS: Final = frozenset({0, *(mode | hdl32e.PRODUCT_ID << 8 for mode in hdl32e.ReturnMode if mode)})
"""Return mode and product, the last two bytes of a packet, as one number; firmware of 2012 leaves them 0."""


class PacketFields:
    """Fields of the slots for data packets: taken once, because taking one costs more than looking at it.

    Parameters
    ----------
    slots : ndarray of SCAN_PACKET_DTYPE, shape (n,)
    """

    def __init__(self, slots: npt.NDArray[np.void]) -> None:
        data = slots["data"]
        self._flag = data["blocks"]["flag"]
        offset = SCAN_PACKET_DTYPE.fields["data"][1] + hdl32e.DATA_BYTES - 2  # type: ignore[index]  # numpy types the fields as optional; this dtype has them
        self._kind = np.ndarray(slots.shape, "<u2", slots, offset, slots.strides)

    def good(self, count: int) -> bool:
        """Whether the first packets all look alike, as those of an HDL-32E do; where not, hdl32e.is_data says which are."""
        if not count:
            return True
        kind = self._kind[:count]
        first = int(kind[0])
        if first not in _GOOD_KINDS or np.count_nonzero(kind != first):
            return False
        return not np.count_nonzero(self._flag[:count] != hdl32e.BLOCK_FLAG)


class LidarPort(Worker):
    """Polls both sockets.

    Parameters
    ----------
    config : LidarConfig
    log_time : LogTime
    put : callable
        The recorder's.
    wanted : callable
        Whether lidar packets are to be recorded now.
    handed_over : callable
        Told when all that a poll found is with the recorder: a good moment to sync.

    Raises
    ------
    SourceError
        A port cannot be opened.
    """

    def __init__(
        self,
        config: LidarConfig,
        log_time: LogTime,
        put: Put,
        wanted: Callable[[], bool] = lambda: True,
        handed_over: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__("lidar")
        self.counts = LidarCounts()
        self._wanted, self._handed_over = wanted, handed_over
        self._looks: deque[npt.NDArray[np.uint16]] = deque(maxlen=_LOOKS)
        self.clock = Envelope(HOUR_NS, _STAMP_NS)
        self._clock_due_ns = 0
        self._newest = b""
        self.window = window = Window.from_degrees(config.fov.start_deg, config.fov.end_deg)
        self._fov_deg = (window.start / 100, window.end / 100) if window.width else (0.0, 0.0)
        self._put = put
        buffer_bytes = config.receive_buffer_kb * 1024
        self._data_socket = open_udp(config.address, config.data_port, buffer_bytes)
        try:
            self._position_socket = open_udp(config.address, config.position_port, buffer_bytes // 8)
        except BaseException:
            self._data_socket.close()
            raise
        self._poll_s = self._pause_for_buffer(config.poll_ms / 1e3, buffer_bytes)
        self._pause_s = _FIRST_POLL_S
        self._data = Batch(
            self._data_socket, SCAN_PACKET_DTYPE, 8, hdl32e.DATA_BYTES, _DATA_SLOTS, log_time, self._poll_s
        )
        self._fields = PacketFields(self._data.slots)
        self._position = Batch(
            self._position_socket,
            hdl32e.POSITION_DTYPE,
            0,
            hdl32e.POSITION_BYTES,
            _POSITION_SLOTS,
            log_time,
            BATCH_NS / NS_PER_S,
        )
        self._sender = LidarSender(config, self._data.receiver, self._position.receiver)
        self._position_packets = PositionPackets(self.counts, put, wanted)

    def _pause_for_buffer(self, poll_s: float, asked_bytes: int) -> float:
        """Longest pause between polls that the receive buffer can bridge; a small buffer is reported."""
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
        arrival = select.poll()
        arrival.register(self._data_socket, select.POLLIN)
        try:
            before_ns = time.monotonic_ns()
            while not self.stopping:
                found = self._poll(self._data, self._close_data)
                now_ns = time.monotonic_ns()
                self._poll(self._position, self._close_position)
                self._handed_over()
                self._sender.watch(now_ns)
                self.progress()
                if found:
                    self._pause_s = self._next_pause_s(found, now_ns - before_ns)
                    before_ns = now_ns
                else:  # a call that waits for the first packet; for all of them it would wake up for each
                    arrival.poll(self._poll_s * 1e3)
                    self._pause_s = min(self._poll_s, _FIRST_POLL_S)
                    before_ns = time.monotonic_ns()
                time.sleep(self._pause_s)
            self._poll(self._data, self._close_data)
            self._poll(self._position, self._close_position)
            for batch in (self._data, self._position):
                batch.receiver.count_last_drops()
            self._close_data(self._data)
            self._close_position(self._position)
        finally:
            self.close()

    def _next_pause_s(self, found: int, within_ns: int) -> float:
        """How long to wait after a poll, so that at this rate of packets the next one finds no more than the slots hold."""
        until_full_s = _DATA_SLOTS * within_ns / (found * NS_PER_S)
        return min(self._poll_s, until_full_s, _GROWTH * self._pause_s)

    def _poll(self, batch: Batch, close: Callable[[Batch], None]) -> int:
        """Empty a socket; gives the number of datagrams found."""
        found = batch.fill()
        while batch.full and not self.stopping:  # there may be more
            close(batch)
            self.progress()
            found += batch.fill()
        if batch.due():
            close(batch)
        return found

    def view(self) -> SensorView | None:
        """How the lidar is set, by the packets since the last call; None: there were none."""
        looks, self._looks = self._looks, deque(maxlen=_LOOKS)
        if not looks:
            return None
        return view(np.frombuffer(self._newest, SCAN_PACKET_DTYPE)["data"], sectors_seen(np.concatenate(looks)))

    def _heard(self, packets: npt.NDArray[np.void], time_ns: npt.NDArray[np.int64]) -> None:
        """Note good packets of the lidar."""
        heard_ns = self._sender.heard()
        self.counts.sensor = self._sender.text
        self._newest = packets[-1:].tobytes()
        self._looks.append(packets["data"]["blocks"]["azimuth"][:, 0].copy())
        self.counts.good += len(packets)
        self.counts.newest_ns = int(time_ns[-1])
        if heard_ns >= self._clock_due_ns:
            self._clock_due_ns = heard_ns + _CLOCK_NS
            stamp_ns = packets["data"]["stamp_us"].astype(np.int64) * NS_PER_US
            first = int(np.argmax(stamp_ns - time_ns))  # the one that was on its way the shortest
            self.clock.add(int(time_ns[first]), int(stamp_ns[first]))

    def _close_position(self, batch: Batch) -> None:
        self._position_packets.close(batch, self._sender.address)

    # Data packets -------------------------------------------------------------------------------------------------

    def _close_data(self, batch: Batch) -> None:
        """Sort a batch, hand it over with its account, begin the next."""
        packets, sizes, time_ns, sources = batch.take()
        drops, refused = batch.new_drops()
        if not len(packets) and not drops and not refused:
            return
        fresh = LidarAccount(received=refused, rejected_sender=refused, kernel_drops=drops)
        self.counts.reject(lidarstate.REFUSED, refused)
        if not batch.receiver.all_are(len(packets), hdl32e.DATA_BYTES, self._sender.address) or not self._fields.good(
            len(packets)
        ):
            packets, time_ns, fresh = self._sort(packets, sizes, time_ns, sources, fresh)
        if len(packets):
            self._heard(packets, time_ns)
        self.counts.recording = self._wanted()
        if self.counts.recording:
            self._record(packets, time_ns, fresh)
        else:
            self.counts.not_armed += len(packets)
            self._count(fresh, len(packets))

    def _sort(
        self,
        packets: npt.NDArray[np.void],
        sizes: npt.NDArray[np.int64],
        time_ns: npt.NDArray[np.int64],
        sources: npt.NDArray[np.uint32],
        account: LidarAccount,
    ) -> tuple[npt.NDArray[np.void], npt.NDArray[np.int64], LidarAccount]:
        """The lidar's packets of a batch in which there are others; these are added to the account by reason."""
        right_size = sizes == hdl32e.DATA_BYTES
        good = right_size & hdl32e.is_data(packets["data"])
        if not good.all():
            self._tell_foreign(packets["data"][right_size & ~good])
        if self._sender.address is None and good.any():
            self._sender.adopt(sources[good])
        ours = good & (sources == (self._sender.address or 0))
        strangers = int((good & ~ours).sum())
        self.counts.reject(lidarstate.WRONG_SENDER, strangers)
        account = replace(
            account,
            received=account.received + len(packets) - int(ours.sum()),
            rejected_length=len(packets) - int(right_size.sum()),
            rejected_content=int((right_size & ~good).sum()),
            rejected_sender=account.rejected_sender + strangers,
        )
        return fovmask.select(packets, ours), time_ns[ours], account

    def _record(self, packets: npt.NDArray[np.void], time_ns: npt.NDArray[np.int64], account: LidarAccount) -> None:
        """Mask the lidar's packets and hand them over in pieces of about 0.1 s, each with its account.

        `account` holds what came besides; it goes with the first piece.
        """
        count = len(packets)
        pieces = max(1, round(int(time_ns[-1] - time_ns[0]) / BATCH_NS)) if count else 1
        for piece in range(pieces):
            part = slice(count * piece // pieces, count * (piece + 1) // pieces)
            stamp_ns = int(time_ns[part][-1]) if count else self._data.now_ns()
            self._record_piece(packets[part], stamp_ns, account)
            account = _NOTHING

    def _record_piece(self, packets: npt.NDArray[np.void], stamp_ns: int, fresh: LidarAccount) -> None:
        kept, masked_packets, masked_blocks = fovmask.apply(packets, self.window)
        written = len(kept) > 0 and self._put(records.LIDAR.topic, stamp_ns, records.encode_scan(stamp_ns, kept), False)
        account = LidarAccount(
            received=fresh.received + len(packets),
            kept=len(kept) if written else 0,
            masked_packets=masked_packets,
            masked_blocks=masked_blocks,
            rejected_length=fresh.rejected_length,
            rejected_content=fresh.rejected_content,
            rejected_sender=fresh.rejected_sender,
            kernel_drops=fresh.kernel_drops,
            queue_drops=0 if written else len(kept),
            fov_start_deg=self._fov_deg[0],
            fov_end_deg=self._fov_deg[1],
        )
        self._put(records.LIDAR_ACCOUNT.topic, stamp_ns, records.encode_account(stamp_ns, account), True)
        self._count(account)

    def _count(self, account: LidarAccount, unrecorded: int = 0) -> None:
        counts = self.counts
        counts.received += account.received + unrecorded
        counts.kept += account.kept
        counts.masked_packets += account.masked_packets
        counts.masked_blocks += account.masked_blocks
        counts.kernel_drops += account.kernel_drops
        counts.queue_drops += account.queue_drops
        self.counts.reject(lidarstate.WRONG_LENGTH, account.rejected_length)

    def _tell_foreign(self, packets: npt.NDArray[np.void]) -> None:
        """Name what has a data packet's length and is none of an HDL-32E."""
        flagged = (packets["blocks"]["flag"] == hdl32e.BLOCK_FLAG).all(axis=1)
        taller = hdl32e.is_hdl64e(packets)
        self.counts.reject(f"{lidarstate.WRONG_MODEL}: {hdl32e.HDL_64E}", int(taller.sum()))
        self.counts.reject(lidarstate.WRONG_CONTENT, int((~flagged & ~taller).sum()))
        for product, count in Counter(packets["product"][flagged].tolist()).items():
            name = hdl32e.OTHER_PRODUCTS.get(product, f"unknown return mode or product 0x{product:02x}")
            self.counts.reject(f"{lidarstate.WRONG_MODEL}: {name}", count)
