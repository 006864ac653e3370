import struct

import numpy as np
import numpy.typing as npt
import pytest
import velodyne_decoder

from flightlog import hdl32e
from flightlog.errors import PacketError, WrongSensorError

Packets = list[tuple[int, bytes]]


def data_packets(packets: Packets) -> npt.NDArray[np.void]:
    return np.frombuffer(b"".join(payload for _, payload in packets), hdl32e.DATA_DTYPE)


def position_packets(packets: Packets) -> npt.NDArray[np.void]:
    return np.frombuffer(b"".join(payload for _, payload in packets), hdl32e.POSITION_DTYPE)


def manual_packet(mode: int = 0x37, product: int = 0x21, flag: int = 0xEEFF) -> bytes:
    """A data packet after appendix E of the manual: block b, laser k has range 1000 b + k and intensity b + k."""
    blocks = b""
    for b in range(12):
        returns = b"".join(struct.pack("<HB", 1000 * b + k, b + k) for k in range(32))
        blocks += struct.pack("<HH", flag, 3000 * b) + returns
    return blocks + struct.pack("<IBB", 3_599_999_999, mode, product)


def manual_position(words: list[int]) -> bytes:
    return struct.pack("<14x12H160xIB3x306s", *words, 123_456_789, 2, b"$GPRMC,*4B\r\n")


def test_a_data_packet_built_by_the_manual_reads_field_by_field() -> None:
    packet = np.frombuffer(manual_packet(), hdl32e.DATA_DTYPE)[0]
    b, k = np.mgrid[0:12, 0:32]
    assert (packet["blocks"]["flag"] == 0xEEFF).all()
    assert (packet["blocks"]["azimuth"] == 3000 * b[:, 0]).all()
    assert (packet["blocks"]["returns"]["range"] == 1000 * b + k).all()
    assert (packet["blocks"]["returns"]["intensity"] == b + k).all()
    assert (packet["stamp_us"], packet["return_mode"], packet["product"]) == (3_599_999_999, 0x37, 0x21)


def test_a_position_packet_built_by_the_manual_reads_field_by_field() -> None:
    words = [0x0001, 0x1002, 0x2003, 0x3004, 0x0FFF, 0x1000, 0x2FFE, 0x3FFD, 0x0800, 0x17FF, 0x2FFC, 0x3FFB]
    packets = np.frombuffer(manual_position(words), hdl32e.POSITION_DTYPE)
    assert len(manual_position(words)) == hdl32e.POSITION_BYTES
    assert hdl32e.is_position(packets).all()
    assert hdl32e.has_imu(packets).all()
    assert packets["words"].tolist() == [words]
    assert (packets["stamp_us"][0], packets["pps"][0]) == (123_456_789, hdl32e.PpsState.LOCKED)
    assert packets["nmea"][0] == b"$GPRMC,*4B\r\n"
    # gyros read 1, -1, -2048; manual, figure B2: about x -gyro2, about y +gyro1, about z +gyro3
    assert hdl32e.gyro_deg_s(packets)[0] == pytest.approx([0.09766, 0.09766, -2048 * 0.09766])
    assert hdl32e.temperature_c(packets)[0] == pytest.approx(np.array([2, 0, 2047]) * 0.1453 + 25)
    # readings are gravity on +x: acc1Y, acc3X-; +y: acc2Y, acc3Y; +z: acc1X-, acc2X-; specific force is the opposite
    acc1x, acc1y, acc2x, acc2y, acc3x, acc3y = 3, 4, -2, -3, -4, -5
    expected = np.array([-(acc1y - acc3x), -(acc2y + acc3y), acc1x + acc2x]) / 2 * 0.001221
    assert hdl32e.accel_g(packets)[0] == pytest.approx(expected)


def test_every_recorded_data_packet_is_one(monterey_data: Packets) -> None:
    packets = data_packets(monterey_data)
    assert len(packets) == 2702
    assert hdl32e.is_data(packets).all()
    for _, payload in monterey_data[:100]:
        hdl32e.check_data(payload, "monterey")


def test_recorded_stamps_advance_by_one_packet_time(monterey_data: Packets) -> None:
    steps_us = np.diff(data_packets(monterey_data)["stamp_us"].astype(np.int64))
    assert set(steps_us) == {552, 553}
    # the stamp is cut to whole microseconds: the mean over n steps is known to 1 us / n
    assert steps_us.mean() * 1000 == pytest.approx(
        hdl32e.PACKET_NS, abs=1000 / len(steps_us) + 58e-6 * hdl32e.PACKET_NS
    )


def test_the_turn_rate_of_the_recording_is_the_one_its_card_states(monterey_data: Packets) -> None:
    azimuth = data_packets(monterey_data)["blocks"]["azimuth"].astype(np.int64)
    firings = (len(monterey_data) - 1) * hdl32e.BLOCKS
    turned = (np.diff(azimuth.ravel()[: firings + 1]) % hdl32e.AZIMUTH_STEPS).sum() / hdl32e.AZIMUTH_STEPS
    assert turned / (firings * hdl32e.FIRING_NS * 1e-9) * 60 == pytest.approx(706, abs=1)
    assert (azimuth == hdl32e.AZIMUTH_STEPS).sum() == 1  # an azimuth of 360 deg does occur


