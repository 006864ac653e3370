"""Boots of the autopilot and runs of the lidar's clock on one scale, against the simulation's own clocks."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flightlog.errors import ClockError, LogError, SyncError
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from flightlog.mount import Mount
from groundproc.flight import load
from groundproc.flight.flight import Flight, read_flight
from groundproc.flight.pairing import legs
from groundproc.flight.timeline import Line

S, MS = 10**9, 10**6
MAT = Mount().mat_ins_lidar()


def flight_of(path: Path) -> Flight:
    with LogReader(path) as reader:
        return read_flight([reader], "ins")


def true_utc_ns(truth: dict[str, Any], clock: str, shown_ns: np.ndarray) -> np.ndarray:
    """UTC at which a clock of the simulation shows something."""
    values, utc = truth["clocks"][clock] if clock in truth["clocks"] else truth[clock], truth["clocks"]["utc"]
    return np.asarray(utc["start_ns"] + (shown_ns - values["start_ns"]) / (1 + values["drift_ppm"] * 1e-6))


def lidar_stamps_ns(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Lidar time as the reader of logs carries it on, and as the sensor sent it."""
    with LogReader(path) as reader:
        batches = [b for b in load.lidar_batches([reader]) if len(b.packets)]
    ours = np.concatenate([b.device_time_ns for b in batches])
    sent = np.concatenate([b.packets["data"]["stamp_us"].astype(np.int64) for b in batches]) * 1000
    return ours, sent


def test_without_gps_on_the_lidar_system_time_tells_utc_and_the_gyros_the_rest(plain_flight: Any) -> None:
    flight = flight_of(plain_flight.log)
    (leg,) = legs(flight.runs, flight.boots, MAT, "auto")
    assert (leg.sync.method, leg.utc.source) == ("gyro", "system_time")
    ours, sent = lidar_stamps_ns(plain_flight.log)
    off_ns = leg.utc_from_lidar(ours) - true_utc_ns(plain_flight.truth, "lidar", sent)
    # the tie to SYSTEM_TIME is to a millisecond, the gyros to their own sigma; 25 s of flight
    assert np.abs(off_ns).max() < 4 * np.hypot(leg.sync.sigma_offset_ns, MS)
    boot_ns = flight.boots[0].stamps_ns["ATTITUDE"]
    boot_off_ns = leg.utc_from_boot(boot_ns) - true_utc_ns(plain_flight.truth, "boot", boot_ns)
    assert np.abs(boot_off_ns).max() < 2 * MS
    # what matters is the one against the other
    assert abs(np.median(off_ns) - np.median(boot_off_ns)) < 4 * leg.sync.sigma_offset_ns


def test_a_known_delay_of_the_lidars_gyro_is_taken_off_its_stamps_and_so_off_the_tie(plain_flight: Any) -> None:
    """Readings of 4 ms ago, believed prompt, would put the autopilot 4 ms too late on the lidar's clock."""
    flight = flight_of(plain_flight.log)
    (prompt,) = legs(flight.runs, flight.boots, MAT, "gyro")
    runs = [run.less_delay(4.0) for run in flight.runs]
    (late,) = legs(runs, flight.boots, MAT, "gyro")
    assert (runs[0].gyro.time_ns == flight.runs[0].gyro.time_ns - 4 * MS).all()
    assert flight.runs[0].less_delay(0.0) is flight.runs[0]
    lidar_ns = flight.runs[0].gyro.time_ns
    moved_ns = late.sync.ins_time_ns(lidar_ns) - prompt.sync.ins_time_ns(lidar_ns)
    # the grid of the search lies elsewhere on the same curve
    assert np.abs(moved_ns - 4 * MS).max() < 0.2 * prompt.sync.sigma_offset_ns


def test_a_lidar_with_gps_tells_utc_itself(gps_flight: Any) -> None:
    flight = flight_of(gps_flight.log)
    (leg,) = legs(flight.runs, flight.boots, MAT, "auto")
    assert leg.utc.source == "gprmc"
    ours, _ = lidar_stamps_ns(gps_flight.log)
    utc_ns = leg.utc_from_lidar(ours)
    # the sensor's own UTC: the stamp past the hour, exactly
    assert (utc_ns % (3600 * S) == ours % (3600 * S)).all()
    assert abs(utc_ns[0] - gps_flight.truth["clocks"]["utc"]["start_ns"]) < S
    boot_ns = flight.boots[0].stamps_ns["ATTITUDE"]
    off_ns = leg.utc_from_boot(boot_ns) - true_utc_ns(gps_flight.truth, "boot", boot_ns)
    assert np.abs(off_ns).max() < 4 * leg.sync.sigma_offset_ns


