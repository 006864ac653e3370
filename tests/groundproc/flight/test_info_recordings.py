"""`swath info` on recordings of other programs, on several files, and on logs too short or too bare for some figures."""

import gzip
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.mavlink import Frame, FrameParser
from groundproc.cli import main
from groundproc.flight.summary.numbering import Numbering
from groundproc.flight.summary.rates import rate_hz

START_NS = 1_700_000_000_000_000_000
Frames = list[tuple[int, bytes]]
Make = Callable[..., bytes]


def info(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main(["info", *map(str, words)])
    said = capsys.readouterr()
    return code, said.out, said.err


def figures(capsys: pytest.CaptureFixture[str], path: Path) -> dict[str, Any]:
    code, text, _ = info(capsys, "--json", path)
    assert code in (0, 1, 3)  # the verdict's
    return dict(json.loads(text))


def message(name: str, fields: str, labels: str, number: int, size: int) -> bytes:
    """A FMT message of a dataflash log."""
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, size, name.encode(), fields.encode(), labels.encode())


DATAFLASH = message("ATT", "Qf", "TimeUS,Roll", 200, 15) + b"".join(
    b"\xa3\x95\xc8" + struct.pack("<Qf", i * 20_000, 0.5) for i in range(5000)
)


def test_a_dataflash_log_is_named_and_its_messages_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "1.BIN"
    path.write_bytes(DATAFLASH)
    code, text, _ = info(capsys, path)
    assert code == 0
    assert "a dataflash log of ArduPilot (swath import --mavlink makes a log of it)" in text
    assert "5000 of 1 kind" in text
    assert figures(capsys, path)["dataflash"]["messages"] == {"ATT": 5000}


def test_a_log_of_a_dataflash_log_alone_states_no_rate_and_no_false_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, log = tmp_path / "1.BIN", tmp_path / "f.mcap"
    path.write_bytes(DATAFLASH * 3)
    assert main(["import", "--mavlink", str(path), "-o", str(log)]) == 0
    capsys.readouterr()
    _, text, _ = info(capsys, log)
    assert "a second" not in text
    assert "by the autopilot alone; its times are in its own messages" in text
    assert figures(capsys, log)["topics"]["/dataflash/ins"]["rate_hz"] is None


