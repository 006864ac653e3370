"""UDP reception: many datagrams in one system call, each with the kernel's receive time and its count of losses.

recvmmsg(2) fills an array in place. It is cheap because the caller polls only every so many milliseconds: a call
that waits would wake up for each packet. The structures are those of a 64-bit Linux.
"""

import ctypes
import errno
import os
import socket
import struct
import time
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from flightlog.errors import SourceError
from onboard import packetfilter

SO_TIMESTAMPNS: Final = 35
SO_RXQ_OVFL: Final = 40
SO_MEMINFO: Final = 55
_MEMINFO: Final = struct.Struct("=II24xI")
"""What SO_MEMINFO gives (linux/sock_diag.h): first the bytes queued and the limit of the queue, last the drops."""
MAX_DATAGRAMS: Final = 1024
"""The kernel takes no more in one call (UIO_MAXIOV)."""

_IOVEC_DTYPE: Final = np.dtype([("base", "<u8"), ("size", "<u8")])
_MESSAGE_DTYPE: Final = np.dtype(
    {
        "names": ["name", "name_size", "iov", "iov_count", "control", "control_size", "flags", "size"],
        "formats": ["<u8", "<u4", "<u8", "<u8", "<u8", "<u8", "<i4", "<u4"],
        "offsets": [0, 8, 16, 24, 32, 40, 48, 56],
        "itemsize": 64,
    }
)
"""struct mmsghdr."""
_NAME_DTYPE: Final = np.dtype([("family", "<u2"), ("port", ">u2"), ("address", ">u4"), ("zero", "V8")])
"""struct sockaddr_in."""
_CONTROL_DTYPE: Final = np.dtype(
    [
        ("size", "<u8"), ("level", "<i4"), ("kind", "<i4"), ("sec", "<i8"), ("nanosec", "<i8"),
        ("drops_size", "<u8"), ("drops_level", "<i4"), ("drops_kind", "<i4"), ("drops", "<u4"), ("pad", "<u4"),
    ]
)  # fmt: skip
"""The two control messages of a datagram: SO_TIMESTAMPNS always, then SO_RXQ_OVFL once anything was dropped (sock_recv_cmsgs)."""
_WITH_TIME: Final = 32
_WITH_DROPS: Final = 52

_CROWDED: Final = 0.7
"""A queue fuller than this may have overflowed; the kernel gives memory back late, by up to a quarter of the limit."""

_libc = ctypes.CDLL(None, use_errno=True)
_libc.recvmmsg.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
_libc.recvmmsg.restype = ctypes.c_int


