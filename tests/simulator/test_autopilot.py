"""MAVLink of the simulated autopilot, read by pymavlink, against the truth and the figures of ArduCopter 3.1.3."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega
from scipy.spatial.transform import Rotation

from simulator.autopilot import Autopilot, achieved_hz
from simulator.clocks import clocks
from simulator.config import FaultOptions, Options, perfect
from simulator.flight import Flight
from simulator.geodesy import Origin
from simulator.ins import Ins
from simulator.scene import scene


def dark(options):
    """Without rays: quick."""
    return replace(options, lidar=replace(options.lidar, dark=True))


def with_link(options, **values):
    return replace(options, link=replace(options.link, **values))


@pytest.fixture(scope="module")
def clean(simulate):
    """Perfect instruments, MAVLink 2, ATTITUDE at 100 Hz."""
    options = with_link(perfect(Options()), version=2, firmware="modern", extra1_hz=100, raw_sensors_hz=100)
    return simulate("field", 6.0, dark(options))


def of_type(recorded, name):
    return [(time_s, message) for time_s, message in recorded.mavlink() if message.get_type() == name]


def true_angles(recorded, time_s):
    poses = recorded.poses
    angles = np.unwrap(np.radians([poses[name] for name in ("roll_deg", "pitch_deg", "heading_deg")]), axis=1)
    return np.stack([np.interp(time_s, recorded.pose_time_s, angle) for angle in angles], axis=1)


@pytest.mark.parametrize(("asked", "seen"), [(50, 25.0), (10, 50 / 6), (4, 50 / 13), (2, 50 / 26), (0, 0.0)])
def test_arducopter_3_1_3_serves_rates_in_ticks_of_50_hz(asked, seen):
    assert achieved_hz(asked, "3.1.3") == pytest.approx(seen)


def test_a_modern_autopilot_gives_what_is_asked():
    assert achieved_hz(100, "modern") == 100


def test_messages_come_at_those_rates(field_flight):
    count = Counter(message.get_type() for _, message in field_flight.mavlink())
    expected = {
        "ATTITUDE": 25.0, "RAW_IMU": 25.0, "SCALED_PRESSURE": 25.0, "GLOBAL_POSITION_INT": 8.33, "GPS_RAW_INT": 3.85,
        "SYS_STATUS": 3.85, "VFR_HUD": 3.85, "SYSTEM_TIME": 1.92, "HEARTBEAT": 1.0,
    }  # fmt: skip
    for name, rate_hz in expected.items():
        assert count[name] == pytest.approx(6.0 * rate_hz, abs=1)
    assert set(count) == set(expected)


@pytest.mark.parametrize(("name", "start", "around"), [("field_flight", 0xFE, 8), ("clean", 0xFD, 12)])
def test_frames_are_of_the_version_asked_for_without_a_gap(name, start, around, request):
    content = (request.getfixturevalue(name).directory / "telemetry.tlog").read_bytes()
    at, sequences = 0, []
    while at < len(content):
        assert content[at + 8] == start
        sequences.append(content[at + (10 if start == 0xFE else 12)])
        at += 8 + around + content[at + 9]
    assert sequences == [i % 256 for i in range(len(sequences))]


def test_attitude_is_the_true_one_at_its_stamp(clean):
    messages = [message for _, message in of_type(clean, "ATTITUDE")]
    time_s = clean.true_time_s("boot", np.array([m.time_boot_ms for m in messages]) * 1e-3)
    error = np.array([[m.roll, m.pitch, m.yaw] for m in messages]) - true_angles(clean, time_s)
    error = (error + np.pi) % (2 * np.pi) - np.pi
    # truth.csv at 500 Hz in straight lines: 3 Hz of 5 deg, (2 pi 3)^2 * 5 deg / 8 / 500^2
    assert np.degrees(np.abs(error)).max() < 0.001


def test_body_rates_integrate_to_the_attitude(clean):
    messages = [message for _, message in of_type(clean, "ATTITUDE")]
    time_s = np.array([m.time_boot_ms for m in messages]) * 1e-3
    rates = np.array([[m.rollspeed, m.pitchspeed, m.yawspeed] for m in messages])
    # aeronautical: forward right down, yaw then pitch then roll
    attitude = [Rotation.from_euler("ZYX", [m.yaw, m.pitch, m.roll]) for m in messages]
    from scipy.interpolate import CubicSpline

    fine_s = np.arange(time_s[0], time_s[-1], 0.001)
    turned = attitude[0]
    for rate in CubicSpline(time_s, rates)(fine_s[:-1] + 0.0005):
        turned = turned * Rotation.from_rotvec(rate * 0.001)
    last = int(np.searchsorted(time_s, fine_s[-1]))
    left = turned.inv() * attitude[min(last, len(attitude) - 1)]
    # rates of 40 deg/s over the last 10 ms at most, which the grid leaves out
    assert np.degrees(left.magnitude()) < 0.4


def test_position_is_the_true_one_by_pyproj(clean):
    pyproj = pytest.importorskip("pyproj")
    origin = clean.truth["local_origin"]
    east_north_up = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={origin['longitude_deg']} +lat_0={origin['latitude_deg']} "
        f"+h_0={origin['height_msl_m'] + origin['undulation_m']}"
    )
    for _, m in of_type(clean, "GLOBAL_POSITION_INT"):
        time_s = clean.true_time_s("boot", np.array([m.time_boot_ms * 1e-3]))
        true = [np.interp(time_s, clean.pose_time_s, clean.poses[name])[0] for name in ("east_m", "north_m", "up_m")]
        seen = east_north_up.transform(m.lon * 1e-7, m.lat * 1e-7, m.alt * 1e-3 + origin["undulation_m"])
        # half a step: 0.5e-7 deg is 5.6 mm of latitude, heights go in millimetres
        assert seen == pytest.approx(true, abs=0.0062)
        assert m.relative_alt * 1e-3 == pytest.approx(true[2], abs=0.001)


def test_raw_imu_counts_milli_g_and_milliradians_in_forward_right_down(clean):
    messages = [message for _, message in of_type(clean, "RAW_IMU")][:20]
    # hovering, gentle: gravity is felt upwards, down is positive
    assert np.mean([m.zacc for m in messages]) == pytest.approx(-1000, abs=15)
    rates = {m.time_boot_ms: m for _, m in of_type(clean, "ATTITUDE")}
    pairs = [(m, rates[m.time_usec // 1000]) for _, m in of_type(clean, "RAW_IMU") if m.time_usec // 1000 in rates]
    for raw, attitude in pairs:
        assert raw.xgyro == pytest.approx(attitude.rollspeed * 1000, abs=1.0)
        assert raw.zgyro == pytest.approx(attitude.yawspeed * 1000, abs=1.0)


def test_system_time_ties_boot_to_utc(clean):
    for _, m in of_type(clean, "SYSTEM_TIME"):
        true_s = (
            clean.true_time_s("utc", np.array([m.time_unix_usec // 1_000_000])) + m.time_unix_usec % 1_000_000 * 1e-6
        )
        boot_s = clean.true_time_s("boot", np.array([m.time_boot_ms * 1e-3]))
        assert true_s == pytest.approx(boot_s, abs=2e-6)


def test_frames_are_received_late_and_in_order(field_flight):
    messages = field_flight.mavlink()
    received_s = np.array([time_s for time_s, _ in messages])
    assert (np.diff(received_s) >= 0).all()
    pairs = [(t, m.time_boot_ms * 1e-3) for t, m in messages if m.get_type() == "ATTITUDE"]
    built_s = field_flight.true_time_s("boot", np.array([stamp_s for _, stamp_s in pairs]))
    start_s = field_flight.truth["clocks"]["host"]["start_ns"] // 1_000_000_000
    late_s = np.array([t - start_s for t, _ in pairs]) - 0.8 - built_s
    assert late_s.min() > 0.012
    assert 0.015 < late_s.mean() < 0.05


def spoken(options, seconds, seed):
    """A flight's ATTITUDE messages without its lidar, their true times, the flight and the INS."""
    flight = Flight(scene("field", seed).route, seconds, options.flight, seed)
    ins, clock = Ins(flight, options.ins, seed), clocks(options.clocks)
    autopilot = Autopilot(ins, clock, options, Origin(), seed)
    content = b"".join(frame.data for frame in autopilot.between(0.0, seconds, 0))
    messages = [m for m in ardupilotmega.MAVLink(None).parse_buffer(content) if m.get_type() == "ATTITUDE"]
    stamps_ns = np.array([m.time_boot_ms for m in messages]) * 1e6
    return messages, (stamps_ns - clock.boot.start_ns) * 1e-9 / (1 + clock.boot.drift_ppm * 1e-6), flight, ins


