import io
import struct
from collections.abc import Callable
from pathlib import Path

import dpkt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightlog.errors import CaptureError
from groundproc.flight.importers.pcap import CaptureCount, Packet, packets
from groundproc.flight.importers.udp import Datagram, DatagramCount, datagrams

TIMES_NS = [1_700_000_000_123_456_000 + i * 553_000 for i in range(5)]


def read(content: bytes) -> tuple[list[Packet], CaptureCount]:
    count = CaptureCount()
    return list(packets(io.BytesIO(content), count, "x.pcap")), count


def read_udp(content: bytes) -> tuple[list[Datagram], DatagramCount]:
    count = DatagramCount()
    return list(datagrams(read(content)[0], count)), count


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("nano", [False, True])
def test_both_byte_orders_and_resolutions_say_the_same(
    pcap: Callable[..., bytes], ethernet: Callable[..., bytes], order: str, nano: bool
) -> None:
    frames = [(time_ns, ethernet(bytes([i]) * 100)) for i, time_ns in enumerate(TIMES_NS)]
    found, count = read(pcap(frames, order=order, nano=nano))
    assert [(packet.time_ns, packet.data) for packet in found] == frames
    assert (count.packets, count.lost_bytes, count.damage) == (5, 0, "")


def link_layers(frame: bytes) -> dict[str, tuple[int, bytes]]:
    """The IP packet of an Ethernet frame behind other link layers (tcpdump.org/linktypes)."""
    ip = frame[14:]
    macs = frame[:12]
    return {
        "Ethernet": (1, frame),
        "VLAN": (1, macs + b"\x81\x00\x00\x05\x08\x00" + ip),
        "two VLAN tags": (1, macs + b"\x88\xa8\x00\x05\x81\x00\x00\x07\x08\x00" + ip),
        "raw": (101, ip),
        "raw IPv4": (228, ip),
        "BSD loopback": (0, b"\x02\x00\x00\x00" + ip),
        "Linux cooked": (113, struct.pack(">HHH8sH", 0, 1, 6, bytes(8), 0x0800) + ip),
        "Linux cooked 2": (276, struct.pack(">HHIHBB8s", 0x0800, 0, 2, 1, 0, 6, bytes(8)) + ip),
        "with a frame check sequence": (1 | 0x24000000, frame + b"\xde\xad\xbe\xef"),
        "padded": (1, frame + bytes(20)),
    }


@pytest.mark.parametrize("name", list(link_layers(bytes(60))))
def test_the_datagram_is_found_behind_every_link_layer(
    name: str, pcap: Callable[..., bytes], ethernet: Callable[..., bytes]
) -> None:
    link, frame = link_layers(ethernet(b"payload", 8308))[name]
    found, count = read_udp(pcap([(TIMES_NS[0], frame)], link=link))
    assert found == [Datagram(TIMES_NS[0], b"\xc0\xa8\x01\xc9", 8308, b"payload", 443)]
    assert (count.datagrams, count.other) == (1, 0)


def test_what_is_no_udp_over_ipv4_is_counted(pcap: Callable[..., bytes], ethernet: Callable[..., bytes]) -> None:
    frame = ethernet(b"x" * 50)
    arp = frame[:12] + b"\x08\x06" + bytes(28)
    ipv6 = frame[:12] + b"\x86\xdd" + bytes(60)
    tcp = frame[:23] + b"\x06" + frame[24:]
    pieces = [ethernet(b"x" * 50, flags=0x2000), ethernet(b"x" * 50, flags=0x0001)]
    found, count = read_udp(pcap([(0, f) for f in [arp, ipv6, tcp, frame[:20], b"", *pieces, frame, frame[:60]]]))
    assert len(found) == 1
    assert (count.other, count.fragments, count.cut) == (5, 2, 1)


def test_an_unknown_link_layer_is_counted_not_guessed(
    pcap: Callable[..., bytes], ethernet: Callable[..., bytes]
) -> None:
    found, count = read_udp(pcap([(0, ethernet(b"x"))], link=105))
    assert (found, count.other, count.links) == ([], 0, {105: 1})


def test_a_pcapng_of_another_writer_reads_as_it_reads_itself(ethernet: Callable[..., bytes]) -> None:
    stream = io.BytesIO()
    writer = dpkt.pcapng.Writer(stream)
    for i, time_ns in enumerate(TIMES_NS):
        writer.writepkt(ethernet(bytes([i]) * (40 + i)), ts=time_ns / 1e9)
    found, _ = read(stream.getvalue())
    theirs = list(dpkt.pcapng.Reader(io.BytesIO(stream.getvalue())))
    assert [packet.data for packet in found] == [data for _, data in theirs]
    assert [packet.time_ns / 1e9 for packet in found] == pytest.approx([time for time, _ in theirs], abs=1e-6)


def block(kind: int, body: bytes, order: str = "<") -> bytes:
    body += bytes(-len(body) % 4)
    return struct.pack(order + "II", kind, 12 + len(body)) + body + struct.pack(order + "I", 12 + len(body))


def section(order: str = "<") -> bytes:
    return block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)


def interface(order: str = "<", *, resolution: int | None = None, offset_s: int = 0, link: int = 1) -> bytes:
    options = b""
    if resolution is not None:
        options += struct.pack(order + "HHB3x", 9, 1, resolution)
    if offset_s:
        options += struct.pack(order + "HHq", 14, 8, offset_s)
    return block(1, struct.pack(order + "HHI", link, 0, 0) + options + bytes(4), order)


