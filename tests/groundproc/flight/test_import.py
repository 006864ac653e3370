import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import dpkt
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from flightlog import records
from flightlog.logfile import LogReader
from groundproc.cli import main
from groundproc.flight.lidar import lidar_of

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def small(
    tmp_path: Path,
    turning: Callable[..., list[tuple[int, bytes]]],
    position_payload: Callable[..., bytes],
    ethernet: Callable[..., bytes],
    pcap: Callable[..., bytes],
) -> Path:
    """A capture of two data packets with a position packet between."""
    data = [ethernet(payload) for _, payload in turning(0.0012)]
    assert len(data) == 2
    position = ethernet(position_payload(300), 8308)
    path = tmp_path / "small.pcap"
    path.write_bytes(pcap([(START_NS, data[0]), (START_NS + 300_000, position), (START_NS + 553_000, data[1])]))
    return path


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    """Exit code of `swath import`, and what it says on stderr."""
    code = main(["import", *map(str, words)])
    return code, capsys.readouterr().err


def chunks(path: Path, topic: str) -> list[tuple[int, bytes]]:
    """All chunks or lidar packets of a topic."""
    found: list[tuple[int, bytes]] = []
    with LogReader(path) as reader:
        for message in reader.messages((topic,)):
            if topic == records.LIDAR.topic:
                packets = records.decode_scan(message.data)
                found += zip(records.receive_time_ns(packets).tolist(), map(bytes, packets["data"]), strict=True)
            else:
                found += records.decode_raw(message.data)
    return found


def test_every_packet_of_a_capture_reaches_the_log_with_its_time(monterey_log: Path, recordings: Path) -> None:
    with (recordings / "lidar/hdl32e_monterey.pcap").open("rb") as file:
        theirs = [(round(t * 1_000_000) * 1000, dpkt.ethernet.Ethernet(f).data.data) for t, f in dpkt.pcap.Reader(file)]
    for topic, port, count in ((records.LIDAR.topic, 2368, 2702), (records.POSITION.topic, 8308, 299)):
        ours = chunks(monterey_log, topic)
        assert len(ours) == count
        assert ours == [(time_ns, udp.data) for time_ns, udp in theirs if udp.dport == port]


def test_other_readers_find_the_packets_as_ros_messages_in_batches_of_a_tenth_of_a_second(monterey_log: Path) -> None:
    with monterey_log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        scans = [scan for _, _, _, scan in reader.iter_decoded_messages(topics=["/velodyne_packets"])]
        file.seek(0)
        accounts = [account for _, _, _, account in reader.iter_decoded_messages(topics=["/lidar_account"])]
    assert [len(scan.packets) for scan in scans] == [account.kept for account in accounts]
    assert sum(len(scan.packets) for scan in scans) == 2702
    assert all(170 <= len(scan.packets) <= 182 for scan in scans[:-1])