def test_no_return_is_range_zero_and_nothing_else(monterey_data: Packets) -> None:
    returns = data_packets(monterey_data)["blocks"]["returns"]
    silent = returns["range"] == 0
    assert silent.mean() == pytest.approx(0.159, abs=0.0005)
    assert (returns["intensity"][silent] > 0).all()


def test_the_recorded_position_packets_are_told_by_their_tags(monterey_position: Packets) -> None:
    packets = position_packets(monterey_position)
    assert len(packets) == 299
    assert hdl32e.is_position(packets).all()
    assert hdl32e.has_imu(packets).all()


def test_the_gyros_of_the_resting_recording_show_their_zero_offsets(monterey_position: Packets) -> None:
    gyro1, gyro2, gyro3 = -5.3, -3.6, -29.4
    rate = hdl32e.gyro_deg_s(position_packets(monterey_position)).mean(axis=0)
    assert rate == pytest.approx([-gyro2, gyro1, gyro3], abs=0.05)


def test_the_accelerometers_of_the_resting_recording_feel_the_ground_push_up(monterey_position: Packets) -> None:
    force_g = hdl32e.accel_g(position_packets(monterey_position)).mean(axis=0)
    assert 0.94 < force_g[2] < 1.02  # 0.96 to 1.00 g by chip, a mean of two chips
    assert np.hypot(force_g[0], force_g[1]) < 0.15


def test_the_pairs_of_accelerometers_agree_with_the_axes_of_the_manual(monterey_position: Packets) -> None:
    words = position_packets(monterey_position)["words"].astype(np.int64) & 0xFFF
    x1, y1, x2, y2, x3, y3 = ((words ^ 0x800) - 0x800)[:, [2, 3, 6, 7, 10, 11]].T
    assert np.corrcoef(y1, x3)[0, 1] == pytest.approx(-0.988, abs=0.001)
    assert np.corrcoef(y2, y3)[0, 1] == pytest.approx(0.997, abs=0.001)
    assert np.corrcoef(x1, x2)[0, 1] == pytest.approx(0.90, abs=0.01)


def test_stamp_and_pulse_state_are_where_velodyne_decoder_finds_them(
    monterey_position: Packets, vlp16_position: Packets
) -> None:
    for _, payload in monterey_position + vlp16_position:
        ours = np.frombuffer(payload, hdl32e.POSITION_DTYPE)[0]
        theirs = velodyne_decoder.TelemetryPacket(payload)
        assert ours["stamp_us"] == theirs.usec_since_toh
        assert int(ours["pps"]) == theirs.pps_status.value


def test_the_elevations_are_those_of_velodyne_decoder() -> None:
    text = str(velodyne_decoder.Calibration.default_calibs[velodyne_decoder.Model.HDL32E])
    theirs = [float(line.split(":")[1]) for line in text.splitlines() if "vert_correction" in line]
    assert np.rad2deg(theirs) == pytest.approx(hdl32e.ELEVATION_DEG, abs=1e-5)  # they print nine digits of a float32


