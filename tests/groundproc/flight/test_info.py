import json
import random
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import velodyne_decoder
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import hdl32e, records
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from flightlog.records import LidarAccount
from groundproc.cli import main
from groundproc.flight.summary.clockfit import drift
from groundproc.flight.summary.log import summarise
from onboard import fovmask

START_NS = 1_700_000_000_000_000_000
Message = tuple[str, int, bytes]


def info(path: Path, messages: Iterable[Message]) -> dict[str, Any]:
    """Figures of a log of these messages."""
    with path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={})
        for message in messages:
            writer.write(*message)
        writer.finish()
    with LogReader(path) as reader:
        return summarise(reader)


def scans(packets: list[tuple[int, bytes]], window_deg: tuple[float, float] | None = None) -> list[Message]:
    """Messages of 0.1 s as from aboard, the window applied as the daemon applies it."""
    window = fovmask.Window.from_degrees(*window_deg) if window_deg else fovmask.Window(0, 0)
    messages: list[Message] = []
    times = np.array([time_ns for time_ns, _ in packets], np.int64)
    for slot in np.unique(times // 100_000_000):
        chosen = [packets[i] for i in np.flatnonzero(times // 100_000_000 == slot)]
        batch = np.zeros(len(chosen), records.SCAN_PACKET_DTYPE)
        batch["data"] = np.frombuffer(b"".join(payload for _, payload in chosen), hdl32e.DATA_DTYPE)
        records.set_receive_time_ns(batch, START_NS + np.array([time_ns for time_ns, _ in chosen], np.int64))
        masked = fovmask.apply(batch, window)
        log_ns = START_NS + chosen[-1][0]
        account = LidarAccount(
            received=len(batch),
            kept=len(masked.packets),
            masked_packets=masked.masked_packets,
            masked_blocks=masked.masked_blocks,
            fov_start_deg=window_deg[0] if window_deg else 0.0,
            fov_end_deg=window_deg[1] if window_deg else 0.0,
        )
        messages.append((records.LIDAR.topic, log_ns, records.encode_scan(log_ns, masked.packets)))
        messages.append((records.LIDAR_ACCOUNT.topic, log_ns, records.encode_account(log_ns, account)))
    return messages


def azimuth_deg(payload: bytes) -> float:
    return int.from_bytes(payload[2:4], "little") / 100


def test_the_recorded_lidar_is_what_its_card_says(monterey_log: Path, recordings: Path) -> None:
    with LogReader(monterey_log) as reader:
        summary = summarise(reader)
    lidar = summary["lidar"]
    assert lidar["packets"] == 2702
    assert lidar["rpm"] == pytest.approx(706, abs=0.7)
    assert lidar["return_mode"] == "strongest"
    assert (lidar["missing_packets"], lidar["lost_packets"], lidar["out_of_order"]) == (0, 0, 0)
    assert lidar["azimuth_coverage_deg"] == 360.0
    decoder = velodyne_decoder.StreamDecoder(velodyne_decoder.Config(min_range=0.0, max_range=1000.0))
    points = 0
    with LogReader(monterey_log) as reader:
        for message in reader.messages((records.LIDAR.topic,)):
            for packet in records.decode_scan(message.data):
                done = decoder.decode(0.0, bytes(packet["data"]), True)
                points += len(done[1]) if done else 0
    rest = decoder.finish(True)
    points += len(rest[1]) if rest else 0
    assert lidar["shots_with_return"] == points == 872_800
    position = summary["position"]
    assert (position["packets"], position["with_imu"]) == (299, 299)
    assert position["rate_hz"] == pytest.approx(200.45, abs=0.1)
    assert position["pps"] == {"absent": 299}
    assert position["clock_state"] == "aligned to UTC"
    # the sentence for second 393 of the hour first appears at stamp 393.848 s
    assert position["gps"]["lag_s"] == pytest.approx(0.848, abs=0.01)
    assert (position["gps"]["sentences"], position["gps"]["valid"]) == (2, 2)
    assert summary["truncated"] is False


def test_the_copter_flight_has_two_boots_and_the_rates_of_its_radio(monterey_log: Path, recordings: Path) -> None:
    with LogReader(monterey_log) as reader:
        mavlink = summarise(reader)["mavlink"]["ins"]
    (autopilot,) = mavlink["autopilots"]
    assert (autopilot["system"], autopilot["component"]) == (1, 1)
    assert len(autopilot["boots"]) == 2
    assert mavlink["reboots"] == 1
    rates = {kind["name"]: kind["rate_hz"] for kind in mavlink["messages"] if kind["system"] == 1}
    for name in ("ATTITUDE", "RAW_IMU", "GLOBAL_POSITION_INT"):
        assert rates[name] == pytest.approx(2.7, abs=0.05)
    log = mavutil.mavlink_connection(str(recordings / "mavlink/copter_flight_2015.tlog"), robust_parsing=True)
    theirs: dict[tuple[int, int, str], int] = {}
    while (message := log.recv_match()) is not None:
        if message.get_type() != "BAD_DATA":
            key = message.get_srcSystem(), message.get_srcComponent(), message.get_type()
            theirs[key] = theirs.get(key, 0) + 1
    log.close()
    ours = {(kind["system"], kind["component"], kind["name"]): kind["count"] for kind in mavlink["messages"]}
    assert ours == theirs


@pytest.mark.parametrize("dual", [False, True])
def test_lost_packets_are_told_apart_from_those_masked_aboard(
    tmp_path: Path, turning: Callable[..., list[tuple[int, bytes]]], dual: bool
) -> None:
    packets = turning(2.0, dual=dual)
    clean = info(tmp_path / "clean.mcap", scans(packets, (255.0, 105.0)))["lidar"]
    assert clean["lost_packets"] == 0
    assert clean["window_aboard_deg"] == [255.0, 105.0]
    assert clean["sensor_fov_deg"] is None
    assert clean["account"]["received"] == len(packets)
    # those masked ahead of the first and behind the last packet that was kept leave no gap
    assert (
        0
        <= clean["account"]["masked_packets"] - clean["missing_outside_window_aboard"]
        <= len(packets) / 20 * 150 / 360
    )
    ahead = [i for i, (_, p) in enumerate(packets) if not 95 < azimuth_deg(p) < 265]
    gone = set(random.Random(2).sample(ahead[5:-5], 23))
    rest = [packet for i, packet in enumerate(packets) if i not in gone]
    lossy = info(tmp_path / "lossy.mcap", scans(rest, (255.0, 105.0)))["lidar"]
    assert lossy["lost_packets"] == 23
    assert lossy["missing_outside_window_aboard"] == clean["missing_outside_window_aboard"]


@pytest.mark.parametrize("rpm", [300.0, 600.0, 1200.0])
def test_lost_packets_are_told_apart_from_the_sensors_own_field_of_view(
    tmp_path: Path, turning: Callable[..., list[tuple[int, bytes]]], rpm: float
) -> None:
    packets = turning(2.0, rpm=rpm, fov_deg=(255.0, 105.0))
    clean = info(tmp_path / "clean.mcap", scans(packets))["lidar"]
    assert clean["lost_packets"] == 0
    assert clean["window_aboard_deg"] is None
    assert clean["sensor_fov_deg"] == pytest.approx([255.0, 105.0], abs=0.5)
    assert clean["azimuth_coverage_deg"] == pytest.approx(210.0, abs=1.0)
    # what a full circle would have sent
    assert clean["missing_outside_sensor_fov"] == pytest.approx(len(turning(2.0, rpm=rpm)) * 150 / 360, rel=0.06)
    gone = set(random.Random(3).sample(range(5, len(packets) - 5), 17))
    rest = [packet for i, packet in enumerate(packets) if i not in gone]
    lossy = info(tmp_path / "lossy.mcap", scans(rest))["lidar"]
    assert lossy["lost_packets"] == 17
    assert lossy["rpm"] == pytest.approx(rpm, rel=0.002)


def test_random_loss_is_no_field_of_view(tmp_path: Path, turning: Callable[..., list[tuple[int, bytes]]]) -> None:
    packets = turning(2.0)
    rest = [packet for packet in packets if random.Random(packet[0]).random() > 0.3]
    rest = [packets[0], *rest[1:-1], packets[-1]]
    lidar = info(tmp_path / "a.mcap", scans(rest))["lidar"]
    assert lidar["sensor_fov_deg"] is None
    assert lidar["lost_packets"] == lidar["missing_packets"] == len(packets) - len(set(rest))


def test_a_silence_is_a_gap_and_its_packets_are_lost(
    tmp_path: Path, turning: Callable[..., list[tuple[int, bytes]]]
) -> None:
    packets = turning(4.0)
    rest = [packet for packet in packets if not 1.0 < packet[0] / 1e9 < 2.5]
    summary = info(tmp_path / "a.mcap", scans(rest))
    assert summary["gap_count"] == 1
    assert summary["gaps"][0]["topic"] == "/velodyne_packets"
    assert summary["gaps"][0]["duration_s"] == pytest.approx(1.5, abs=0.002)
    assert summary["lidar"]["lost_packets"] == len(packets) - len(rest)


@pytest.mark.parametrize("true_ppm", [-58.0, 0.0, 30.0])
def test_the_drift_of_a_clock_is_found_within_its_claimed_sigma(true_ppm: float) -> None:
    errors, sigmas = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        device_ns = np.arange(600) * 100_000_000
        late_ns = -device_ns * true_ppm * 1e-6 + rng.normal(0, 20_000, 600)
        late_ns[rng.integers(0, 600, 20)] += 5_000_000  # now and then the host was busy
        found = drift(np.stack([device_ns, late_ns.astype(np.int64)], axis=1), [])
        assert found is not None
        errors.append(found["drift_ppm"] - true_ppm)
        sigmas.append(found["drift_sigma_ppm"])
    ratio = np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas)
    # of 40 trials the rms is known to 1 / sqrt(80) = 11 %; three times that, and 10 % for what clipping takes from sigma
    assert 0.6 < ratio < 1.45


def test_a_reboot_is_a_boot_time_that_falls_not_one_that_comes_late_or_wraps(tmp_path: Path) -> None:
    def boots(times_ms: list[int]) -> int:
        sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        chunks = [(START_NS, bytes(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(sender)))]
        for i, boot_ms in enumerate(times_ms):
            message = dialect.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            chunks.append((START_NS + i * 1000, bytes(message.pack(sender))))
        data = records.encode_raw(START_NS, chunks, "ins")
        summary = info(tmp_path / "a.mcap", [("/mavlink/ins", START_NS, data)])["mavlink"]["ins"]
        return len(summary["autopilots"][0]["boots"])

    assert boots([1000, 2000, 3000]) == 1
    assert boots([50_000, 48_500, 51_000]) == 1
    assert boots([2**32 - 500, 2**32 - 1, 500]) == 1
    assert boots([50_000, 51_000, 20_000, 21_000, 900]) == 3


def test_a_cut_log_is_told_and_summed_up_as_far_as_it_goes(
    monterey_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    content = monterey_log.read_bytes()
    cut.write_bytes(content[: len(content) // 2])
    assert main(["info", str(cut), "--json"]) == 3
    summary = json.loads(capsys.readouterr().out)
    assert summary["truncated"] is True
    assert 0 < summary["lidar"]["packets"] < 2702
    assert summary["verdict"] == "doubtful"
    assert {reason["about"] for reason in summary["verdict_reasons"]} == {"truncated", "autopilot"}
    assert main(["info", str(cut)]) == 3
    text = capsys.readouterr().out
    assert "cut off" in text
    assert text.splitlines()[-1].startswith("verdict: doubtful: ")
    assert "no messages of the autopilot" in text.splitlines()[-1]
    assert f"swath recover {cut}" in text


def test_the_text_says_what_the_json_says(monterey_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(monterey_log)]) == 1
    text = capsys.readouterr().out
    # the lidar is of 2012, the autopilot of 2015
    assert text.splitlines()[-1].startswith("verdict: bad: the log holds 0.0 s of lidar and autopilot together")
    for words in ("2702", "706.5 rpm", "strongest", "2 boots", "absent in 299", "aligned to UTC", "872800"):
        assert words in text


def test_a_log_without_lidar_or_autopilot_says_so(tmp_path: Path) -> None:
    summary = info(tmp_path / "a.mcap", [])
    assert (summary["lidar"], summary["position"], summary["mavlink"], summary["topics"]) == (None, None, {}, {})
    assert summary["start_utc"] is None


def test_the_keys_of_the_json_are_these(monterey_log: Path) -> None:
    with LogReader(monterey_log) as reader:
        summary = summarise(reader)
    assert sorted(summary) == [
        "attachments", "bytes", "damage", "duration_s", "end_utc", "file", "format_version", "gap_count", "gaps",
        "host_clock_steps", "lidar", "lidar_with_autopilot_s", "mavlink",
        "messages_backwards", "messages_damaged", "position", "session", "start_utc",
        "topics", "truncated", "utc",
    ]  # fmt: skip
    assert sorted(summary["lidar"]) == [
        "account", "azimuth_coverage_deg", "clock", "duplicates", "lost_packets", "missing_outside_sensor_fov",
        "missing_outside_window_aboard", "missing_packets", "model", "out_of_order", "packets", "return_mode", "rpm", "rpm_spread",
        "sensor_fov_deg", "shots_with_return", "turns", "window_aboard_deg",
    ]  # fmt: skip


def test_a_file_that_is_no_log_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("these are no packets\n")
    assert main(["info", str(text)]) == 1
    error = capsys.readouterr().err
    assert "is a text file; expected a flight log" in error
    assert error.count("\n") == 1


def test_packets_of_an_unknown_mode_and_a_window_that_is_no_number_hide_nothing(
    tmp_path: Path, turning: Callable[..., list[tuple[int, bytes]]]
) -> None:
    packets = [(time_ns, payload[:1204] + b"\xee" + payload[1205:]) for time_ns, payload in turning(0.2)]
    account = records.encode_account(START_NS, LidarAccount(fov_start_deg=float("nan"), fov_end_deg=float("inf")))
    found = info(tmp_path / "a.mcap", [*scans(packets), (records.LIDAR_ACCOUNT.topic, START_NS, account)])
    assert found["lidar"]["packets"] == len(packets)
    assert found["lidar"]["return_mode"] == "1 unknown"
