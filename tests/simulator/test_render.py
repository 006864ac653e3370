"""Whole simulations: the same bytes whatever the number of threads, and a log that says what the capture says."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from flightlog import records
from flightlog.errors import SwathError
from flightlog.logfile import LogReader
from flightlog.mount import load_mount, parse_mount
from simulator.config import MountOptions, Options, perfect
from simulator.render import render
from simulator.simulation import Job


def digests(recorded):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(recorded.directory.iterdir())}


def test_the_number_of_threads_changes_no_byte(simulate):
    one, three = (digests(simulate("village", 1.0, workers=workers, points=True)) for workers in (1, 3))
    assert set(one) == {
        "flight.mcap", "capture.pcap", "telemetry.tlog", "board.bin", "truth.csv", "truth.json", "truth_points.npy"
    }  # fmt: skip
    assert one == three


def test_another_seed_is_another_flight(simulate):
    first, second = (digests(simulate("field", 1.0, seed=seed)) for seed in (1, 2))
    assert not set(first.values()) & set(second.values())


def test_switching_one_noise_off_leaves_the_others_as_they_are(simulate):
    options = Options()
    quiet = replace(options, lidar=replace(options.lidar, range_noise_m=0.0))
    noisy, calm = simulate("field", 1.0, options), simulate("field", 1.0, quiet)
    assert digests(noisy)["telemetry.tlog"] == digests(calm)["telemetry.tlog"]
    assert (noisy.shots.azimuth_deg == calm.shots.azimuth_deg).all()
    assert (noisy.capture.payloads(512) == calm.capture.payloads(512)).all()


def test_the_log_holds_the_bytes_of_the_capture_and_of_the_tlog(field_flight):
    lidar, position, mavlink, counted = [], [], [], 0
    with LogReader(field_flight.directory / "flight.mcap") as log:
        assert not log.damage
        for message in log.messages():
            if message.topic == records.LIDAR.topic:
                packets = records.decode_scan(message.data)
                lidar.append(packets)
                assert len(packets) <= 181
                assert records.receive_time_ns(packets)[-1] == message.log_time_ns
            elif message.topic == records.POSITION.topic:
                position += records.decode_raw(message.data)
            elif message.topic == "/mavlink/ins":
                mavlink += records.decode_raw(message.data)
            elif message.topic == records.LIDAR_ACCOUNT.topic:
                counted += records.decode_account(message.data).received
        session = log.metadata["swath.session"]
        mount = parse_mount(log.attachments["mount.yaml"].decode(), "log")
    packets = np.concatenate(lidar)
    capture = field_flight.capture
    assert packets["data"].tobytes() == capture.payloads(1206).tobytes()
    assert counted == len(packets)
    assert records.receive_time_ns(packets) * 1e-9 == pytest.approx(capture.arrival_s(1206), abs=1e-6)
    assert b"".join(chunk for _, chunk in position) == capture.payloads(512).tobytes()
    frames = b"".join(chunk for _, chunk in mavlink)
    tlog = (field_flight.directory / "telemetry.tlog").read_bytes()
    assert len(tlog) == len(frames) + 8 * len(mavlink)
    assert session["scene"] == "field"
    assert mount.lidar.pitch_deg == -20.0


def test_captured_packets_are_in_order_of_time(field_flight):
    times = [time_s for time_s, _ in field_flight.capture.frames]
    assert (np.diff(times) >= 0).all()


def test_the_log_carries_the_nominal_mount_and_the_truth_the_true_one(simulate):
    mount = MountOptions(boresight_deg=(0.5, -0.7, 1.0), lever_m=(0.01, 0.0, -0.02))
    recorded = simulate("field", 1.0, replace(perfect(Options()), mount=mount))
    true = recorded.truth["mount_true"]["lidar"]
    assert (true["yaw_deg"], true["pitch_deg"], true["roll_deg"]) == pytest.approx((0.5, -20.7, 1.0))
    assert true["position_m"] == pytest.approx([0.01, 0.0, -0.18])
    with LogReader(recorded.directory / "flight.mcap") as log:
        assert parse_mount(log.attachments["mount.yaml"].decode(), "log").lidar.pitch_deg == -20.0


def test_the_nominal_mount_is_that_of_the_source(simulate, pytestconfig):
    recorded = simulate("field", 1.0)
    shipped = load_mount(pytestconfig.rootpath / "firmware_config" / "mount.yaml")
    assert tuple(recorded.truth["mount_nominal"]["lidar"]["position_m"]) == shipped.lidar.position_m


def test_both_gyros_feel_the_same_motion_at_the_offset_that_the_truth_states(simulate, about):
    options = perfect(Options(), "ins")
    recorded = simulate("field", 30.0, replace(options, lidar=replace(options.lidar, dark=True)))
    truth, payloads = recorded.truth, recorded.capture.payloads(512)
    words = payloads[:, 14:38].copy().view("<i2").astype(np.int64) << 4
    gyros = (words.astype(np.int16) >> 4)[:, [0, 4, 8]] * np.radians(0.09766)
    tilt = about(0, np.radians([truth["mount_true"]["lidar"]["pitch_deg"]]))[0]
    lidar = np.stack([-gyros[:, 1], gyros[:, 0], gyros[:, 2]], axis=1) @ tilt.T
    lidar_s = payloads[:, 198:202].copy().view("<u4")[:, 0] * 1e-6
    messages = [m for _, m in recorded.mavlink() if m.get_type() == "ATTITUDE"]
    boot_s = np.array([m.time_boot_ms for m in messages]) * 1e-3
    # forward right down to right forward up
    ins = np.array([[m.pitchspeed, m.rollspeed, -m.yawspeed] for m in messages])
    expected_s = (truth["lidar_minus_boot_ns"] + 15.0e3 * truth["lidar_minus_boot_ppm"]) * 1e-9
    grid_s = np.arange(boot_s[0] + 1, boot_s[-1] - 1, 0.01)
    fine = np.stack([CubicSpline(boot_s, ins[:, axis])(grid_s) for axis in range(3)], axis=1)
    shifts_s = np.arange(-0.05, 0.0501, 0.002)
    match = []
    for shift_s in shifts_s:
        moved = np.stack([np.interp(grid_s + expected_s + shift_s, lidar_s, axis) for axis in lidar.T], axis=1)
        match.append(sum(np.corrcoef(moved[:, axis], fine[:, axis])[0, 1] for axis in range(3)))
    best = int(np.argmax(match))
    left, middle, right = match[best - 1 : best + 2]
    found_s = shifts_s[best] + 0.002 * 0.5 * (left - right) / (left - 2 * middle + right)
    assert middle > 2.7
    # noise of 1.1 deg/s at 200 Hz against motion of about 10 deg/s over 30 s: a fraction of a millisecond
    assert abs(found_s) < 0.0015


def test_truth_covers_the_flight_at_100_hz_and_more(field_flight):
    time_s = field_flight.pose_time_s
    assert time_s[0] == 0.0
    assert time_s[-1] == pytest.approx(6.0, abs=0.01)
    assert np.diff(time_s) == pytest.approx(0.002, abs=1e-6)


def test_a_folder_that_cannot_be_written_is_one_sentence_and_leaves_nothing(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(SwathError, match="cannot be written"):
        render(Job("field", 1.0, 1, blocked, Options()))
    assert list(tmp_path.iterdir()) == [blocked]