def test_the_elevations_are_a_comb_of_four_thirds_of_a_degree() -> None:
    k = np.arange(32)
    ring = np.where(k % 2 == 0, k // 2, 16 + k // 2)
    assert (ring == hdl32e.RING).all()
    comb = -30 - 2 / 3 + ring * 4 / 3
    assert np.abs(hdl32e.ELEVATION_DEG - comb).max() < 0.005  # printed to 0.01 deg


def test_dual_return_shares_a_firing_between_two_blocks() -> None:
    assert hdl32e.firing_index(0x39).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert repr([hdl32e.packet_ns(mode) for mode in (0x39, 0x37)]) == "[276480, 552960]", "whole nanoseconds"


def test_every_packet_of_a_vlp16_is_refused_by_name(vlp16_data: Packets) -> None:
    assert not hdl32e.is_data(data_packets(vlp16_data)).any()
    with pytest.raises(
        WrongSensorError, match=r"^vlp16\.pcap: product id 0x22 is VLP-16; an HDL-32E \(0x21\) is needed$"
    ):
        hdl32e.check_data(vlp16_data[0][1], "vlp16.pcap")


def test_the_position_packets_of_a_vlp16_carry_no_gyros(vlp16_position: Packets) -> None:
    packets = position_packets(vlp16_position)
    assert hdl32e.is_position(packets).all()
    assert not hdl32e.has_imu(packets).any()


@pytest.mark.parametrize(
    ("payload", "error", "words"),
    [
        (b"", PacketError, "1206 bytes, this one 0"),
        (manual_packet()[:-1], PacketError, "1206 bytes, this one 1205"),
        (manual_packet(flag=0xDDFF), PacketError, "not every block starts with FF EE"),
        (manual_packet(mode=0x36), PacketError, "return mode 0x36"),
        (manual_packet(mode=0), PacketError, "return mode 0x00"),
        (manual_packet(product=0x28), WrongSensorError, "VLP-32C"),
        (manual_packet(product=0), WrongSensorError, "0x00 is an unknown sensor"),
        (b"\xff\xdd" + manual_packet()[2:], WrongSensorError, "HDL-64E"),
        (manual_packet(product=0xA1), WrongSensorError, "VLS-128"),
        (manual_packet(product=0x77), WrongSensorError, "0x77 is an unknown sensor"),
    ],
)
def test_what_is_no_packet_of_an_hdl32e_is_refused_in_one_sentence(
    payload: bytes, error: type[PacketError], words: str
) -> None:
    with pytest.raises(error) as caught:
        hdl32e.check_data(payload, "port 2368")
    assert str(caught.value).startswith("port 2368: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_each_packet_is_told_by_itself_whatever_came_with_it() -> None:
    upper_and_lower = bytearray(manual_packet())
    upper_and_lower[1::200] = bytes([0xDD]) * len(upper_and_lower[1::200])
    kinds = [
        manual_packet(0x37),
        manual_packet(0x38),
        manual_packet(0x39),
        bytes(upper_and_lower),
        manual_packet(0x36),
        manual_packet(flag=0),
    ]
    packets = np.frombuffer(b"".join(kinds), hdl32e.DATA_DTYPE)
    assert hdl32e.is_data(packets).tolist() == [True, True, True, False, False, False]
    assert hdl32e.is_hdl64e(packets).tolist() == [False, False, False, True, False, False]
    tags = [tag << 12 for tag in (0, 1, 2, 3)] * 3
    many = [
        manual_position(tags),
        b"\x01" + manual_position(tags)[1:],
        manual_position([0] * 12),
        manual_position([7] * 12),
    ]
    positions = np.frombuffer(b"".join(many), hdl32e.POSITION_DTYPE)
    assert hdl32e.is_position(positions).tolist() == [True, False, True, False]
    assert hdl32e.has_imu(positions).tolist() == [True, True, False, False]


def test_one_wrong_block_flag_among_twelve_is_enough_to_refuse() -> None:
    payload = bytearray(manual_packet())
    payload[700] ^= 0x80
    assert not hdl32e.is_data(np.frombuffer(bytes(payload), hdl32e.DATA_DTYPE))[0]
    with pytest.raises(PacketError):
        hdl32e.check_data(bytes(payload), "port 2368")


def test_old_firmware_that_leaves_mode_and_product_blank_is_accepted() -> None:
    payload = manual_packet(mode=0, product=0)
    hdl32e.check_data(payload, "port 2368")
    assert hdl32e.is_data(np.frombuffer(payload, hdl32e.DATA_DTYPE)).all()


def test_refusing_and_telling_apart_agree_for_every_mode_and_product() -> None:
    payload = manual_packet()[:-2]
    for mode in range(256):
        for product in (0, 0x21, 0x22, 0x99):
            whole = payload + bytes((mode, product))
            accepted = bool(hdl32e.is_data(np.frombuffer(whole, hdl32e.DATA_DTYPE))[0])
            if accepted:
                hdl32e.check_data(whole, "x")
            else:
                with pytest.raises(PacketError):
                    hdl32e.check_data(whole, "x")


@pytest.mark.parametrize("words", [[0] * 12, [tag << 12 | 5 for tag in (0, 1, 2, 3)] * 3])
def test_position_packets_need_leading_zeros(words: list[int]) -> None:
    payload = manual_position(words)
    assert hdl32e.is_position(np.frombuffer(payload, hdl32e.POSITION_DTYPE)).all()
    for place in range(14):
        wrong = payload[:place] + b"\x01" + payload[place + 1 :]
        assert not hdl32e.is_position(np.frombuffer(wrong, hdl32e.POSITION_DTYPE)).any()


def test_position_packets_with_other_tags_are_none() -> None:
    words = [tag << 12 for tag in (0, 1, 2, 3)] * 3
    words[5] ^= 0x2000
    assert not hdl32e.is_position(np.frombuffer(manual_position(words), hdl32e.POSITION_DTYPE)).any()


def test_no_packets_at_all_are_no_special_case() -> None:
    nothing = np.empty(0, hdl32e.POSITION_DTYPE)
    assert hdl32e.is_position(nothing).shape == (0,)
    assert hdl32e.gyro_deg_s(nothing).shape == (0, 3)
    assert hdl32e.accel_g(nothing).shape == (0, 3)
    assert hdl32e.is_data(np.empty(0, hdl32e.DATA_DTYPE)).shape == (0,)


def test_the_shared_tables_cannot_be_changed_by_accident() -> None:
    for shared in (hdl32e.ELEVATION_DEG, hdl32e.RING, hdl32e.SENSOR_FROM_GYROS):
        with pytest.raises(ValueError, match="read-only"):
            shared[0] = 0
