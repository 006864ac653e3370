"""Position packets against the manual's figures, a real recording and the true motion."""

import os
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flightlog.nmea import parse_rmc
from simulator.config import Options, perfect
from simulator.telemetry import rmc_sentence

RECORDINGS = os.environ.get("SWATH_RECORDINGS")


def dark(options):
    """Without rays: quick."""
    return replace(options, lidar=replace(options.lidar, dark=True))


def words_of(payloads):
    return payloads[:, 14:38].copy().view("<u2").astype(np.int64)


def values_of(payloads):
    """The low 12 bits as two's complement, by arithmetic."""
    low = words_of(payloads) % 4096
    return np.where(low >= 2048, low - 4096, low)


def stamps_us(payloads):
    return payloads[:, 198:202].copy().view("<u4")[:, 0].astype(np.int64)


@pytest.fixture(scope="module")
def packets(field_flight):
    return field_flight.capture.payloads(512)


@pytest.fixture(scope="module")
def clean(simulate):
    """No noise, lidar locked to GPS."""
    options = perfect(Options())
    return simulate("field", 4.0, dark(replace(options, clocks=replace(options.clocks, lidar_gps=True))))


def test_words_carry_the_channel_tags_of_the_manual(packets):
    assert (words_of(packets) // 4096 == np.tile([0, 1, 2, 3], 3)).all()


def test_the_rest_of_a_packet_without_gps_is_zero(packets):
    assert not packets[:, :14].any()
    assert not packets[:, 38:198].any()
    assert not packets[:, 202:].any()


def test_packets_come_irregularly_about_200_times_a_second(packets):
    steps_us = np.diff(stamps_us(packets))
    # 1196 uniform intervals of 1.3 to 8.7 ms: their mean has a standard error of 0.06 ms
    assert steps_us.mean() == pytest.approx(5_000, abs=250)
    assert steps_us.min() > 1_290
    assert steps_us.max() < 9_800
    assert steps_us.std() > 1_500


def test_packets_arrive_0_3_ms_sooner_after_their_stamp_than_data_packets(field_flight):
    capture = field_flight.capture
    late = [
        np.median(capture.arrival_s(size) - stamp_us * 1e-6)
        for size, stamp_us in ((1206, field_flight.shots.stamp_us), (512, stamps_us(capture.payloads(512))))
    ]
    assert (late[0] - late[1]) * 1e6 == pytest.approx(300, abs=20)


def test_gyros_read_the_true_motion_on_the_axes_of_the_manual(clean, attitudes, about):
    payloads = clean.capture.payloads(512)
    reading = values_of(payloads)[:, [0, 4, 8]] * 0.09766
    # figure B2: rate about x is -gyro2, about y +gyro1, about z +gyro3
    sensor = np.stack([-reading[:, 1], reading[:, 0], reading[:, 2]], axis=1)
    true = attitudes(clean.poses)
    from scipy.spatial.transform import Rotation

    step = Rotation.from_matrix(np.swapaxes(true[:-1], 1, 2) @ true[1:]).as_rotvec()
    hz = clean.truth["options"]["truth_hz"]
    rates = np.degrees(step) * hz
    tilt = about(0, np.radians([clean.truth["mount_true"]["lidar"]["pitch_deg"]]))[0]
    middle_s = clean.pose_time_s[:-1] + 0.5 / hz
    start_ns = clean.truth["clocks"]["utc"]["start_ns"]
    time_s = stamps_us(payloads) * 1e-6 - (start_ns % 3_600_000_000_000) * 1e-9
    inside = (time_s > middle_s[0]) & (time_s < middle_s[-1])
    expected = np.stack([np.interp(time_s[inside], middle_s, axis) for axis in (rates @ tilt).T], axis=1)
    assert np.abs(expected).max(axis=0).min() > 3.0
    # rounding to half a step of 0.098 deg/s; lines between rates at 500 Hz, 3 Hz and 40 deg/s at most: w^2 r dt^2 / 8 = 0.007 deg/s;
    # truth.csv to a millionth of a degree: 0.0005 deg/s
    assert np.abs(sensor[inside] - expected).max() < 0.049 + 0.007 + 0.0005


def test_late_readings_are_those_of_before(simulate):
    """5 ms late: as a flight without delay has them at the moment 5 ms before; the two draw the same times of packets."""
    options = dark(perfect(Options()))
    late = replace(options, gyros=replace(options.gyros, delay_s=0.005))
    prompt, delayed = (simulate("field", 4.0, each) for each in (options, late))
    assert delayed.truth["lidar_imu_delay_s"] == 0.005
    assert prompt.truth["lidar_imu_delay_s"] == 0.0
    (time_s, reading), (_, older) = (
        (stamps_us(each.capture.payloads(512)) * 1e-6, values_of(each.capture.payloads(512))[:, [0, 2, 4, 8]])
        for each in (prompt, delayed)
    )
    inside = slice(10, None)
    at = np.stack([np.interp(time_s[inside] - 0.005, time_s, axis) for axis in reading.T], axis=1)
    # lines between readings up to 10 ms apart, of wander up to 3 Hz and 40 deg/s: w^2 r dt^2 / 8 = 0.18 deg/s or 2 steps; rounding on top
    assert np.abs(older[inside] - at).max() <= 4.0
    assert np.abs(older[inside] - reading[inside]).max() > 8.0


def test_accelerometers_at_rest_read_the_pull_of_gravity_on_their_axes(simulate):
    still = simulate("panels", 1.0, dark(perfect(Options())))
    accel_g = values_of(still.capture.payloads(512))[:, [2, 3, 6, 7, 10, 11]].mean(axis=0) * 0.001221
    # upright, [measured]: X of chips 1 and 2 reads +1 g, the level axes nothing
    assert accel_g == pytest.approx([1, 0, 1, 0, 0, 0], abs=0.0007)


def test_a_bias_of_the_accelerometers_is_of_the_force_on_the_lidars_axes(simulate):
    """Six readings of three axes: z, -x, z, -y, x, -y."""
    options = dark(perfect(Options()))
    biased = simulate("panels", 1.0, replace(options, gyros=replace(options.gyros, accel_bias_g=0.05)))
    x, y, z = biased.truth["lidar_accel_bias_g"]
    assert 0.01 < np.abs([x, y, z]).max() < 0.2
    accel_g = values_of(biased.capture.payloads(512))[:, [2, 3, 6, 7, 10, 11]].mean(axis=0) * 0.001221
    assert accel_g == pytest.approx([1 + z, -x, 1 + z, -y, x, -y], abs=0.0007)


def test_zero_offsets_and_noise_are_those_asked_for(simulate):
    still = simulate("panels", 3.0, dark(Options()))
    gyros = values_of(still.capture.payloads(512))[:, [0, 4, 8]] * 0.09766
    sigma = np.hypot(1.1, 0.3 / np.sqrt(2))
    assert gyros.mean(axis=0) == pytest.approx([-23.1, -7.1, -12.3], abs=4 * sigma / np.sqrt(len(gyros)) + 0.02)
    assert gyros.std(axis=0) == pytest.approx([sigma] * 3, rel=4 / np.sqrt(2 * len(gyros)))


def test_a_locked_lidar_counts_microseconds_past_the_utc_hour_and_says_so(clean):
    payloads = clean.capture.payloads(512)
    assert (payloads[:, 202] == 2).all()
    # the simulation starts at 10:17:03 UTC
    assert stamps_us(payloads)[0] == pytest.approx((17 * 60 + 3) * 1e6, abs=10_000)
    assert clean.shots.stamp_us[0] == (17 * 60 + 3) * 1_000_000


def test_the_sentence_lags_the_second_it_names(clean):
    payloads = clean.capture.payloads(512)
    for row, stamp_us in zip(payloads[::50], stamps_us(payloads)[::50], strict=True):
        text = row[206:].tobytes()
        assert text[: text.index(b"\0")].endswith(b"\r\n")
        rmc = parse_rmc(text.split(b"\0")[0].decode())
        assert rmc is not None
        assert 0.4 < stamp_us * 1e-6 - rmc.utc_ns * 1e-9 % 3600 < 1.5


def test_a_sentence_carries_the_checksum_of_nmea_0183():
    # the sum of the example in the standard's usual citation: XOR of all characters between $ and *
    sentence = rmc_sentence(1_400_000_000_000_000_000, 58.394, 15.574)
    body, checksum = sentence.strip()[1:].split("*")
    total = 0
    for character in body:
        total ^= ord(character)
    assert int(checksum, 16) == total
    assert body.startswith("GPRMC,165320,A,5823.6400,N,01534.4400,E,")


@pytest.mark.skipif(RECORDINGS is None, reason="SWATH_RECORDINGS is not set: no real recording to compare with")
def test_statistics_are_of_the_size_of_a_real_recordings(simulate):
    content = (Path(RECORDINGS or "") / "lidar" / "hdl32e_monterey.pcap").read_bytes()
    frames, at = [], 24
    while at < len(content):
        (size,) = struct.unpack_from("<I", content, at + 8)
        frames.append(content[at + 16 : at + 16 + size])
        at += 16 + size
    real = np.frombuffer(b"".join(f[42:] for f in frames if len(f) == 554), np.uint8).reshape(-1, 512)
    ours = simulate("panels", 3.0, dark(Options())).capture.payloads(512)
    assert (words_of(real) // 4096 == words_of(ours)[0] // 4096).all()
    assert np.diff(stamps_us(ours)).mean() == pytest.approx(np.diff(stamps_us(real)).mean(), rel=0.15)
    # the real unit's second gyro is twice as noisy as the two others
    noise = [np.median(values_of(p)[:, [0, 4, 8]].std(axis=0)) for p in (ours, real)]
    assert noise[0] == pytest.approx(noise[1], rel=0.15)
    for column in (2, 6):  # gravity on X of the first two chips, wherever the sensor stands level
        assert values_of(ours)[:, column].mean() == pytest.approx(values_of(real)[:, column].mean(), rel=0.06)
    assert np.quantile(np.diff(stamps_us(ours)), [0.05, 0.5, 0.95]) == pytest.approx(
        np.quantile(np.diff(stamps_us(real)), [0.05, 0.5, 0.95]), rel=0.15
    )


def test_gyros_have_a_line_at_the_rotors_frequency_on_each_axis(simulate):
    """Against the recording of a sensor on a tripod (below): 0.5, 0.6 and 0.2 deg/s by default."""
    options = perfect(Options())
    gyros = replace(options.gyros, rotor_line_deg_s=(2.0, 3.0, 1.0))
    flight = simulate("panels", 8.0, dark(replace(options, gyros=gyros)))
    payloads = flight.capture.payloads(512)
    assert lines_of(payloads, 10.0) == pytest.approx([2.0, 3.0, 1.0], abs=0.02)


def lines_of(payloads, hz):
    """Amplitude at a frequency of each gyro [deg/s], a parabola taken off."""
    reading, time_s = values_of(payloads)[:, [0, 4, 8]] * 0.09766, stamps_us(payloads) * 1e-6
    time_s = time_s - time_s[0]
    turn = 2 * np.pi * hz * time_s
    columns = np.stack([np.ones_like(turn), time_s, time_s**2, np.sin(turn), np.cos(turn)], axis=1)
    found = np.linalg.lstsq(columns, reading, rcond=None)[0]
    return np.hypot(found[3], found[4])


@pytest.mark.skipif(RECORDINGS is None, reason="SWATH_RECORDINGS is not set")
def test_the_default_lines_are_those_of_the_recording_on_a_tripod():
    """1.5 s at 706.5 rpm, noise of 1 to 2 deg/s: amplitudes are known to 0.1 to 0.2 deg/s, one sigma."""
    blob, payloads, at = (Path(RECORDINGS) / "lidar/hdl32e_monterey.pcap").read_bytes(), [], 24
    while at < len(blob):
        (size,) = struct.unpack_from("<I", blob, at + 8)
        if size == 42 + 512:
            payloads.append(np.frombuffer(blob, np.uint8, 512, at + 16 + 42))
        at += 16 + size
    found = lines_of(np.array(payloads), 706.511 / 60)
    assert found == pytest.approx(Options().gyros.rotor_line_deg_s, abs=0.2)
