"""What networks and captures do to packets: given twice, swapped, of strangers, on other ports, cut, in fragments, behind other links."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dpkt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightlog import hdl32e, records
from flightlog.logfile import LogReader
from groundproc.cli import main
from groundproc.flight.importers.fragments import Fragments
from groundproc.flight.importers.pcap import Packet
from groundproc.flight.importers.udp import LINK_NAMES, Datagram, DatagramCount, datagrams
from groundproc.sensors.sequence import sequenced

START_NS = 1_700_000_000_000_000_000
Frames = list[tuple[int, bytes]]
Make = Callable[..., bytes]


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    """Exit code of `swath import`, and what it says on stderr."""
    code = main(["import", *map(str, words)])
    return code, capsys.readouterr().err


def payloads(path: Path) -> list[bytes]:
    """The data packets of a log."""
    with LogReader(path) as reader:
        return [
            bytes(data)
            for message in reader.messages((records.LIDAR.topic,))
            for data in records.decode_scan(message.data)["data"]
        ]


def counters(path: Path) -> dict[str, Any]:
    with LogReader(path) as reader:
        return dict(json.loads(reader.metadata["swath.session"]["counters"]))


def info(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["info", str(path)]) in (0, 3)
    return capsys.readouterr().out


def lidar_of(path: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert main(["info", "--json", str(path)]) in (0, 3)
    return dict(json.loads(capsys.readouterr().out)["lidar"])


# the small inputs that failed once --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "packets", "says"),
    [
        ("duplicate", 3, "2 packets of the lidar were there twice"),
        ("reordered", 40, "packets or frames were out of order"),
        ("sll2_vlan", 3, ""),
        ("stray_sensor_first", 3, "192.168.1.201 with 3, 192.168.1.77 with 1"),
    ],
)
def test_small_captures_that_failed_once_give_their_packets(
    name: str, packets: int, says: str, cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "l.mcap"
    code, said = run(capsys, "--pcap", cases / f"{name}.pcap", "-o", log)
    assert code == 0
    assert says in said
    assert len(payloads(log)) == len(set(payloads(log))) == packets
    stamps = [struct.unpack_from("<I", payload, 1200)[0] for payload in payloads(log)]
    assert stamps == sorted(stamps)
    lidar = lidar_of(log, capsys)
    assert (lidar["packets"], lidar["lost_packets"], lidar["out_of_order"]) == (packets, 0, 0)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("data_port_2369", "--lidar-port 2369"),
        ("both_ports", "--lidar-port 2369 --position-port 8309"),
        ("snap60", "cut when they were captured, to 60 bytes or less (snap length)"),
        ("ppp", "link type 9 (PPP)"),
    ],
)
def test_small_captures_that_cannot_be_taken_are_refused_with_the_reason(
    name: str, says: str, cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = run(capsys, "--pcap", cases / f"{name}.pcap", "-o", tmp_path / "l.mcap")
    assert (code, said.count("\n")) == (1, 1)
    assert says in said
    assert not list(tmp_path.iterdir())


# given twice, and out of order ------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 40), min_size=1, max_size=60), st.integers(0, hdl32e.STAMP_WRAP_US - 1))
def test_packets_in_any_order_and_number_come_out_sorted_and_once(numbers: list[int], start_us: int) -> None:
    stamps = (np.array(numbers) * 553 + start_us) % hdl32e.STAMP_WRAP_US
    packets = np.array(numbers, "<u2")[:, None].view(np.uint8).reshape(-1, 2)
    found = sequenced(stamps.astype(np.uint32), packets)
    assert [numbers[i] for i in found.kept] == sorted(set(numbers))
    assert found.duplicates == len(numbers) - len(set(numbers))
    first = [number for i, number in enumerate(numbers) if number not in numbers[:i]]
    assert found.moved == sum(number < max(first[:i], default=-1) for i, number in enumerate(first))


def test_packets_of_one_stamp_and_other_content_are_two() -> None:
    found = sequenced(np.array([7, 7, 7], np.uint32), np.array([[1], [2], [1]], np.uint8))
    assert (found.kept.tolist(), found.duplicates, found.moved) == ([0, 1], 1, 0)


def test_what_lies_before_and_behind_a_step_of_the_clock_is_not_mixed() -> None:
    stamps = np.array([900_000_000, 900_000_553, 1_000, 447, 1_553], np.uint32)
    found = sequenced(stamps, np.arange(5, dtype=np.uint8)[:, None])
    assert (found.kept.tolist(), found.duplicates, found.moved) == ([0, 1, 3, 2, 4], 0, 1)


@pytest.mark.parametrize("apart", [1, 7, 30])
def test_swapped_packets_are_put_in_order_over_the_edges_of_messages_too(
    apart: int,
    turning: Callable[..., Frames],
    ethernet: Make,
    pcap: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    packets = turning(1.0, start_us=3_599_500_000)  # over the hour
    order = list(range(len(packets)))
    for i in range(0, len(order) - apart, 2 * apart + 1):
        order[i], order[i + apart] = order[i + apart], order[i]
    stamped = [(START_NS + packets[i][0] - packets[0][0], ethernet(packets[j][1])) for i, j in enumerate(order)]
    capture, log = tmp_path / "s.pcap", tmp_path / "s.mcap"
    capture.write_bytes(pcap(stamped))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert code == 0
    assert payloads(log) == [payload for _, payload in packets]
    late = sum(number < max(order[:i], default=-1) for i, number in enumerate(order))
    assert f"{late} packets or frames were out of order" in said
    assert counters(log)["reordered"] == late
    lidar = lidar_of(log, capsys)
    assert (lidar["lost_packets"], lidar["out_of_order"]) == (0, 0)
    assert f"{late} packets put in order" in info(log, capsys)


def test_two_captures_of_the_same_packets_give_each_once(
    turning: Callable[..., Frames],
    position_payload: Make,
    ethernet: Make,
    pcap: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    packets = turning(0.5)
    stamped = [(START_NS + t, ethernet(payload)) for t, payload in packets]
    stamped += [(START_NS + t + 1000, ethernet(position_payload(t // 1000), 8308)) for t, _ in packets[::9]]
    stamped.sort()
    first, second, log = tmp_path / "1.pcap", tmp_path / "2.pcap", tmp_path / "l.mcap"
    first.write_bytes(pcap(stamped[:700]))
    second.write_bytes(pcap([(t + 300_000, frame) for t, frame in stamped[300:]]))
    code, said = run(capsys, "--pcap", second, first, "-o", log)
    assert code == 0
    assert "400 packets of the lidar were there twice" in said
    assert payloads(log) == [payload for _, payload in packets]
    count = counters(log)
    assert (count["duplicates"], count["reordered"]) == (400, 0)
    assert count["lidar"]["received"] == count["lidar"]["kept"] == len(packets)
    assert (count["position_received"], count["position_rejected"]) == (len(packets[::9]), 0)
    assert "400 duplicates left out" in info(log, capsys)


# senders ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strays", [1, 100, 400])
def test_a_stray_sensor_that_speaks_first_does_not_win(
    strays: int,
    turning: Callable[..., Frames],
    ethernet: Make,
    pcap: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    packets = turning(0.6)
    stray = [(START_NS - 2_000_000_000 + t, ethernet(p, sender=b"\x0a\x00\x00\x09")) for t, p in turning(0.3)[:strays]]
    capture, log = tmp_path / "s.pcap", tmp_path / "s.mcap"
    capture.write_bytes(pcap(stray + [(START_NS + t, ethernet(p)) for t, p in packets]))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert code == 0
    assert payloads(log) == [payload for _, payload in packets]
    assert f"192.168.1.201 with {len(packets)}, 10.0.0.9 with {strays}" in said
    text = info(log, capsys)
    assert f"192.168.1.201 with {len(packets)}, 10.0.0.9 with {strays}" in text
    assert run(capsys, "--pcap", capture, "--sender", "10.0.0.9", "-o", log, "--force")[0] == 0
    assert len(payloads(log)) == strays


@pytest.mark.parametrize("product", [b"\x22", b"\x28"])
def test_a_stray_sensor_of_another_model_does_not_win_either(
    product: bytes,
    turning: Callable[..., Frames],
    ethernet: Make,
    pcap: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    packets, strays = turning(0.6), turning(0.1)
    stray = [(START_NS - 2_000_000_000 + t, ethernet(p[:-1] + product, sender=b"\x0a\x00\x00\x09")) for t, p in strays]
    capture, log = tmp_path / "s.pcap", tmp_path / "s.mcap"
    capture.write_bytes(pcap(stray + [(START_NS + t, ethernet(p)) for t, p in packets]))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert code == 0
    assert f"10.0.0.9 with {len(strays)}" in said
    assert payloads(log) == [payload for _, payload in packets]
    assert lidar_of(log, capsys)["model"] == "HDL-32E"


# ports ------------------------------------------------------------------------------------------------------------------


def test_gyros_on_another_port_are_not_left_behind_without_a_word(
    turning: Callable[..., Frames],
    position_payload: Make,
    ethernet: Make,
    pcap: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stamped = [(START_NS + t, ethernet(payload)) for t, payload in turning(0.1)]
    stamped += [(START_NS + i * 5_000_000, ethernet(position_payload(i * 5000), 8309)) for i in range(20)]
    capture, log = tmp_path / "p.pcap", tmp_path / "p.mcap"
    capture.write_bytes(pcap(sorted(stamped)))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert (code, said.count("\n"), log.exists()) == (1, 1, False)
    assert "20 position packets (gyros, GPS) went to UDP port 8309" in said
    assert "give --position-port 8309 (or --position-port 8308 to leave them out)" in said
    assert run(capsys, "--pcap", capture, "-o", log, "--position-port", 8309) == (0, "")
    assert counters(log)["position_received"] == 20
    code, said = run(capsys, "--pcap", capture, "-o", log, "--position-port", 8308, "--force")
    assert code == 0
    assert "20 position packets of a lidar to UDP port 8309 left out" in said


def test_a_stray_packet_on_the_usual_port_does_not_hide_the_lidar_on_another(
    turning: Callable[..., Frames], ethernet: Make, pcap: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    packets = turning(0.1)
    stamped = [(START_NS + t, ethernet(payload, 2368 if i == 5 else 2369)) for i, (t, payload) in enumerate(packets)]
    capture, log = tmp_path / "p.pcap", tmp_path / "p.mcap"
    capture.write_bytes(pcap(stamped))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert code == 1
    assert "give --lidar-port 2369" in said
    assert run(capsys, "--pcap", capture, "--lidar-port", 2369, "-o", log)[0] == 0
    assert len(payloads(log)) == len(packets) - 1


# link layers, IPv6, fragments, snap length ------------------------------------------------------------------------------

LAYERS: dict[str, tuple[int, Callable[[bytes, int], bytes]]] = {
    "Ethernet": (1, lambda ip, kind: bytes(12) + struct.pack(">H", kind) + ip),
    "Ethernet, VLAN": (1, lambda ip, kind: bytes(12) + struct.pack(">HHH", 0x8100, 5, kind) + ip),
    "Ethernet, QinQ": (1, lambda ip, kind: bytes(12) + struct.pack(">HHHHH", 0x88A8, 5, 0x8100, 7, kind) + ip),
    "cooked": (113, lambda ip, kind: struct.pack(">HHH8sH", 0, 1, 6, bytes(8), kind) + ip),
    "cooked, VLAN": (113, lambda ip, kind: struct.pack(">HHH8sHHH", 0, 1, 6, bytes(8), 0x8100, 5, kind) + ip),
    "cooked 2": (276, lambda ip, kind: struct.pack(">HHIHBB8s", kind, 0, 2, 1, 0, 6, bytes(8)) + ip),
    "cooked 2, QinQ": (
        276,
        lambda ip, kind: (
            struct.pack(">HHIHBB8s", 0x88A8, 0, 2, 1, 0, 6, bytes(8)) + struct.pack(">HHHH", 5, 0x8100, 7, kind) + ip
        ),
    ),
    "raw": (101, lambda ip, kind: ip),
    "loopback": (0, lambda ip, kind: struct.pack("<I", 2 if kind == 0x0800 else 30) + ip),
}


def ipv4(udp: bytes) -> bytes:
    packet = dpkt.ip.IP(src=b"\xc0\xa8\x01\xc9", dst=b"\xff" * 4, p=17, data=udp)
    packet.len = len(packet)
    return bytes(packet)


def ipv6(udp: bytes, extensions: bytes = b"", first: int = 17) -> bytes:
    sender = bytes.fromhex("fe80000000000000627688fffe2011a2")
    head = struct.pack(">IHBB", 0x60000000, len(extensions) + len(udp), first, 64)
    return head + sender + bytes.fromhex("ff020000000000000000000000000001") + extensions + udp


def udp_of(payload: bytes, port: int = 2368) -> bytes:
    return struct.pack(">4H", 443, port, 8 + len(payload), 0) + payload


def found_in(packets: list[tuple[int, bytes]]) -> tuple[list[Datagram], DatagramCount]:
    """Datagrams of (link type, frame)."""
    count = DatagramCount()
    return list(datagrams((Packet(i, link, data, False) for i, (link, data) in enumerate(packets)), count)), count


@pytest.mark.parametrize("layer", list(LAYERS))
@pytest.mark.parametrize("version", [4, 6])
def test_a_datagram_is_found_behind_every_link_and_in_both_versions_of_ip(layer: str, version: int) -> None:
    link, wrap = LAYERS[layer]
    frame = wrap((ipv4 if version == 4 else ipv6)(udp_of(b"payload")), 0x0800 if version == 4 else 0x86DD)
    found, count = found_in([(link, frame)])
    assert [(each.port, each.source_port, each.payload) for each in found] == [(2368, 443, b"payload")]
    assert len(found[0].sender) == (4 if version == 4 else 16)
    assert (count.datagrams, count.other, count.cut) == (1, 0, 0)


def test_extension_headers_of_ipv6_are_stepped_over() -> None:
    hop_by_hop = struct.pack(">BB6x", 60, 0)
    options = struct.pack(">BB14x", 44, 1)
    whole = struct.pack(">BBHI", 17, 0, 0, 99)  # a fragment header of a datagram in one piece
    found, _ = found_in([(101, ipv6(udp_of(b"x"), hop_by_hop + options + whole, first=0))])
    assert [each.payload for each in found] == [b"x"]


def pieces_of(version: int, payload: bytes, size: int, number: int) -> list[bytes]:
    """A datagram in fragments."""
    udp = udp_of(payload)
    found = []
    for place in range(0, len(udp), size):
        more = place + size < len(udp)
        if version == 4:
            ip = struct.pack(
                ">BBHHHBBH", 0x45, 0, 20 + len(udp[place : place + size]), number, more << 13 | place // 8, 64, 17, 0
            )
            found.append(ip + b"\xc0\xa8\x01\xc9" + b"\xff" * 4 + udp[place : place + size])
        else:
            head = struct.pack(">BBHI", 17, 0, place | more, number)
            found.append(ipv6(udp[place : place + size], head, first=44))
    return found


@pytest.mark.parametrize("version", [4, 6])
@pytest.mark.parametrize("turn", [0, 1, 2])
def test_fragments_in_any_order_become_their_datagram(version: int, turn: int) -> None:
    payloads = [bytes([i]) * 1206 for i in range(3)]
    mixed = [piece for i, payload in enumerate(payloads) for piece in pieces_of(version, payload, 496, i)]
    if turn:
        mixed = mixed[::-1] if turn == 1 else [mixed[(i * 4) % len(mixed)] for i in range(len(mixed))] + [mixed[0]]
    if turn == 2:  # every fourth, over and over: all nine, and the first once more
        mixed = [mixed[i] for i in np.argsort([(i * 4) % 9 for i in range(9)])]
    found, count = found_in([(101, piece) for piece in mixed])
    assert sorted(each.payload for each in found) == payloads
    assert (count.reassembled, count.fragments, count.datagrams) == (3, 0, 3)


def test_fragments_without_their_others_and_those_that_overlap_are_counted_not_guessed() -> None:
    first, _, third = pieces_of(4, bytes(1206), 496, 1)
    found, count = found_in([(101, first), (101, third)])
    assert (found, count.fragments) == ([], 2)
    parts = Fragments()
    key = (b"\x00\x01", b"")
    assert parts.add(key, 0, bytes(16), more=True) is None
    assert parts.add(key, 0, bytes(16), more=True) is None  # captured twice
    assert parts.add(key, 8, bytes(16), more=False) is None
    assert (parts.whole, parts.waiting, parts.left_out) == (0, 0, 2)
    for number in range(1000):  # no list of what waits grows without end
        parts.add((number.to_bytes(2, "big"), b""), 0, bytes(8), more=True)
    assert parts.waiting <= 64
    assert parts.waiting + parts.left_out == 1002


def test_fragmented_packets_of_a_lidar_reach_the_log(
    turning: Callable[..., Frames], pcap: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    packets = turning(0.05)
    stamped = [
        (START_NS + t, bytes(12) + b"\x08\x00" + piece)
        for i, (t, payload) in enumerate(packets)
        for piece in pieces_of(4, payload, 552, i)
    ]
    capture, log = tmp_path / "f.pcap", tmp_path / "f.mcap"
    capture.write_bytes(pcap(stamped))
    assert run(capsys, "--pcap", capture, "-o", log) == (0, "")
    assert payloads(log) == [payload for _, payload in packets]


def test_a_lidar_that_speaks_ipv6_is_recorded_with_its_address(
    turning: Callable[..., Frames], pcap: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    packets = turning(0.05)
    capture, log = tmp_path / "6.pcap", tmp_path / "6.mcap"
    capture.write_bytes(pcap([(START_NS + t, bytes(12) + b"\x86\xdd" + ipv6(udp_of(p))) for t, p in packets]))
    assert run(capsys, "--pcap", capture, "-o", log) == (0, "")
    assert payloads(log) == [payload for _, payload in packets]
    assert counters(log)["senders"] == {"fe80::6276:88ff:fe20:11a2": len(packets)}


@pytest.mark.parametrize("link", [9, 50, 105, 127, 189, 4242])
def test_a_link_layer_that_is_not_read_is_refused_by_name(
    link: int, pcap: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = tmp_path / "r.pcap"
    capture.write_bytes(pcap([(START_NS, bytes(100))] * 3, link=link))
    code, said = run(capsys, "--pcap", capture, "-o", tmp_path / "l.mcap")
    assert (code, said.count("\n")) == (1, 1)
    assert f"3 packets of link type {link} ({LINK_NAMES.get(link, 'not known here')})" in said


@pytest.mark.parametrize("snap", [20, 34, 60, 96, 1000])
def test_a_snap_length_too_short_is_said_as_that(
    snap: int,
    turning: Callable[..., Frames],
    position_payload: Make,
    ethernet: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    frames = [ethernet(payload) for _, payload in turning(0.05)] + [ethernet(position_payload(100), 8308)]
    content = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, snap, 1)
    for i, frame in enumerate(frames):
        content += struct.pack("<4I", 1_700_000_000, i * 500, min(snap, len(frame)), len(frame)) + frame[:snap]
    capture = tmp_path / "s.pcap"
    capture.write_bytes(content)
    code, said = run(capsys, "--pcap", capture, "-o", tmp_path / "l.mcap")
    assert (code, said.count("\n")) == (1, 1)
    assert f"to {snap} bytes or less (snap length)" in said


def test_captures_split_by_wireshark_are_joined_by_time_not_by_name(
    turning: Callable[..., Frames], ethernet: Make, pcap: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    packets = turning(1.2)
    names = ["c_00010", "c_00002", "c_00001", "c_00100"]
    size = -(-len(packets) // len(names))
    paths = []
    for i, name in enumerate(names):
        path = tmp_path / f"{name}.pcap"
        path.write_bytes(pcap([(START_NS + t, ethernet(p)) for t, p in packets[i * size : (i + 1) * size]]))
        paths.append(path)
    assert run(capsys, "--pcap", *sorted(paths), "-o", tmp_path / "l.mcap") == (0, "")
    assert payloads(tmp_path / "l.mcap") == [payload for _, payload in packets]