def test_both_boots_of_a_flight_are_tied_to_the_lidar_and_the_lidar_has_no_step(rebooted_flight: Any) -> None:
    truth = rebooted_flight.truth
    flight = flight_of(rebooted_flight.log)
    assert len(flight.boots) == 2
    first, second = legs(flight.runs, flight.boots, MAT, "auto")
    assert first.lidar_line == second.lidar_line
    assert [leg.sync.method for leg in (first, second)] == ["gyro", "gyro"]
    for leg, clock in ((first, "boot"), (second, "boot_clock_after_reboot")):
        boot_ns = leg.boot.stamps_ns["ATTITUDE"]
        off_ns = leg.utc_from_boot(boot_ns) - true_utc_ns(truth, clock, boot_ns)
        # 20 s of motion each, and the tie of the first to UTC
        assert np.abs(off_ns).max() < 4 * np.hypot(first.sync.sigma_offset_ns, leg.sync.sigma_offset_ns) + 2 * MS


def test_a_recording_too_short_for_the_gyros_goes_by_receive_times_and_says_why(dual_flight: Any) -> None:
    flight = flight_of(dual_flight.log)
    (leg,) = legs(flight.runs, flight.boots, MAT, "auto")
    assert leg.sync.method == "host"
    assert "receive times only, because" in leg.sync.note
    offset_ns = leg.sync.offset_ns + leg.sync.reference_ns // (3600 * S) * 3600 * S
    shown_s = (leg.sync.reference_ns % (3600 * S)) * 1e-9
    # late by the 12 ms and more that the link takes; the lidar's packets by 50 us and the 0.3 ms that a packet fills
    error_ns = offset_ns - dual_flight.offset_s(shown_s) * 1e9
    assert -40 * MS < error_ns < 1 * MS
    with pytest.raises(SyncError):
        legs(flight.runs, flight.boots, MAT, "gyro")


def test_receive_times_can_be_asked_for(plain_flight: Any) -> None:
    flight = flight_of(plain_flight.log)
    (leg,) = legs(flight.runs, flight.boots, MAT, "host")
    assert (leg.sync.method, leg.sync.note) == ("host", "receive times only")
    assert leg.sync.sigma_offset_ns > 1 * MS


def test_a_sensor_that_stands_still_cannot_be_synchronised_by_its_gyros(still_flight: Any) -> None:
    flight = flight_of(still_flight.log)
    (leg,) = legs(flight.runs, flight.boots, MAT, "auto")
    assert leg.sync.method == "host"
    assert "no motion" in leg.sync.note


def moved(source: Path, target: Path, shift: Callable[[str], int]) -> Path:
    """A copy of a log whose messages of each topic are received later by shift(topic) [ns]."""
    from flightlog import records

    with LogReader(source) as reader, target.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments=dict(reader.attachments))
        for message in sorted(reader.messages(), key=lambda m: m.log_time_ns + shift(m.topic)):
            late_ns, data = shift(message.topic), message.data
            if late_ns and message.topic.startswith(records.MAVLINK.topic):
                chunks = [(t + late_ns, chunk) for t, chunk in records.decode_raw(data)]
                data = records.encode_raw(message.log_time_ns + late_ns, chunks, "ins")
            writer.write(message.topic, message.log_time_ns + late_ns, bytes(data))
        writer.finish()
    return target


@pytest.mark.parametrize("late_s", [2.0, -1.2])
def test_a_radio_of_two_seconds_delay_moves_nothing(plain_flight: Any, tmp_path: Path, late_s: float) -> None:
    """Recorded on another computer, or over a slow link: the gyros do not care when anything was received."""
    path = moved(plain_flight.log, tmp_path / "late.mcap", lambda topic: round(late_s * S) if "mavlink" in topic else 0)
    flight, plain = flight_of(path), flight_of(plain_flight.log)
    (late,), (usual,) = legs(flight.runs, flight.boots, MAT, "auto"), legs(plain.runs, plain.boots, MAT, "auto")
    assert late.sync.method == "gyro"
    assert abs(late.sync.offset_ns - usual.sync.offset_ns) < usual.sync.sigma_offset_ns


