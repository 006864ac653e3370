"""Makes a long flight log of a short one by repeating it, every stamp shifted so that all clocks run on.

    python benchmarks/long_log.py SHORT.mcap LONG.mcap --times 120

For benchmarks and tests of length, no flight: at every seam the aircraft jumps back to where it started. Each clock advances from
repetition to repetition by as much as it did against the receive times within the flight, so that neither its rate nor its phase
has a step. What is shifted: log and receive times, the lidar's stamps and GPS sentences, MAVLink's time_boot_ms, time_usec and
time_unix_usec with the frames' sequence numbers and checksums (a signature is not made anew), the host's clocks. What is left
out: dataflash logs, and bytes of a MAVLink link that belong to no frame. The flight must be of one boot of each autopilot.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import hdl32e, mavlink, nmea, records
from flightlog.constants import NS_PER_MS, NS_PER_S, NS_PER_US
from flightlog.errors import LogError
from flightlog.logfile import LogReader, Message
from flightlog.logwriter import LogWriter
from flightlog.mavlink import Frame, FrameParser
from groundproc.flight import load
from groundproc.flight.positionpackets import position_samples

Address = tuple[str, int, int]
"""Link, system, component."""

_UNIX_US: Final = 10**15
"""A time_usec beyond this is no time since boot but Unix time (2001)."""
_STAMP_NS: Final = {"time_boot_ms": NS_PER_MS, "time_usec": NS_PER_US, "time_unix_usec": NS_PER_US}
"""Fields of MAVLink messages that are shifted, and their units."""
_OWN_METADATA: Final = ("swath.log", "swath.topics")
"""What LogWriter writes of itself."""


@dataclass(frozen=True, slots=True)
class Period:
    """By how much the clocks are on from one repetition to the next.

    Attributes
    ----------
    host_ns : int
        Of receive times.
    lidar_rate : float
        Of the lidar's clock over the host's.
    boot_rates : dict of str to float
        Of the autopilot's boot clock over the host's, by link.
    frames : dict of Address to int
        Sequence numbers that each sender of MAVLink uses up.
    """

    host_ns: int
    lidar_rate: float
    boot_rates: dict[str, float]
    frames: dict[Address, int]


@dataclass(frozen=True, slots=True)
class Shift:
    """What one repetition adds to the stamps of the flight; fields as in Period."""

    host_ns: int
    lidar_ns: int
    boots_ns: dict[str, int]
    frames: dict[Address, int]


def shift(period: Period, repetition: int) -> Shift:
    """Shift of a repetition; from the first one each time, so that roundings do not add up."""
    host_ns = period.host_ns * repetition
    return Shift(
        host_ns,
        round(host_ns * period.lidar_rate),
        {link: round(host_ns * rate) for link, rate in period.boot_rates.items()},
        {address: count * repetition for address, count in period.frames.items()},
    )


# Measuring ------------------------------------------------------------------------------------------------------------


def measure(reader: LogReader) -> Period:
    """How long a flight is, and how fast its clocks run.

    Every stream goes on after its last packet no sooner than its mean interval later. A GPS tells whole seconds: a log with its
    sentences is repeated at whole seconds.

    Raises
    ------
    LogError
        Fewer than two lidar packets.
    """
    device, receive = _lidar_times(reader)
    if len(receive) < 2:
        raise LogError(f"{reader.path}: {len(receive)} lidar packets, expected a flight")
    samples = position_samples([reader])
    spans = [int(receive[-1] - receive[0]) + hdl32e.PACKET_NS, _span_ns(samples.receive_time_ns)]
    boot_rates: dict[str, float] = {}
    counts: dict[Address, int] = {}
    for topic in sorted({message.topic for message in reader.messages((records.MAVLINK.topic,))}):
        link = topic.removeprefix(records.MAVLINK.topic)
        frames = [frame for frame in load.mavlink_frames([reader], link) if frame.known]
        spans.append(_span_ns(np.array([frame.time_ns for frame in frames], np.int64)))
        boot_rates[link] = _boot_rate(frames)
        ends: dict[Address, list[int]] = {}
        for frame in frames:
            ends.setdefault((link, frame.system, frame.component), []).append(frame.sequence)
        counts |= {address: numbers[-1] - numbers[0] + 1 for address, numbers in ends.items()}
    host_ns = max(spans)
    if samples.sentences:
        host_ns = -(-host_ns // NS_PER_S) * NS_PER_S
    return Period(host_ns, _rate(device, receive), boot_rates, counts)


def _lidar_times(reader: LogReader) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Lidar and receive times [ns] of the first and the last packet of every batch."""
    batches = [batch for batch in load.lidar_batches([reader]) if len(batch.packets)]
    ends = [0, -1]
    pairs = [(batch.device_time_ns[ends], batch.receive_time_ns[ends]) for batch in batches]
    device, receive = zip(*pairs, strict=True) if pairs else ((), ())
    none = np.empty(0, np.int64)
    return np.concatenate([none, *device]), np.concatenate([none, *receive])


