"""What an import takes of the network: captures, with the lidar's packets and MAVLink in one stream."""

from collections.abc import Iterator
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any, Final

from flightlog import hdl32e, records
from flightlog.errors import CaptureError
from groundproc.flight.importers import pcap, udp
from groundproc.flight.importers.inputs import Input
from groundproc.flight.importers.joining import Event
from groundproc.flight.importers.mavlinkstreams import MavlinkStreams
from groundproc.flight.importers.mended import mended
from groundproc.flight.importers.ports import Elsewhere, Ports
from groundproc.flight.importers.sources import facts_of
from groundproc.flight.importers.starting import Start, start_of
from groundproc.flight.importers.steady import Steady

PROBE_PACKETS: Final = 64
"""Data packets that tell a model."""
_PROBE_EVENTS: Final = 2000


class Capture:
    """A pcap or pcapng file.

    Parameters
    ----------
    path : Path
    ports : Ports
    link : str
        Name of the autopilot's link whose frames are taken.
    takes_mavlink : bool
        False: MAVLink in it is counted and left out.

    Attributes
    ----------
    first_packets : dict of bytes to list of bytes
        The first data packets, by their sender.
    elsewhere : Elsewhere

    Raises
    ------
    CaptureError
        No such file, no capture, or one of a link layer that is not read.
    """

    kind = "capture"

    def __init__(self, path: Path, ports: Ports, link: str, *, takes_mavlink: bool = True) -> None:
        self.path = path
        self.found = pcap.CaptureCount()
        self.datagrams = udp.DatagramCount()
        self.steady = Steady()
        self.mavlink = MavlinkStreams(records.MAVLINK.topic + link)
        self.elsewhere = Elsewhere()
        self.first_packets: dict[bytes, list[bytes]] = {}
        self.mavlink_left_out = 0
        self._ports, self._link, self._takes_mavlink = ports, link, takes_mavlink
        self._input = Input(path)
        try:
            self._stream = self._sorted_out(pcap.packets(self._input.stream, self.found, str(path)))
            self._head = self._probe()
        except OSError as error:
            raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None

    def _sorted_out(self, packets: Iterator[pcap.Packet]) -> Iterator[Event]:
        """What the capture holds of lidar and autopilot, with the times of the capture; the rest is counted."""
        topics = {self._ports.lidar: records.LIDAR.topic, self._ports.position: records.POSITION.topic}
        mavlink = frozenset(self._ports.mavlink)
        for datagram in udp.datagrams(packets, self.datagrams):
            topic = topics.get(datagram.port)
            if topic is not None:
                yield Event(datagram.time_ns, topic, datagram.payload, datagram.sender)
            elif datagram.port in mavlink or datagram.source_port in mavlink:
                if self._takes_mavlink:
                    yield from self.mavlink.feed(datagram)
                else:
                    self.mavlink_left_out += 1
            else:
                self.elsewhere.add(datagram.port, datagram.payload)
        yield from self.mavlink.finish()
        self._check_links()

    def _check_links(self) -> None:
        """Refuse a capture of which nothing can be read, with the reason."""
        if self.datagrams.datagrams:
            return
        if self.datagrams.links:
            raise CaptureError(
                f"{self.path}: {_link_names(self.datagrams.links)}; expected Ethernet, Linux cooked, loopback or raw IP: capture on "
                "the interface of the lidar"
            )
        if self.datagrams.cut:
            raise CaptureError(f"{self.path}: {snap_text(self.datagrams)}")

    def _probe(self) -> list[Event]:
        """Take the first events, among them enough packets of the lidar to tell which model it is."""
        head: list[Event] = []
        count = 0
        for event in self._stream:
            head.append(event)
            if event.topic == records.LIDAR.topic and len(event.data) == hdl32e.DATA_BYTES:
                self.first_packets.setdefault(event.sender, []).append(event.data)
                count += 1
            if count >= PROBE_PACKETS or len(head) >= _PROBE_EVENTS:
                break
        return head

    def events(self) -> Iterator[Event]:
        """What was received from lidar and autopilot, in the order in which it was sent, with times that never step back."""
        return self.steady(self._as_stamped())

    def start(self) -> Start | None:
        """What the first stamps say; a file is opened once more for it, of a pipe what was read already has to do."""
        if not self.path.is_file():
            return start_of(lambda: self._head)
        again = Capture(self.path, self._ports, self._link, takes_mavlink=self._takes_mavlink)
        try:
            return start_of(again._as_stamped)
        finally:
            again.close()

    def _as_stamped(self) -> Iterator[Event]:
        return chain(self._head, self._stream)

    @property
    def mavlink_frames(self) -> int:
        """See Source."""
        return self.mavlink.frames

    def facts(self) -> dict[str, Any]:
        """See Source."""
        datagrams = {name: value for name, value in asdict(self.datagrams).items() if name != "links"}
        links = {f"link_type_{link}": count for link, count in self.datagrams.links.items()}
        mavlink = {"mavlink_frames": self.mavlink.frames, "mavlink_bad_bytes": self.mavlink.bad_bytes}
        counters = asdict(self.found) | datagrams | links | mavlink | asdict(self.steady)
        sha256 = self._input.sha256()
        return facts_of(self, self._input.size, sha256, counters)

    def notes(self) -> list[str]:
        """See Source."""
        notes = []
        if self._input.damage:
            notes.append(f"{self.path}: {self._input.damage}")
        if self.found.damage:
            notes.append(f"{self.path}: {self.found.damage}, {self.found.lost_bytes} bytes left out")
        if self.datagrams.links:
            notes.append(f"{self.path}: {_link_names(self.datagrams.links)} left out")
        if self.datagrams.cut:
            notes.append(f"{self.path}: {snap_text(self.datagrams)}; left out")
        if self.datagrams.fragments:
            notes.append(f"{self.path}: {self.datagrams.fragments} IP fragments whose others are missing left out")
        if self.found.untimed or self.found.borrowed_times:
            count = self.found.untimed + self.found.borrowed_times
            notes.append(f"{self.path}: {count} packets carry no time of their own")
        if self.mavlink.bad_bytes:
            notes.append(f"{self.path}: {self.mavlink.bad_bytes} bytes on the MAVLink ports belong to no good frame")
        if self.mavlink_left_out:
            notes.append(
                f"{self.path}: {self.mavlink_left_out} datagrams on the MAVLink ports left out, because --mavlink gives a telemetry "
                "log; --mavlink-port takes them too"
            )
        return notes + [f"{self.path}: {said}" for said in mended(self.steady)]

    def close(self) -> None:
        """See Source."""
        self._input.close()


def _link_names(links: dict[int, int]) -> str:
    return ", ".join(
        f"{count} packets of link type {link} ({udp.LINK_NAMES.get(link, 'not known here')})"
        for link, count in links.items()
    )


def snap_text(count: udp.DatagramCount) -> str:
    """What to say of packets of which only the beginning was captured."""
    return (
        f"{count.cut} packets were cut when they were captured, to {count.snap_bytes} bytes or less (snap length); capture whole "
        "packets, with tcpdump -s 0"
    )
