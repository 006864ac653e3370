from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import hdl32e, records
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from flightlog.mavlink import FrameParser
from flightlog.records import LidarAccount
from groundproc.flight.load import lidar_batches, mavlink_frames
from groundproc.flight.positionpackets import position_samples

HOUR_NS = 3_600_000_000_000
START_NS = 1_700_000_000_000_000_000


def write(path: Path, messages: list[tuple[str, int, bytes]]) -> LogReader:
    with path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={})
        for message in messages:
            writer.write(*message)
        writer.finish()
    return LogReader(path)


def scan(stamped: list[tuple[int, int]], payload: Callable[..., bytes]) -> tuple[str, int, bytes]:
    """A message of packets of (receive time [ns], stamp [us])."""
    packets = np.zeros(len(stamped), records.SCAN_PACKET_DTYPE)
    data = b"".join(payload(stamp_us, [0] * 12) for _, stamp_us in stamped)
    packets["data"] = np.frombuffer(data, hdl32e.DATA_DTYPE)
    records.set_receive_time_ns(packets, np.array([time_ns for time_ns, _ in stamped], np.int64))
    log_ns = stamped[-1][0]
    return records.LIDAR.topic, log_ns, records.encode_scan(log_ns, packets)


def test_the_recorded_stamps_go_on_by_552_or_553_us(monterey_log: Path) -> None:
    with LogReader(monterey_log) as reader:
        batches = list(lidar_batches([reader]))
    device_ns = np.concatenate([batch.device_time_ns for batch in batches])
    raw_us = np.concatenate([batch.packets["data"]["stamp_us"] for batch in batches])
    assert len(device_ns) == 2702
    assert set(np.diff(device_ns).tolist()) == {552_000, 553_000}
    assert ((device_ns // 1000 - raw_us) % 3_600_000_000 == 0).all()
    late_ns = np.concatenate([batch.receive_time_ns for batch in batches]) - device_ns
    assert (np.abs(late_ns) < HOUR_NS // 2).all()
    assert not any(batch.jumped for batch in batches)
    assert all(batch.account is not None and batch.account.kept == len(batch.packets) for batch in batches)


def test_position_samples_share_the_hour_and_the_clock_of_the_packets(monterey_log: Path) -> None:
    with LogReader(monterey_log) as reader:
        batches = list(lidar_batches([reader]))
        samples = position_samples([reader])
    late_ns = np.concatenate([b.receive_time_ns - b.device_time_ns for b in batches])
    # the packets of both kinds leave the sensor within the 553 us of a data packet after their stamps
    assert samples.receive_time_ns - samples.device_time_ns == pytest.approx(np.median(late_ns), abs=600_000)
    assert len(samples.device_time_ns) == 299
    assert samples.has_imu.all()
    assert [sentence.text[:13] for sentence in samples.sentences] == ["$GPRMC,220632", "$GPRMC,220633"]
    # at rest and upright; the zero offset of gyro 3 is that of the specification's table
    assert np.linalg.norm(samples.accel_m_s2.mean(axis=0)) == pytest.approx(9.81, rel=0.05)
    assert np.rad2deg(samples.gyro_rad_s.mean(axis=0))[2] == pytest.approx(-29.4, abs=0.1)


def test_stamps_are_carried_over_the_hour_and_from_log_to_log(
    tmp_path: Path, data_payload: Callable[..., bytes], position_payload: Callable[..., bytes]
) -> None:
    last_us = 3_600_000_000 - 500
    stamps = [last_us, last_us + 553 - 3_600_000_000, last_us + 1106 - 3_600_000_000]
    first = [(START_NS + i * 553_000, stamp) for i, stamp in enumerate(stamps)]
    gap_ns = 2 * HOUR_NS + 17_000_000  # the second log comes two hours later
    second = [(START_NS + gap_ns + i * 553_000, (last_us + 17_000 + i * 553) % 3_600_000_000) for i in range(3)]
    position = (
        records.POSITION.topic,
        START_NS + 400_000,
        records.encode_raw(0, [(START_NS + 400_000, position_payload(last_us + 400))], "velodyne"),
    )
    readers = [
        write(tmp_path / "b.mcap", [scan(second, data_payload)]),
        write(tmp_path / "a.mcap", [scan(first, data_payload), position]),
    ]
    device_ns = np.concatenate([batch.device_time_ns for batch in lidar_batches(readers)])
    expected = [0, 553_000, 1_106_000, gap_ns, gap_ns + 553_000, gap_ns + 1_106_000]
    assert (device_ns - device_ns[0]).tolist() == expected
    assert (position_samples(readers).device_time_ns - device_ns[0]).tolist() == [400_000]
    for reader in readers:
        reader.close()


def test_a_clock_that_was_set_is_told(tmp_path: Path, data_payload: Callable[..., bytes]) -> None:
    steady = [(START_NS + i * 553_000, 1_000_000 + i * 553) for i in range(3)]
    locked = [(START_NS + (3 + i) * 553_000, 900_000_000 + i * 553) for i in range(3)]
    with write(tmp_path / "a.mcap", [scan(steady, data_payload), scan(locked, data_payload)]) as reader:
        assert [batch.jumped for batch in lidar_batches([reader])] == [False, True]


def test_packets_and_account_find_each_other_in_either_order(
    tmp_path: Path, data_payload: Callable[..., bytes]
) -> None:
    messages = []
    for i in range(4):
        packets = scan([(START_NS + i * 100_000_000, i * 100_000)], data_payload)
        account = LidarAccount(received=9, kept=1, masked_packets=i)
        pair = [packets, (records.LIDAR_ACCOUNT.topic, packets[1], records.encode_account(packets[1], account))]
        messages += pair if i % 2 else pair[::-1]
    lonely_ns = START_NS + 400_000_000
    lonely = records.encode_account(lonely_ns, LidarAccount(received=181, masked_packets=181))
    messages.append((records.LIDAR_ACCOUNT.topic, lonely_ns, lonely))
    with write(tmp_path / "a.mcap", messages) as reader:
        batches = list(lidar_batches([reader]))
    assert [batch.account.masked_packets for batch in batches if batch.account] == [0, 1, 2, 3, 181]
    assert [len(batch.packets) for batch in batches] == [1, 1, 1, 1, 0]


def test_a_frame_may_straddle_messages_and_each_link_is_its_own(tmp_path: Path) -> None:
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = bytes(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(sender))
    chunks = [(START_NS, frame[:5]), (START_NS + 10, frame[5:]), (START_NS + 20, b"\x00\x01"), (START_NS + 30, frame)]
    messages = [("/mavlink/ins", t, records.encode_raw(t, [(t, data)], "ins")) for t, data in chunks]
    messages += [("/mavlink/fc", START_NS + 40, records.encode_raw(0, [(START_NS + 40, frame)], "fc"))]
    parser = FrameParser()
    with write(tmp_path / "a.mcap", messages) as reader:
        found = list(mavlink_frames([reader], "ins", parser))
        assert len(list(mavlink_frames([reader], "fc"))) == 1
    assert [(f.time_ns, f.data) for f in found] == [(START_NS + 10, frame), (START_NS + 30, frame)]
    assert parser.bad_bytes == 2
