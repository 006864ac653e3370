"""What the receivers count, read once a second into what the status says: rates, ages, states."""

import time
from collections.abc import Callable

from flightlog.constants import NS_PER_MS, NS_PER_S
from onboard import lidarstate
from onboard.autopilot import LinkCounts
from onboard.health import LidarStatus, LinkStatus
from onboard.lidar import LidarPort
from onboard.packetfilter import address_number
from onboard.sensorview import SensorView

PerSecond = Callable[[str, int], float]


class Rates:
    """Counts per second, from one status to the next."""

    def __init__(self) -> None:
        self._then_ns = self._now_ns = time.monotonic_ns()
        self._counts: dict[str, int] = {}

    def begin(self, now_ns: int) -> None:
        """Begin a status."""
        self._then_ns, self._now_ns = self._now_ns, now_ns

    def per_second(self, name: str, count: int) -> float:
        """Rate of a count since the status before."""
        new = count - self._counts.get(name, 0)
        self._counts[name] = count
        return round(new * NS_PER_S / max(self._now_ns - self._then_ns, NS_PER_MS), 1)


def _age_s(newest_ns: int, log_ns: int) -> float | None:
    return (log_ns - newest_ns) / NS_PER_S if newest_ns else None


class LidarReadings:
    """Reads the lidar's port.

    Parameters
    ----------
    port : LidarPort
    interface : str or None
        Its network interface; None: found by its address.
    """

    def __init__(self, port: LidarPort, interface: str | None) -> None:
        self._port, self._interface = port, interface
        self._sensor = ""
        self._steady = 0

    def _link(self) -> bool | None:
        """Whether its network link is up."""
        sensor = self._port.counts.sensor
        if self._interface is None and sensor != self._sensor:
            self._sensor = sensor
            self._interface = lidarstate.interface_towards(address_number(sensor))
        return lidarstate.carrier(self._interface)

    def status(self, log_ns: int, per_second: PerSecond) -> LidarStatus:
        """What the status says of the lidar; to be asked once a second."""
        counts = self._port.counts
        age_s = _age_s(counts.newest_ns, log_ns)
        rate = per_second("lidar", counts.good)
        rejected = dict(counts.rejected)
        rejected_s = {reason: per_second(reason, count) for reason, count in rejected.items()}
        seen = self._port.view() or SensorView()
        # a stream that begins, ends, or had its packets read in bunches tells nothing of its rate in that second
        self._steady = self._steady + 1 if seen.expected_packets_s and age_s is not None and age_s < 0.5 else 0
        expected = seen.expected_packets_s if self._steady > 2 else 0.0
        link = self._link()
        return LidarStatus(
            state=lidarstate.classify(age_s, link, rejected_s, rate, expected),
            link=link,
            sensor=counts.sensor,
            age_s=age_s,
            packets_s=rate,
            expected_packets_s=seen.expected_packets_s,
            return_mode=seen.return_mode,
            rpm=seen.rpm,
            fov_start_deg=seen.fov_start_deg,
            fov_end_deg=seen.fov_end_deg,
            position_packets_s=per_second("position", counts.position_received),
            received=counts.received,
            kept=counts.kept,
            not_armed=counts.not_armed,
            masked_packets=counts.masked_packets,
            kernel_drops=counts.kernel_drops,
            queue_drops=counts.queue_drops,
            position_kept=counts.position_kept,
            position_drops=counts.position_kernel_drops + counts.position_queue_drops,
            rejected=rejected,
            rejected_s=round(sum(rejected_s.values()), 1),
            pps=counts.pps,
            nmea=counts.nmea,
        )


def link_status(name: str, counts: LinkCounts, log_ns: int, per_second: PerSecond) -> LinkStatus:
    """What the status says of a MAVLink link."""
    return LinkStatus(
        connected=counts.connected,
        trouble=counts.trouble,
        age_s=_age_s(counts.newest_ns, log_ns),
        frames_s=per_second(f"{name} frames", counts.frames),
        bytes_s=per_second(f"{name} bytes", counts.received_bytes),
        autopilot="" if counts.autopilot is None else "{}/{}".format(*counts.autopilot),
        version=counts.version,
        heartbeats=counts.heartbeats,
        armed=counts.armed,
        bad_bytes=counts.bad_bytes,
        unknown_frames=counts.unknown_frames,
        dropped_bytes=counts.queue_dropped_bytes,
        kernel_drops=counts.kernel_drops,
    )