def test_the_compass_errs_with_heading_by_the_amplitude_asked_for():
    options = perfect(Options(), "ins")
    options = replace(options, ins=replace(options.ins, compass_bias_deg=8.0, compass_offset_deg=1.5))
    messages, time_s, flight, ins = spoken(options, 40.0, 3)
    heading = flight.poses(time_s).heading_rad
    error = (np.array([m.yaw for m in messages]) - heading + np.pi) % (2 * np.pi) - np.pi
    first, second = ins.compass_phase_rad
    model = 1.5 + 8.0 * np.sin(heading + first) + 2.4 * np.sin(2 * heading + second)
    assert np.degrees(error) == pytest.approx(model, abs=0.01)
    assert np.ptp(np.degrees(error)) > 5.0


def test_attitude_noise_is_of_the_size_asked_for():
    errors = []
    for seed in range(4):
        messages, time_s, flight, _ = spoken(Options(), 60.0, seed)
        poses = flight.poses(time_s)
        errors += [[m.roll for m in messages] - poses.roll_rad, [m.pitch for m in messages] - poses.pitch_rad]
    # 240 s of a process with tau 8 s on two axes: about 2 * 240 / 16 = 30 independent values
    assert np.degrees(np.sqrt(np.mean(np.square(errors)))) == pytest.approx(0.5, rel=3 / np.sqrt(2 * 30))


def test_a_reboot_is_silent_and_starts_another_clock_and_sequence(simulate):
    faults = FaultOptions(reboot_at_s=2.0, reboot_silence_s=1.0, garbage_per_s=5.0, lidar_gap_at_s=1.0, lidar_gap_s=0.5)
    recorded = simulate("field", 5.0, dark(replace(Options(), faults=faults)))
    stamps_ms = [m.time_boot_ms for _, m in of_type(recorded, "ATTITUDE")]
    back = np.flatnonzero(np.diff(stamps_ms) < 0)
    assert len(back) == 1
    assert stamps_ms[back[0] + 1] == pytest.approx(2_500, abs=60)
    after = recorded.truth["boot_clock_after_reboot"]
    assert (stamps_ms[-1] * 1e-3 - after["start_ns"] * 1e-9) == pytest.approx(5.0, abs=0.05)
    host_s = np.array([time_s for time_s, _ in recorded.mavlink()])
    assert np.diff(host_s).max() > 0.95
    gap_us = np.diff(recorded.shots.stamp_us).max()
    assert gap_us == pytest.approx(500_000, abs=600)