def test_two_computers_with_different_clocks_are_brought_together_and_told(plain_flight: Any, tmp_path: Path) -> None:
    """18 s apart, and 25 s long: the receive times' search finds nothing, the search everywhere does."""
    path = moved(plain_flight.log, tmp_path / "apart.mcap", lambda topic: 18 * S if "mavlink" in topic else 0)
    flight, plain = flight_of(path), flight_of(plain_flight.log)
    (leg,), (usual,) = legs(flight.runs, flight.boots, MAT, "auto"), legs(plain.runs, plain.boots, MAT, "auto")
    assert leg.sync.method == "gyro"
    assert abs(leg.sync.offset_ns - usual.sync.offset_ns) < 3 * usual.sync.sigma_offset_ns
    assert "receive times differ by" in leg.sync.note
    assert "18." in leg.sync.note or "17." in leg.sync.note


def test_recordings_of_different_days_are_refused(plain_flight: Any, tmp_path: Path) -> None:
    path = moved(plain_flight.log, tmp_path / "days.mcap", lambda topic: 86_400 * S if "mavlink" in topic else 0)
    flight = flight_of(path)
    with pytest.raises(ClockError, match="were not recorded at the same time"):
        legs(flight.runs, flight.boots, MAT, "auto")


def without(source: Path, target: Path, *words: str) -> Path:
    """A copy of a log without the topics that contain a word."""
    with LogReader(source) as reader, target.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments=dict(reader.attachments))
        for message in reader.messages():
            if not any(word in message.topic for word in words):
                writer.write(message.topic, message.log_time_ns, bytes(message.data))
        writer.finish()
    return target


def test_a_lidar_without_position_packets_goes_by_receive_times(plain_flight: Any, tmp_path: Path) -> None:
    flight = flight_of(without(plain_flight.log, tmp_path / "a.mcap", "position"))
    (leg,) = legs(flight.runs, flight.boots, MAT, "auto")
    assert leg.sync.method == "host"
    assert "no gyro readings" in leg.sync.note
    with pytest.raises(SyncError, match="8308"):
        legs(flight.runs, flight.boots, MAT, "gyro")


def test_a_log_without_lidar_or_without_autopilot_is_refused(plain_flight: Any, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no lidar packets"):
        flight_of(without(plain_flight.log, tmp_path / "a.mcap", "velodyne"))
    with pytest.raises(LogError, match="no MAVLink"):
        flight_of(without(plain_flight.log, tmp_path / "b.mcap", "mavlink"))


def test_a_lidar_clock_that_was_set_in_flight_makes_two_runs(plain_flight: Any, tmp_path: Path) -> None:
    """From the fifteenth second on the stamps are another 900 s further: its GPS has come to life."""
    from flightlog import records

    path = tmp_path / "set.mcap"
    with LogReader(plain_flight.log) as reader, path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments=dict(reader.attachments))
        for message in reader.messages():
            data = bytes(message.data)
            if message.log_time_ns - reader.start_ns > 12 * S:
                if message.topic == records.LIDAR.topic:
                    packets = records.decode_scan(data)
                    packets["data"]["stamp_us"] += 900_000_000
                    data = records.encode_scan(message.log_time_ns, packets)
                elif message.topic == records.POSITION.topic:
                    chunks = []
                    for time_ns, chunk in records.decode_raw(data):
                        stamp = int.from_bytes(chunk[198:202], "little") + 900_000_000
                        chunks.append((time_ns, chunk[:198] + stamp.to_bytes(4, "little") + chunk[202:]))
                    data = records.encode_raw(message.log_time_ns, chunks, "velodyne")
            writer.write(message.topic, message.log_time_ns, data)
        writer.finish()
    flight = flight_of(path)
    assert len(flight.runs) == 2
    first, second = legs(flight.runs, flight.boots, MAT, "auto")
    assert second.sync.offset_ns - first.sync.offset_ns == pytest.approx(-900 * S, abs=10 * MS)


def test_a_line_turned_back_is_the_way_back() -> None:
    line = Line(-928_838_123_456, -70e-6, 1_012_250_000_000)
    times = np.array([0, 1_012_250_000_000, 5_000_000_000_000], np.int64)
    assert np.abs(line.inverse()(line(times)) - times).max() <= 2
