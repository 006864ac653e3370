"""What became of everything that arrived at the lidar's ports."""

import logging
from collections import Counter
from dataclasses import dataclass, field

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class LidarCounts:
    """Since the start."""

    received: int = 0
    good: int = 0
    """Data packets of the lidar, recorded or not."""
    kept: int = 0
    recording: bool = True
    not_armed: int = 0
    """Good ones not recorded, because the vehicle was not armed."""
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
    position_ns: int = 0
    """Log time of that packet [ns]."""
    sensor: str = ""
    """Address of the lidar, once it is known."""

    def reject(self, reason: str, count: int) -> None:
        """Count what was refused, and say so the first time."""
        if not count:
            return
        if reason not in self.rejected:
            _log.warning("rejected from now on, and counted: %s", reason)
        self.rejected[reason] += count
