"""Who the lidar is: the sender that is believed, and the kernel's filters that refuse all others."""

import logging
import socket
import time
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import hdl32e
from flightlog.constants import NS_PER_S
from onboard.config import LidarConfig
from onboard.datagrams import Receiver
from onboard.packetfilter import address_number, address_text

_log = logging.getLogger(__name__)

_OPEN_NS: Final = 3 * NS_PER_S
"""A lidar silent for this long: everything is let in and looked at again, to tell why; it is not recorded."""
_FORGET_NS: Final = 10 * NS_PER_S
"""A lidar silent for this long may come back with another address, unless the configuration says which it has."""


class LidarSender:
    """The lidar's address, known or found, and what the sockets let in because of it.

    Parameters
    ----------
    config : LidarConfig
    data, position : Receiver
        Of the two ports.

    Attributes
    ----------
    address : int or None
        As a number; None: not known yet, or no longer.
    text : str
        In words, of the lidar that was last heard; empty before.
    """

    def __init__(self, config: LidarConfig, data: Receiver, position: Receiver) -> None:
        self.address = None if config.sensor is None else address_number(config.sensor)
        self.text = ""
        self._is_pinned = config.sensor is not None
        self._only_interface = config.interface if config.only_interface else None
        self._interface: int | None = None
        """Its index, where others are refused; 0: it is not there."""
        self._is_filtered = False
        self._heard_ns = time.monotonic_ns()
        self._data, self._position = data, position
        self._open()

    def adopt(self, sources: npt.NDArray[np.uint32]) -> None:
        """Take the sender of most good packets for the lidar; the kernel refuses all others once it is heard."""
        addresses, counts = np.unique(sources, return_counts=True)
        self.address = int(addresses[np.argmax(counts)])
        _log.info("the lidar is at %s", address_text(self.address))

    def heard(self) -> int:
        """Note that good packets of the lidar came; gives the monotonic clock [ns]."""
        assert self.address is not None
        self._heard_ns = time.monotonic_ns()
        if not self._is_filtered:
            self._is_filtered = True
            self.text = address_text(self.address)
            self._data.filter(hdl32e.DATA_BYTES, self.address, self._interface)
            self._position.filter(hdl32e.POSITION_BYTES, self.address, self._interface)
        return self._heard_ns

    def watch(self, now_ns: int) -> None:
        """Let everything in while the lidar is silent, to tell why it is; `now_ns` is the monotonic clock."""
        silent_ns = now_ns - self._heard_ns
        if self._is_filtered and silent_ns > _OPEN_NS:
            self._is_filtered = False
            self._open()
        elif not self._is_filtered and self._only_interface is not None:
            self._open()  # it may have come, or come back with another index
        if self.address is not None and not self._is_pinned and silent_ns > _FORGET_NS:
            _log.warning("the lidar at %s is silent; it may come back from another address", self.text)
            self.address = None

    def _open(self) -> None:
        """Let in what comes by the lidar's interface, whatever it is; without a name for that, everything."""
        if self._only_interface is None:
            self._data.unfilter()
            self._position.unfilter()
            return
        try:
            index = socket.if_nametoindex(self._only_interface)
        except OSError:
            index = 0
        for receiver in (self._data, self._position):
            receiver.filter(interface=index)
        if not index and self._interface != 0:
            _log.error("network interface %s is not there, and only what comes by it is let in", self._only_interface)
        self._interface = index