def _span_ns(time_ns: npt.NDArray[np.int64]) -> int:
    """From the first time of a stream to where it would go on [ns]."""
    if len(time_ns) < 2:
        return 0
    span_ns = int(time_ns[-1] - time_ns[0])
    return span_ns + span_ns // (len(time_ns) - 1)


def _boot_rate(frames: list[Frame]) -> float:
    pairs = [
        (int.from_bytes(_whole(frame)[offset : offset + 4], "little") * NS_PER_MS, frame.time_ns)
        for frame in frames
        for offset, _, name in _stamps(frame.message_id)
        if name == "time_boot_ms"
    ]
    times = np.array(pairs, np.int64).reshape(-1, 2)
    return _rate(times[:, 0], times[:, 1])


def _rate(device_ns: npt.NDArray[np.int64], receive_ns: npt.NDArray[np.int64]) -> float:
    """Rate of a clock over that of the receive times, by least squares; 1 where there is nothing to tell."""
    if len(device_ns) < 2 or np.ptp(receive_ns) == 0:
        return 1.0
    x = (receive_ns - receive_ns.mean()).astype(np.float64)
    return 1.0 + float(x @ (device_ns - receive_ns - (device_ns - receive_ns).mean()) / (x @ x))


# Shifting -------------------------------------------------------------------------------------------------------------


def lidar(message: Message, by: Shift) -> bytes:
    """A batch of lidar packets, later."""
    packets = records.decode_scan(message.data)
    records.set_receive_time_ns(packets, records.receive_time_ns(packets) + by.host_ns)
    stamps_us = packets["data"]["stamp_us"].astype(np.int64) + round(by.lidar_ns / NS_PER_US)
    packets["data"]["stamp_us"] = stamps_us % hdl32e.STAMP_WRAP_US
    return records.encode_scan(message.log_time_ns + by.host_ns, packets)


def position(message: Message, by: Shift) -> bytes:
    """A batch of position packets, later."""
    chunks = [(time_ns + by.host_ns, _position_packet(data, by)) for time_ns, data in records.decode_raw(message.data)]
    return records.encode_raw(message.log_time_ns + by.host_ns, chunks, "velodyne")


def _position_packet(data: bytes, by: Shift) -> bytes:
    if len(data) != hdl32e.POSITION_BYTES:
        return data
    packet = np.frombuffer(data, hdl32e.POSITION_DTYPE).copy()
    packet["stamp_us"] = (packet["stamp_us"].astype(np.int64) + round(by.lidar_ns / NS_PER_US)) % hdl32e.STAMP_WRAP_US
    fix = nmea.parse_rmc(packet["nmea"][0])
    if fix is not None:
        packet["nmea"] = nmea.format_rmc(
            fix.utc_ns + by.host_ns, fix.latitude_deg, fix.longitude_deg, valid=fix.valid
        ).encode()
    return packet.tobytes()


def account(message: Message, by: Shift) -> bytes:
    """The account of a batch, later."""
    return records.encode_account(message.log_time_ns + by.host_ns, records.decode_account(message.data))


def host_clock(message: Message, by: Shift) -> bytes:
    """The host's clocks, later."""
    clock = records.decode_host_clock(message.data)
    later = {
        name: getattr(clock, name) + by.host_ns for name in ("log_ns", "realtime_ns", "monotonic_ns", "boottime_ns")
    }
    return records.encode_host_clock(replace(clock, **later))


@cache
def _stamps(message_id: int) -> list[tuple[int, int, str]]:
    """Offset, size and name of the fields of a message that are shifted."""
    dtype = mavlink.payload_dtype(message_id)
    assert dtype.fields is not None
    return [(entry[1], entry[0].itemsize, name) for name, entry in dtype.fields.items() if name in _STAMP_NS]