def open_udp(address: str, port: int, receive_buffer_bytes: int) -> socket.socket:
    """Open a socket that stamps what it receives and counts what it drops.

    Raises
    ------
    SourceError
        The port is taken, or the address is not ours.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    try:
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
        sock.bind((address, port))
    except OSError as error:
        sock.close()
        what = "another program has it" if error.errno == errno.EADDRINUSE else str(error.strerror or error)
        raise SourceError(f"UDP port {port} at {address} cannot be opened: {what}") from None
    return sock


def granted_buffer_bytes(sock: socket.socket) -> int:
    """How much of the requested receive buffer the kernel granted; it doubles the value for its own bookkeeping."""
    return sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


class Receiver:
    """Empties a socket into an array.

    Parameters
    ----------
    sock : socket
        From `open_udp`.
    slots : ndarray, shape (n,), n <= 1024
        Contiguous; a datagram goes into each element.
    offset, size : int
        Which bytes of an element it fills; what is longer is cut off and `sizes` says size + 1.

    Attributes
    ----------
    sizes : ndarray of int64, shape (n,)
        Bytes of each datagram received.
    stamps_ns : ndarray of int64, shape (n,)
        The kernel's receive time on the wall clock [ns]; where it gave none, that of the call.
    drops : int
        Datagrams lost in the socket since it was opened, as far as known.
    refused : int
        Datagrams that the socket's filter refused.
    """

    def __init__(self, sock: socket.socket, slots: npt.NDArray[np.generic], offset: int, size: int) -> None:
        count = len(slots)
        assert slots.flags.c_contiguous
        assert count <= MAX_DATAGRAMS
        assert offset + size <= slots.dtype.itemsize
        self._sock, self._slots, self._limit = sock, slots, size
        self.sizes = np.zeros(count, np.int64)
        self.stamps_ns = np.zeros(count, np.int64)
        self.drops = self.refused = 0
        self._counter = 0
        self._is_filtered = self._was_crowded = False
        self._names = np.zeros(count, _NAME_DTYPE)
        self._iov = np.zeros(count, _IOVEC_DTYPE)
        self._control = np.zeros(count, _CONTROL_DTYPE)
        self._messages = np.zeros(count, _MESSAGE_DTYPE)
        index = np.arange(count, dtype=np.uint64)
        self._iov["base"] = slots.ctypes.data + offset + index * np.uint64(slots.dtype.itemsize)
        self._iov["size"] = size
        self._messages["name"] = self._names.ctypes.data + index * np.uint64(_NAME_DTYPE.itemsize)
        self._messages["name_size"] = _NAME_DTYPE.itemsize
        self._messages["iov"] = self._iov.ctypes.data + index * np.uint64(_IOVEC_DTYPE.itemsize)
        self._messages["iov_count"] = 1
        self._messages["control"] = self._control.ctypes.data + index * np.uint64(_CONTROL_DTYPE.itemsize)
        self._messages["control_size"] = _CONTROL_DTYPE.itemsize
        # Made once: getting a field of a structured array or an address takes longer than most uses of it.
        self._address = int(self._messages.ctypes.data)
        self._message_size, self._message_flags = self._messages["size"], self._messages["flags"]
        self._control_size = self._messages["control_size"]
        # What the kernel reports of each datagram, as three words: size of the control messages, flags, size.
        self._told = self._messages.view(np.uint64).reshape(count, -1)[:, 5:]
        self._usual = np.array([_WITH_TIME, 0, size], np.uint64)
        self._stamp_s, self._stamp_part_ns = self._control["sec"], self._control["nanosec"]
        self._sources = self._names["address"]

    @property
    def sources(self) -> npt.NDArray[np.uint32]:
        """IPv4 address of each datagram's sender, shape (n,)."""
        return self._sources

    def all_are(self, count: int, size: int, source: int | None) -> bool:
        """Whether the first datagrams have this size and this sender, all of them; False where the sender is not known."""
        if source is None or np.count_nonzero(self.sizes[:count] != size):
            return False
        return not np.count_nonzero(self._sources[:count] != source)

    def filter(self, payload_bytes: int | None = None, source: int | None = None, interface: int | None = None) -> None:
        """Have the kernel refuse all but datagrams of one length, from one IPv4 address, by the interface of one index."""
        self.count_last_drops()
        packetfilter.attach(self._sock, packetfilter.program(payload_bytes, source, interface))
        self._is_filtered = True

    def unfilter(self) -> None:
        """Let everything in again."""
        if self._is_filtered:
            self.count_last_drops()
            packetfilter.detach(self._sock)
            self._is_filtered = False

    def receive(self, first: int = 0) -> int:
        """Take what is waiting into the elements from `first` on; gives the number of datagrams, never waits."""
        if self._is_filtered:
            self.count_last_drops()
        room = len(self._slots) - first
        address = self._address + first * _MESSAGE_DTYPE.itemsize
        count = int(_libc.recvmmsg(self._sock.fileno(), address, room, socket.MSG_DONTWAIT, None))
        if count <= 0:
            error = ctypes.get_errno() if count < 0 else 0
            if error not in (0, errno.EAGAIN, errno.EINTR, errno.ECONNREFUSED, errno.ENETDOWN):
                raise OSError(error, os.strerror(error))
            return 0
        part = slice(first, first + count)
        stamps_ns = np.multiply(self._stamp_s[part], NS_PER_S, out=self.stamps_ns[part])
        stamps_ns += self._stamp_part_ns[part]
        if np.count_nonzero(self._told[part] != self._usual):
            self._note_unusual(part, stamps_ns)
        else:
            self.sizes[part] = self._limit
        self._control_size[part] = _CONTROL_DTYPE.itemsize
        return count

    def _note_unusual(self, part: slice, stamps_ns: npt.NDArray[np.int64]) -> None:
        """Handle datagrams of other lengths, reported drops, and missing times."""
        self.sizes[part] = self._message_size[part]
        flags = self._message_flags[part]
        self.sizes[part][flags & socket.MSG_TRUNC != 0] = self._limit + 1
        control_size = self._control_size[part]
        stamps_ns[control_size < _WITH_TIME] = time.time_ns()
        if control_size[-1] >= _WITH_DROPS and not self._is_filtered:
            self._count_drops(int(self._control["drops"][part][-1]), is_lost=True)

    def count_last_drops(self) -> None:
        """Ask the kernel for drops that no later datagram has reported.

        It counts what the filter refused and what found no room alike. But the queue only grows until we empty it: where it had room
        to spare both now and the time before, nothing can have been lost in between, and it was the filter.
        """
        answer = self._sock.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 64)
        if len(answer) < _MEMINFO.size:
            return
        queued, limit, counter = _MEMINFO.unpack_from(answer)
        is_crowded = queued > limit * _CROWDED
        self._count_drops(counter, is_lost=is_crowded or self._was_crowded or not self._is_filtered)
        self._was_crowded = is_crowded

    def _count_drops(self, counter: int, *, is_lost: bool) -> None:
        new = (counter - self._counter) % (1 << 32)
        if new >> 31:  # of a datagram that was queued before we asked
            return
        self._counter = counter
        if is_lost:
            self.drops += new
        else:
            self.refused += new