def test_a_capture_is_told_without_importing_it_and_as_after_importing_it(
    recordings: Path, monterey_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = recordings / "lidar/hdl32e_monterey.pcap"
    packed = tmp_path / "m.pcap.gz"
    packed.write_bytes(gzip.compress(capture.read_bytes(), 1))
    whole = figures(capsys, monterey_log)
    for path in (capture, packed):
        found = figures(capsys, path)
        assert found["kind"]["name"] == "capture"
        assert found["lidar"] == whole["lidar"]
        assert found["position"] == whole["position"]
    code, text, _ = info(capsys, capture)
    assert code == 0
    assert "a packet capture (swath import --pcap makes a log of it)" in text
    assert "192.168.1.201 with 2702" in text


def test_a_telemetry_log_is_told_as_after_importing_it(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tlog, log = recordings / "mavlink/arducopter313_sim.tlog", tmp_path / "t.mcap"
    assert main(["import", "--mavlink", str(tlog), "-o", str(log)]) == 0
    capsys.readouterr()
    found = figures(capsys, tlog)
    assert found["kind"]["what"] == "a telemetry log"
    assert found["mavlink"] == figures(capsys, log)["mavlink"]
    assert found["start_utc"] == figures(capsys, log)["start_utc"]


def test_a_capture_of_which_import_would_leave_packets_behind_says_so(
    cases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text, _ = info(capsys, cases / "both_ports.pcap")
    assert code in (0, 3)
    assert "give --lidar-port 2369 --position-port 8309" in text


def test_several_logs_are_told_one_after_the_other_and_a_bad_one_hides_none(
    recordings: Path, monterey_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tlog = tmp_path / "a.tlog"
    tlog.write_bytes((recordings / "mavlink/arducopter313_sim.tlog").read_bytes()[:200_000])
    code, text, error = info(capsys, monterey_log, tmp_path / "none.mcap", tlog)
    assert code == 1
    assert error.count("\n") == 1
    assert text.index(str(monterey_log)) < text.index(f"{tlog}: a telemetry log")
    code, text, _ = info(capsys, "--json", monterey_log, tlog)
    assert code == 1, "as the verdict on the first, whose lidar and autopilot are of different years"
    assert [Path(each["file"]) for each in json.loads(text)] == [monterey_log, tlog]


def test_a_moment_of_data_has_no_rates(
    turning: Callable[..., Frames],
    position_payload: Make,
    ethernet: Make,
    pcap: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stamped = [(START_NS + t, ethernet(payload)) for t, payload in turning(0.02)]
    stamped += [(START_NS + i * 4_000_000 + 7, ethernet(position_payload(i * 4000), 8308)) for i in range(5)]
    capture, log = tmp_path / "m.pcap", tmp_path / "m.mcap"
    capture.write_bytes(pcap(sorted(stamped)))
    assert main(["import", "--pcap", str(capture), "-o", str(log)]) == 0
    capsys.readouterr()
    _, text, _ = info(capsys, log)
    assert "a second" not in text
    assert figures(capsys, log)["lidar"]["clock"] is None


def test_a_second_of_data_has_the_rates_of_a_second(
    turning: Callable[..., Frames],
    position_payload: Make,
    ethernet: Make,
    pcap: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stamped = [(START_NS + t, ethernet(payload)) for t, payload in turning(1.0)]
    stamped += [(START_NS + i * 5_000_000 + 7, ethernet(position_payload(i * 5000), 8308)) for i in range(200)]
    capture, log = tmp_path / "m.pcap", tmp_path / "m.mcap"
    capture.write_bytes(pcap(sorted(stamped)))
    assert main(["import", "--pcap", str(capture), "-o", str(log)]) == 0
    capsys.readouterr()
    found = figures(capsys, log)
    assert found["topics"]["/velodyne_packets"]["rate_hz"] == pytest.approx(10.0, rel=0.02)
    assert found["position"]["rate_hz"] == pytest.approx(200.0)


def test_a_log_without_gyros_says_so(
    recordings: Path,
    turning: Callable[..., Frames],
    ethernet: Make,
    pcap: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    capture = tmp_path / "m.pcap"
    capture.write_bytes(pcap([(START_NS + t, ethernet(payload)) for t, payload in turning(0.1)]))
    assert "none: the log holds no position packets of the lidar" in info(capsys, capture)[1]
    assert "none with inertial readings: no gyros" in info(capsys, recordings / "lidar/vlp16_gps.pcap")[1]


def test_rates_need_three_things_and_a_quarter_of_a_second() -> None:
    assert rate_hz(2, 10**9) is None
    assert rate_hz(1000, 1) is None
    assert rate_hz(11, 10**9) == 10.0


# numbers of frames ------------------------------------------------------------------------------------------------------


def frames(numbers: list[int], step_ns: int = 20_000_000) -> list[Frame]:
    """Frames of these numbers, each of its own content."""
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    parser, found = FrameParser(), []
    for i, number in enumerate(numbers):
        sender.seq = number % 256
        found += parser.feed(
            START_NS + i * step_ns, bytes(dialect.MAVLink_attitude_message(number * 20, 0, 0, 0, 0, 0, 0).pack(sender))
        )
    return found + parser.finish()


def counted(numbers: list[int]) -> tuple[int, int, int]:
    numbering = Numbering()
    for frame in frames(numbers):
        numbering.take(frame)
    return numbering.lost, numbering.late, numbering.duplicates


@pytest.mark.parametrize("gap", [1, 100, 127, 128, 150, 200, 255])
def test_frames_missing_in_a_row_are_counted_whatever_their_number(gap: int) -> None:
    assert counted([*range(300), *range(300 + gap, 700 + gap)]) == (gap, 0, 0)


def test_late_frames_are_not_lost_and_frames_given_twice_are_counted_as_that() -> None:
    assert counted([0, 1, 3, 2, 4, 6, 7, 5, 8]) == (0, 2, 0)
    assert counted([1, 0, 2, 3]) == (0, 1, 0)
    assert counted([0, 1, 1, 2, 2, 3, 1, 4]) == (0, 0, 3)


def test_a_restart_of_the_sender_is_no_loss() -> None:
    numbering = Numbering()
    for frame in frames([*range(40), *range(5)]):
        numbering.take(frame)
    assert numbering.lost == 256 - 40
    numbering.restarted(START_NS + 45 * 20_000_000)
    assert numbering.lost == 0