def test_messages_of_all_sources_are_in_the_order_of_log_time(
    small: Path, recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "a.mcap"
    # the simulated autopilot's recording, and the small capture put into the middle of it
    tlog = recordings / "mavlink/arducopter313_sim.tlog"
    content = tlog.read_bytes()
    shift_us = START_NS // 1000 - int.from_bytes(content[:8], "big") - 20_000_000
    moved, offset = bytearray(content), 0
    while offset < len(moved):
        stamp = int.from_bytes(moved[offset : offset + 8], "big") + shift_us
        moved[offset : offset + 8] = stamp.to_bytes(8, "big")
        offset += 8 + moved[offset + 9] + 8
    shifted = tmp_path / "moved.bin"  # the name says nothing
    shifted.write_bytes(moved)
    code, said = run(capsys, "--pcap", small, "--mavlink", shifted, "-o", log)
    assert (code, said) == (0, "")
    with LogReader(log) as reader:
        times = [(message.log_time_ns, message.topic) for message in reader.messages()]
    assert [time_ns for time_ns, _ in times] == sorted(time_ns for time_ns, _ in times)
    place = [topic for _, topic in times].index("/velodyne_packets")
    assert 0 < place < len(times) - 10


def test_the_log_says_what_it_was_made_of(monterey_log: Path, recordings: Path) -> None:
    with LogReader(monterey_log) as reader:
        session = reader.metadata["swath.session"]
    sources = json.loads(session["sources"])
    assert [source["kind"] for source in sources] == ["capture", "tlog"]
    for source, name in zip(sources, ["lidar/hdl32e_monterey.pcap", "mavlink/copter_flight_2015.tlog"], strict=True):
        content = (recordings / name).read_bytes()
        assert source["name"] == Path(name).name
        assert source["sha256"] == hashlib.sha256(content).hexdigest()
        assert source["bytes"] == len(content)
    assert sources[1]["counters"]["frames"] == 75_477
    assert json.loads(session["counters"])["lidar"]["kept"] == 2702


def test_captures_are_joined_in_the_order_of_time(
    recordings: Path, monterey_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = (recordings / "lidar/hdl32e_monterey.pcap").read_bytes()
    cuts, offset = [24], 24
    while offset < len(content):
        offset += 16 + int.from_bytes(content[offset + 8 : offset + 12], "little")
        cuts.append(offset)
    edges = [cuts[0], cuts[1000], cuts[2000], cuts[-1]]
    parts = []
    for i in range(3):
        parts.append(tmp_path / f"{i}.pcap")
        parts[i].write_bytes(content[:24] + content[edges[i] : edges[i + 1]])
    log = tmp_path / "joined.mcap"
    assert run(capsys, "--pcap", parts[1], parts[0], "--pcap", parts[2], "-o", log) == (0, "")
    for topic in (records.LIDAR.topic, records.POSITION.topic):
        assert chunks(log, topic) == chunks(monterey_log, topic)


# at every byte that is two thousand imports; bytes within one packet are alike, and the edges are in both
@pytest.mark.parametrize("step", [13, pytest.param(1, marks=pytest.mark.soak)])
def test_a_capture_cut_at_any_byte_gives_a_log_of_what_is_whole_or_one_sentence(
    step: int, small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = small.read_bytes()
    cut, log = tmp_path / "cut.pcap", tmp_path / "cut.mcap"
    ends = [24, 24 + 16 + 1248, 24 + 32 + 1248 + 554]
    edges = {end + off for end in (*ends, len(content)) for off in (-17, -16, -1, 0, 1, 15, 16, 17)}
    for size in sorted({*range(0, len(content), step), *range(41), *edges} & {*range(len(content))}):
        cut.write_bytes(content[:size])
        code, said = run(capsys, "--pcap", cut, "-o", log, "--force")
        whole = sum(end <= size for end in ends[1:])
        assert code == (0 if whole else 1), said
        assert log.exists() == bool(whole)
        assert said.count("\n") == (size not in ends[1:]), said
        assert said == "" or str(cut) in said
        assert {path.name for path in tmp_path.iterdir()} <= {"small.pcap", "cut.pcap", "cut.mcap"}
        if whole and size in (*ends, len(content) - 1):
            assert len(chunks(log, records.LIDAR.topic)) == 1
            assert len(chunks(log, records.POSITION.topic)) == whole - 1


@pytest.mark.parametrize("product", [b"\x22", b"\x21"])
def test_a_vlp16_is_imported_as_one_even_where_it_calls_itself_an_hdl32e(
    product: bytes, recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = (recordings / "lidar/vlp16_gps.pcap").read_bytes()
    capture = tmp_path / "v.pcap"
    capture.write_bytes(content.replace(b"\x37\x22", b"\x37" + product))
    code, _ = run(capsys, "--pcap", capture, "-o", tmp_path / "v.mcap")
    assert code == 0
    with LogReader(tmp_path / "v.mcap") as reader:
        assert reader.metadata["swath.session"]["lidar"] == "VLP-16"
        assert lidar_of([reader]).name == "VLP-16"


def test_another_sensor_is_refused_by_name(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = tmp_path / "v.pcap"
    capture.write_bytes((recordings / "lidar/vlp16_gps.pcap").read_bytes().replace(b"\x37\x22", b"\x37\x28"))
    code, said = run(capsys, "--pcap", capture, "-o", tmp_path / "v.mcap")
    assert code == 1
    assert "is a VLP-32C" in said
    assert "HDL-32E" in said
    assert "VLP-16" in said
    assert list(tmp_path.iterdir()) == [capture]


def test_captures_of_two_models_are_not_one_flight(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    captures = [recordings / "lidar" / name for name in ("vlp16_gps.pcap", "hdl32e_monterey.pcap")]
    code, said = run(capsys, "--pcap", *captures, "-o", tmp_path / "v.mcap")
    assert code == 1
    assert "one flight has one lidar" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize("fov_deg", [None, (255.0, 105.0)])
@pytest.mark.parametrize("rpm", [300.0, 1200.0])
@pytest.mark.parametrize("kept", [1.0, 0.5])
def test_an_hdl32e_is_taken_at_any_speed_mode_and_loss(
    turning: Callable[..., list[tuple[int, bytes]]],
    ethernet: Callable[..., bytes],
    pcap: Callable[..., bytes],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    rpm: float,
    fov_deg: tuple[float, float] | None,
    dual: bool,
    kept: float,
) -> None:
    packets = turning(0.3, rpm=rpm, fov_deg=fov_deg, dual=dual)[:: round(1 / kept)]
    capture = tmp_path / "t.pcap"
    capture.write_bytes(pcap([(START_NS + time_ns, ethernet(payload)) for time_ns, payload in packets]))
    log = tmp_path / "t.mcap"
    assert run(capsys, "--pcap", capture, "-o", log) == (0, "")
    assert [payload for _, payload in chunks(log, records.LIDAR.topic)] == [payload for _, payload in packets]


def test_a_clock_that_was_set_back_is_carried_on(
    turning: Callable[..., list[tuple[int, bytes]]],
    ethernet: Callable[..., bytes],
    pcap: Callable[..., bytes],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    packets = turning(0.5)
    middle = len(packets) // 2
    step_ns = 3_000_000_000
    stamped = [(START_NS + t - (step_ns if i >= middle else 0), ethernet(p)) for i, (t, p) in enumerate(packets)]
    stamped[10], stamped[11] = stamped[11], stamped[10]
    capture, log = tmp_path / "t.pcap", tmp_path / "t.mcap"
    capture.write_bytes(pcap(stamped))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert code == 0
    assert "set back 1 times" in said
    found = chunks(log, records.LIDAR.topic)
    times = [time_ns for time_ns, _ in found]
    assert len(times) == len(packets)
    assert times == sorted(times)
    # carried on from the packet before the step, so one packet's time short
    assert times[-1] - START_NS == pytest.approx(packets[-1][0], abs=600_000)
    with LogReader(log) as reader:
        counters = json.loads(reader.metadata["swath.session"]["sources"])[0]["counters"]
    assert (counters["steps_back"], counters["out_of_order"]) == (1, 1)


def test_a_second_lidar_on_the_network_is_left_out_and_counted(
    turning: Callable[..., list[tuple[int, bytes]]],
    ethernet: Callable[..., bytes],
    pcap: Callable[..., bytes],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    frames = []
    for time_ns, payload in turning(0.25):
        frames.append((START_NS + time_ns, ethernet(payload)))
        frames.append((START_NS + time_ns + 1000, ethernet(payload[:-1] + b"\x21", sender=b"\x0a\x00\x00\x09")))
    frames.append((frames[-1][0], ethernet(b"hello")))
    capture, log = tmp_path / "two.pcap", tmp_path / "two.mcap"
    capture.write_bytes(pcap(frames))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    count = len(turning(0.25))
    assert code == 0
    assert f"{count} packets of a second sender" in said
    assert "1 packets of a wrong length" in said
    assert len(chunks(log, records.LIDAR.topic)) == count


def test_packets_on_another_port_are_pointed_out_and_can_be_taken(
    turning: Callable[..., list[tuple[int, bytes]]],
    ethernet: Callable[..., bytes],
    pcap: Callable[..., bytes],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    capture, log = tmp_path / "p.pcap", tmp_path / "p.mcap"
    capture.write_bytes(pcap([(START_NS + t, ethernet(p, 2369)) for t, p in turning(0.1)]))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert code == 1
    assert "--lidar-port 2369" in said
    assert not log.exists()
    assert run(capsys, "--pcap", capture, "-o", log, "--lidar-port", 2369) == (0, "")


def test_a_dataflash_log_is_kept_byte_for_byte(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = b"\xa3\x95\x80" + bytes(range(256)) * 1000
    flash, log = tmp_path / "named.tlog", tmp_path / "f.mcap"
    flash.write_bytes(content)
    assert run(capsys, "--pcap", small, "--mavlink", flash, "-o", log) == (0, "")
    assert b"".join(data for _, data in chunks(log, "/dataflash/ins")) == content
    with LogReader(log) as reader:
        times = [message.log_time_ns for message in reader.messages()]
        sources = json.loads(reader.metadata["swath.session"]["sources"])
    assert times == sorted(times)
    assert sources[1]["sha256"] == hashlib.sha256(content).hexdigest()


def test_a_mount_travels_with_the_log_and_a_wrong_one_is_refused(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mount, log = tmp_path / "mount.yaml", tmp_path / "m.mcap"
    mount.write_text("lidar:\n  pitch_deg: -25\n")
    assert run(capsys, "--pcap", small, "--mount", mount, "-o", log) == (0, "")
    with LogReader(log) as reader:
        assert reader.attachments["mount.yaml"] == mount.read_bytes()
    mount.write_text("lidar:\n  pich_deg: -25\n")
    code, said = run(capsys, "--pcap", small, "--mount", mount, "-o", tmp_path / "n.mcap")
    assert code == 2
    assert "pich_deg" in said
    assert not (tmp_path / "n.mcap").exists()


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("plain.mavlink", None, "without times"),
        ("empty.tlog", b"", "is empty"),
        ("text.tlog", b"lat,lon\n" * 100, "is neither a telemetry log"),
    ],
)
def test_what_is_no_autopilot_recording_is_refused(
    small: Path,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    content: bytes | None,
    sentence: str,
) -> None:
    if content is None:
        stamped = (request.getfixturevalue("recordings") / "mavlink/ardusub_2023.tlog").read_bytes()
        content, offset = b"", 0
        while len(content) < 5000:
            size = 12 + stamped[offset + 9]
            content += stamped[offset + 8 : offset + 8 + size]
            offset += 8 + size
    path = tmp_path / name
    path.write_bytes(content)
    code, said = run(capsys, "--pcap", small, "--mavlink", path, "-o", tmp_path / "x.mcap")
    assert code == 1
    assert sentence in said
    assert said.count("\n") == 1
    assert not (tmp_path / "x.mcap").exists()


def test_wrong_places_are_one_sentence_each(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, folder, file = tmp_path / "notes.txt", tmp_path / "folder", tmp_path / "file"
    text.write_text("these are no packets\n")
    folder.mkdir()
    file.write_text("")
    log = tmp_path / "l.mcap"
    for words, code, what in (
        (["--pcap", text, "-o", log], 1, "is no pcap"),
        (["--pcap", folder, "-o", log], 1, "is a folder"),
        (["--pcap", tmp_path / "none", "-o", log], 1, "no such file"),
        (["--pcap", small, small, "-o", log], 2, "given twice"),
        (["--pcap", small, "-o", small, "--force"], 2, "is an input"),
        (["--pcap", small, "-o", folder, "--force"], 2, "is a folder"),
        (["--pcap", small, "-o", file / "l.mcap"], 1, "is no folder that can be written to"),
        (["--pcap", small, "-o", "/proc/l.mcap"], 1, "is no folder that can be written to"),
        (["--pcap", small, "-o", file], 2, "expected a name that ends in .mcap"),
    ):
        got, said = run(capsys, *words)
        assert (got, said.count("\n")) == (code, 1), said
        assert what in said
        assert said.startswith("swath: ")
    assert {path.name for path in tmp_path.iterdir()} == {"notes.txt", "folder", "file", "small.pcap"}
    assert small.stat().st_size > 3000