def _whole(frame: Frame) -> bytes:
    """The payload with the zeros that version 2 cuts."""
    return frame.payload.ljust(mavlink.payload_dtype(frame.message_id).itemsize, b"\x00")


def shifted_frame(frame: Frame, link: str, by: Shift) -> bytes:
    """A frame as it would have been sent later; one outside the dialect stays as it is, its checksum cannot be known."""
    if not frame.known:
        return frame.data
    payload = bytearray(_whole(frame))
    for offset, size, name in _stamps(frame.message_id):
        value = int.from_bytes(payload[offset : offset + size], "little")
        since_boot = name == "time_boot_ms" or value < _UNIX_US
        if value and not (name == "time_unix_usec" and since_boot):  # no date before the first fix
            add_ns = by.boots_ns[link] if since_boot else by.host_ns
            value = (value + round(add_ns / _STAMP_NS[name])) % (1 << 8 * size)
            payload[offset : offset + size] = value.to_bytes(size, "little")
    head = bytearray(frame.data[: 6 if frame.version == 1 else 10])
    if frame.version == 2:
        payload = payload.rstrip(b"\x00") or payload[:1]
    tail = frame.data[len(head) + head[1] + 2 :]
    place = 2 if frame.version == 1 else 4
    head[1] = len(payload)
    head[place] = (head[place] + by.frames[(link, frame.system, frame.component)]) % 256
    covered = bytes(head + payload)
    extra = dialect.mavlink_map[frame.message_id].crc_extra
    return covered + int(mcrf4xx(covered[1:] + bytes((extra,)))).to_bytes(2, "little") + tail


_PLAIN: Final[dict[str, Callable[[Message, Shift], bytes]]] = {
    records.LIDAR.topic: lidar,
    records.POSITION.topic: position,
    records.LIDAR_ACCOUNT.topic: account,
    records.HOST_CLOCK.topic: host_clock,
}


def repetition(reader: LogReader, by: Shift) -> Iterator[tuple[str, int, bytes]]:
    """Topic, log time [ns] and content of the messages of one repetition."""
    parsers: dict[str, FrameParser] = {}
    for message in reader.messages():
        log_ns = message.log_time_ns + by.host_ns
        plain = _PLAIN.get(message.topic)
        if plain is not None:
            yield message.topic, log_ns, plain(message, by)
        elif message.topic.startswith(records.MAVLINK.topic):
            link = message.topic.removeprefix(records.MAVLINK.topic)
            parser = parsers.setdefault(link, FrameParser())
            frames = [
                frame for time_ns, data in records.decode_raw(message.data) for frame in parser.feed(time_ns, data)
            ]
            if frames:
                yield message.topic, log_ns, _frames(frames, link, by)
    for link, parser in parsers.items():
        frames = parser.finish()
        if frames:
            yield records.MAVLINK.topic + link, frames[-1].time_ns + by.host_ns, _frames(frames, link, by)


def _frames(frames: list[Frame], link: str, by: Shift) -> bytes:
    chunks = [(frame.time_ns + by.host_ns, shifted_frame(frame, link, by)) for frame in frames]
    return records.encode_raw(chunks[-1][0], chunks, link)


def write_long_log(source: Path, target: Path, times: int) -> float:
    """Repeat a flight log and give the length of the new one [s].

    Parameters
    ----------
    source : Path
        A flight of one boot.
    target : Path
        Written over if it is there.
    times : int
        How often the flight is flown.
    """
    with LogReader(source) as reader, target.open("wb") as stream:
        period = measure(reader)
        metadata = {name: values for name, values in reader.metadata.items() if name not in _OWN_METADATA}
        metadata["swath.repeated"] = {"times": str(times), "period_ns": str(period.host_ns)}
        writer = LogWriter(stream, metadata=metadata, attachments=reader.attachments, library="swath benchmarks")
        for number in range(times):
            for topic, log_ns, content in repetition(reader, shift(period, number)):
                writer.write(topic, log_ns, content)
        writer.finish()
    return times * period.host_ns / NS_PER_S


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description="Repeat a flight log with all clocks running on.")
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--times", type=int, required=True, help="how often the flight is flown")
    arguments = parser.parse_args()
    seconds = write_long_log(arguments.source, arguments.target, arguments.times)
    print(f"{arguments.target}: {seconds:.3f} s, {arguments.target.stat().st_size * 1e-6:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