def enhanced(number: int, ticks: int, data: bytes, order: str = "<") -> bytes:
    head = struct.pack(order + "5I", number, ticks >> 32, ticks & 0xFFFFFFFF, len(data), len(data))
    return block(6, head + data, order)


def simple(data: bytes, order: str = "<") -> bytes:
    return block(3, struct.pack(order + "I", len(data)) + data, order)


@pytest.mark.parametrize("order", ["<", ">"])
def test_each_interface_of_a_pcapng_has_its_own_clock(order: str) -> None:
    content = (
        section(order)
        + interface(order)
        + interface(order, resolution=9)
        + interface(order, resolution=0x80 | 20, offset_s=1_700_000_000, link=101)
        + enhanced(0, 1_700_000_000_000_001, b"us", order)
        + enhanced(1, 1_700_000_000_000_002_003, b"ns", order)
        + enhanced(2, 3 << 19, b"2^-20", order)
        + block(5, bytes(12), order)  # interface statistics: stepped over
        + section("<")
        + interface("<", resolution=3)
        + enhanced(0, 1_700_000_002_000, b"ms")
    )
    found, count = read(content)
    assert [(p.time_ns, p.link, p.data) for p in found] == [
        (1_700_000_000_000_001_000, 1, b"us"),
        (1_700_000_000_000_002_003, 1, b"ns"),
        (1_700_000_001_500_000_000, 101, b"2^-20"),
        (1_700_000_002_000_000_000, 1, b"ms"),
    ]
    assert count.damage == ""


def test_a_simple_packet_takes_the_time_of_the_packet_before() -> None:
    head = section() + interface()
    found, count = read(head + simple(b"first") + enhanced(0, 7, b"timed") + simple(b"after"))
    assert [(p.time_ns, p.data) for p in found] == [(7000, b"timed"), (7000, b"after")]
    assert (count.untimed, count.borrowed_times) == (1, 1)


def test_a_capture_without_any_times_is_refused() -> None:
    with pytest.raises(CaptureError, match="no times"):
        read(section() + interface() + simple(b"data"))


@pytest.mark.parametrize(
    ("content", "what"), [(b"", "is empty"), (b"# Recordings\n", "is no pcap"), (b"\x00", "is no pcap")]
)
def test_other_files_are_refused_by_name(content: bytes, what: str) -> None:
    with pytest.raises(CaptureError, match=f"^x.pcap: {what}"):
        read(content)


def test_what_is_whole_is_kept_wherever_a_capture_is_cut(
    pcap: Callable[..., bytes], ethernet: Callable[..., bytes]
) -> None:
    frames = [ethernet(bytes([i]) * 30) for i in range(4)]
    classic = [pcap([]), *(pcap([(i, frame)])[24:] for i, frame in enumerate(frames))]
    ng = [section(), interface(), *(enhanced(0, i, frame) for i, frame in enumerate(frames))]
    for parts in (classic, ng):
        content = b"".join(parts)
        ends = [sum(map(len, parts[: i + 1])) for i in range(len(parts))]
        whole, _ = read(content)
        assert len(whole) == 4
        for size in range(4, len(content)):
            found, count = read(content[:size])
            assert found == whole[: sum(end <= size for end in ends[-4:])]
            assert count.lost_bytes == size - max((end for end in ends if end <= size), default=0)
            assert bool(count.damage) == (size not in ends)


@given(st.binary(max_size=400), st.sampled_from([b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d", section() + interface()]))
def test_any_bytes_give_packets_or_a_named_error(noise: bytes, head: bytes) -> None:
    count, seen = DatagramCount(), CaptureCount()
    try:
        found = list(datagrams(packets(io.BytesIO(head + noise), seen, "x"), count))
    except CaptureError:
        return
    assert len(found) == count.datagrams <= seen.packets


@given(st.data())
def test_a_flipped_byte_never_breaks_the_reader(data: st.DataObject) -> None:
    frame = bytes(range(60))
    content = bytearray(section() + interface(resolution=9) + 3 * enhanced(0, 5, frame))
    content[data.draw(st.integers(4, len(content) - 1))] = data.draw(st.integers(0, 255))
    count = CaptureCount()
    try:
        list(packets(io.BytesIO(bytes(content)), count, "x"))
    except CaptureError:
        return


def test_the_recorded_capture_reads_as_another_reader_reads_it(recordings: Path) -> None:
    path = recordings / "lidar/hdl32e_monterey.pcap"
    ours, count = read_udp(path.read_bytes())
    with path.open("rb") as file:
        theirs = [(time, dpkt.ethernet.Ethernet(frame).data.data) for time, frame in dpkt.pcap.Reader(file)]
    assert [(d.port, d.payload) for d in ours] == [(udp.dport, udp.data) for _, udp in theirs]
    assert [d.time_ns / 1e9 for d in ours] == pytest.approx([float(time) for time, _ in theirs], abs=1e-6)
    ports = [datagram.port for datagram in ours]
    assert (ports.count(2368), ports.count(8308)) == (2702, 299)
    assert (count.other, count.cut, count.fragments) == (0, 0, 0)
