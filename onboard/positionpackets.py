"""The lidar's position packets on their way into the log: the lidar's own ones kept, all others counted by reason."""

from collections.abc import Callable

from flightlog import hdl32e, records
from flightlog.words import clean_bytes
from onboard import fovmask, lidarstate
from onboard.backlog import Put
from onboard.batch import Batch
from onboard.lidarcounts import LidarCounts


class PositionPackets:
    """Hands batches of position packets to the recorder.

    Parameters
    ----------
    counts : LidarCounts
    put : callable
        The recorder's.
    wanted : callable
        Whether lidar packets are to be recorded now.
    """

    def __init__(self, counts: LidarCounts, put: Put, wanted: Callable[[], bool]) -> None:
        self._counts, self._put, self._wanted = counts, put, wanted

    def close(self, batch: Batch, sensor: int | None) -> None:
        """Sort a batch, hand it over, begin the next; `sensor` is the lidar's address, None while it is not known."""
        counts = self._counts
        packets, sizes, time_ns, sources = batch.take()
        drops, refused = batch.new_drops()
        counts.position_kernel_drops += drops
        counts.reject("position " + lidarstate.REFUSED, refused)
        if not len(packets):
            return
        right_size = sizes == hdl32e.POSITION_BYTES
        good = right_size & hdl32e.is_position(packets)
        counts.reject("position packet of a wrong length", int((~right_size).sum()))
        counts.reject("position packet with other content", int((right_size & ~good).sum()))
        counts.position_received += len(packets)
        if sensor is not None:
            strangers = good & (sources != sensor)
            counts.reject("position packet from another sender than the lidar", int(strangers.sum()))
            good &= ~strangers
        kept, kept_ns = fovmask.select(packets, good), time_ns[good]
        if not len(kept):
            return
        stamp_ns = int(kept_ns[-1])
        counts.pps = int(kept["pps"][-1])
        counts.nmea = clean_bytes(bytes(kept["nmea"][-1]))
        counts.position_ns = stamp_ns
        if not self._wanted():
            return
        chunks = [(stamp, packet.tobytes()) for stamp, packet in zip(kept_ns.tolist(), kept, strict=True)]
        if self._put(records.POSITION.topic, stamp_ns, records.encode_raw(stamp_ns, chunks, "velodyne"), False):
            counts.position_kept += len(kept)
        else:
            counts.position_queue_drops += len(kept)
