"""Which Velodyne sent a packet, and what packets tell before they are decoded: packets built by the manual."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from velodynes import packets_of

from flightlog import hdl32e, records
from flightlog.errors import PacketError, WrongSensorError
from groundproc import sensors
from groundproc.sensors import velodyne
from groundproc.sensors.blocks import block_period_ns, limits, period_fits
from groundproc.sensors.shots import Gate
from groundproc.sensors.velodyne import Velodyne

Turning = Callable[..., list[tuple[int, bytes]]]
HDL32E, VLP16 = sensors.lidar("HDL-32E"), sensors.lidar("VLP-16")


def turned(turning: Turning, seconds: float = 0.02, **options: object) -> npt.NDArray[np.void]:
    return packets_of([payload for _, payload in turning(seconds, **options)])


def slowed(packets: npt.NDArray[np.void], block_us: float = 110.592) -> npt.NDArray[np.void]:
    """The same packets from a sensor whose blocks are further apart: a VLP-16's."""
    late = packets.copy()
    late["stamp_us"] = np.rint(packets["stamp_us"] * (block_us / 46.08))
    return late


# The period of the blocks ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rpm", [300.0, 600.0, 1200.0])
@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize("fov_deg", [None, (200.0, 160.0)])
def test_blocks_are_46_us_apart_whatever_the_rate_the_mode_and_the_window(
    turning: Turning, rpm: float, dual: bool, fov_deg: tuple[float, float] | None
) -> None:
    """Azimuths are whole steps of 0.01 deg: one in eleven steps of 8 to 33 of them, halved by the median of many packets."""
    packets = turned(turning, 0.3, rpm=rpm, dual=dual, fov_deg=fov_deg)
    period_ns = block_period_ns(packets)
    assert period_ns is not None
    assert period_ns == pytest.approx(46_080, rel=0.05)
    lost = packets[np.random.default_rng(1).random(len(packets)) > 0.3]
    assert block_period_ns(lost) == pytest.approx(46_080, rel=0.05)


def test_the_period_is_found_over_the_top_of_the_hour(turning: Turning) -> None:
    packets = turned(turning, 0.02, start_us=3_600_000_000 - 10_000)
    assert packets["stamp_us"].max() > 3_599_000_000
    assert packets["stamp_us"].min() < 20_000
    assert block_period_ns(packets) == pytest.approx(46_080, rel=0.05)


def test_eight_pairs_of_packets_prove_a_period_and_seven_do_not(turning: Turning) -> None:
    packets = turned(turning)
    assert block_period_ns(packets[:9]) is not None
    assert block_period_ns(packets[:8]) is None
    assert block_period_ns(packets[:1]) is None
    assert block_period_ns(packets[:0]) is None


def test_a_sensor_that_stands_still_and_stamps_that_do_not_go_on_prove_nothing(turning: Turning) -> None:
    packets = turned(turning)
    for field, value in (("azimuth", 100), ("stamp_us", 5)):
        still = packets.copy()
        (still["blocks"] if field == "azimuth" else still)[field] = value
        assert block_period_ns(still) is None
    sparse = packets.copy()
    sparse["stamp_us"] = np.arange(len(packets)) * 20_000  # the sensor may have turned once more in between
    assert block_period_ns(sparse) is None


def test_a_period_within_a_quarter_is_a_models_and_an_unknown_one_proves_nothing() -> None:
    assert period_fits(None, 46_080)
    assert period_fits(46_080 * 1.24, 46_080)
    assert period_fits(46_080 * 0.76, 46_080)
    assert not period_fits(46_080 * 1.26, 46_080)
    assert not period_fits(46_080 * 0.74, 46_080)
    assert not period_fits(55_296 * 2, 46_080), "a VLP-16's blocks"


# Whose packets ----------------------------------------------------------------------------------------------------------


def test_a_model_takes_its_own_and_names_the_others(turning: Turning) -> None:
    mine = turned(turning)
    HDL32E.check(mine, "a.pcap")
    other = mine.copy()
    other["product"] = 0x22
    with pytest.raises(WrongSensorError, match=r"^a\.pcap: product id 0x22 is a VLP-16; a HDL-32E \(0x21\) is needed$"):
        HDL32E.check(other, "a.pcap")
    VLP16.check(slowed(other), "a.pcap")
    other["product"] = 0x77
    with pytest.raises(WrongSensorError, match=r"0x77 is an unknown sensor; a VLP-16 \(0x22\) is needed$"):
        VLP16.check(other, "a.pcap")
    upper_and_lower = mine.copy()
    upper_and_lower["blocks"]["flag"][:, 1::2] = 0xDDFF
    with pytest.raises(WrongSensorError, match=r"^a\.pcap: blocks that start with FF DD are an HDL-64E's; a HDL-32E"):
        HDL32E.check(upper_and_lower, "a.pcap")
    for model in (HDL32E, VLP16):
        model.check(mine[:0], "a.pcap")


def test_a_packet_of_another_model_among_its_own_is_no_reason_to_refuse(turning: Turning) -> None:
    mixed = turned(turning).copy()
    mixed["product"][3] = 0x77
    HDL32E.check(mixed, "a.pcap")
    assert HDL32E.valid(mixed).sum() == len(mixed) - 1


def test_timing_tells_a_product_that_two_models_send(turning: Turning) -> None:
    """A prototype of the VLP-16 states the HDL-32E's product."""
    fast, slow = turned(turning), slowed(turned(turning))
    VLP16.check(slow, "a.pcap")
    with pytest.raises(WrongSensorError, match=r"its blocks are 11\d\.\d us apart; a HDL-32E has 46\.08 us$"):
        HDL32E.check(slow, "a.pcap")
    with pytest.raises(WrongSensorError, match=r"its blocks are 4\d\.\d us apart; a VLP-16 has 110\.59 us$"):
        VLP16.check(fast, "a.pcap")
    # too few to tell: its owner is believed, who borrowed it is not
    HDL32E.check(fast[:5], "a.pcap")
    with pytest.raises(WrongSensorError, match=r"its blocks are unknown; a VLP-16 has 110\.59 us$"):
        VLP16.check(slow[:5], "a.pcap")
    slow["product"] = 0x22
    VLP16.check(slow[:5], "a.pcap")


@pytest.mark.parametrize(
    ("mode", "product", "hdl32e_s", "vlp16_s"),
    [
        (0x37, 0x21, True, True), (0x38, 0x21, True, True), (0x39, 0x21, True, True), (0x37, 0x22, False, True),
        (0x36, 0x21, False, False), (0x00, 0x00, True, False), (0x00, 0x21, False, False), (0x37, 0x00, False, False),
        (0x39, 0x24, False, False),
    ],
)  # fmt: skip
def test_mode_and_product_say_whose_a_packet_may_be(
    data_payload: Callable[..., bytes], mode: int, product: int, hdl32e_s: bool, vlp16_s: bool
) -> None:
    packet = packets_of([data_payload(0, range(12), mode=mode, product=product)])
    assert HDL32E.valid(packet).tolist() == [hdl32e_s]
    assert VLP16.valid(packet).tolist() == [vlp16_s]
    # the recorder's own rule, which shares no line with it
    assert hdl32e.is_data(packet).tolist() == [hdl32e_s]
    wrong = packet.copy()
    wrong["blocks"]["flag"][0, 7] = 0xDDFF
    assert not HDL32E.valid(wrong).any()
    both = np.concatenate([packet, wrong])
    assert HDL32E.valid(both).tolist() == [hdl32e_s, False], "one bad block spoils its own packet only"


# What they tell ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("model", "packet_ns"), [(HDL32E, 552_960), (VLP16, 1_327_104)])
def test_packets_tell_of_themselves_before_they_are_decoded(
    data_payload: Callable[..., bytes], model: Velodyne, packet_ns: int
) -> None:
    azimuths = [*range(35_900, 36_001, 10), 5]
    logged = np.zeros(2, records.SCAN_PACKET_DTYPE)
    logged["data"] = packets_of([data_payload(7, azimuths), data_payload(3_599_999_999, azimuths, mode=0x39)])
    logged["data"]["blocks"]["returns"]["range"][0, 3, :5] = 0
    digest = model.digest(logged)
    assert digest.azimuth_cdeg.tolist() == [[*range(35_900, 36_000, 10), 0, 5]] * 2
    assert digest.mode.tolist() == [0x37, 0x39]
    assert digest.record_ns.tolist() == [packet_ns, packet_ns // 2]
    assert digest.returns == 2 * 12 * 32 - 5
    assert {array.dtype.kind for array in (digest.azimuth_cdeg, digest.record_ns, model.stamp_ns(logged))} == {"i"}
    assert model.stamp_ns(logged).tolist() == [7_000, 3_599_999_999_000]
    assert model.same_kind(logged[:1], logged[:1])
    assert not model.same_kind(logged, logged), "the last of the ones is dual, the first of the others single"
    assert model.records_s == round(1e9 / packet_ns)
    assert {model.mode_names[code] for code in (0x37, 0x38, 0x39, 0)} == {"strongest", "last", "dual", "unknown"}


@pytest.mark.parametrize("model", [HDL32E, VLP16])
def test_blanks_are_packets_of_each_mode_without_a_return(model: Velodyne) -> None:
    shots = [list(model.decode(blank, np.zeros(len(blank), np.int64))) for blank in model.blanks()]
    assert [len(part) for parts in shots for part in parts] == [0, 0]
    assert [part.gated.no_return for parts in shots for part in parts] == [2 * 384, 2 * 192]


@pytest.mark.parametrize("model", [HDL32E, VLP16])
def test_all_shots_are_told_where_those_without_an_echo_are_wanted(
    data_payload: Callable[..., bytes], model: Velodyne
) -> None:
    logged = np.zeros(1, records.SCAN_PACKET_DTYPE)
    logged["data"] = packets_of([data_payload(7, range(0, 120, 10))])
    ranges = logged["data"]["blocks"]["returns"]["range"]
    ranges[:] = 700
    ranges[0, 3, :5], ranges[0, 3, 5] = 0, 1
    before = logged.copy()
    told = model.with_all_shots(logged)
    assert (logged["data"] == before["data"]).all(), "what was recorded stays as it is"
    (shots,) = model.decode(told, np.zeros(1, np.int64))
    assert len(shots) == 12 * 32
    assert np.count_nonzero(np.isclose(shots.range_m, model.nothing_m)) == 6
    assert np.count_nonzero(np.isclose(shots.range_m, 1.4)) == 12 * 32 - 6


def test_position_packets_give_rates_and_forces_in_si(position_payload: Callable[..., bytes]) -> None:
    content = [position_payload(5, b"$GPRMC,1", pps=2), bytes(512)]
    packets = velodyne.position_packets(b"".join(content))
    assert velodyne.is_position(packets).tolist() == [True, True]
    found = velodyne.readings(packets)
    # every word of the first reads 5: gyro2 to the left, so minus about x; forces of a pair cancel or add up
    np.testing.assert_allclose(found.gyro_rad_s[0], np.deg2rad(5 * 0.09766 * np.array([-1.0, 1.0, 1.0])))
    np.testing.assert_allclose(
        found.accel_m_s2[0], 5 * 0.001221 * 9.80665 * np.array([0.0, -1.0, 1.0]), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(found.temperature_c[0], 25.0 + 5 * 0.1453)
    assert found.has_imu.tolist() == [True, False]
    assert found.pps.tolist() == [2, 0]
    assert found.sentences.tolist() == [b"$GPRMC,1", b""]


# A gate in the packets' units ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("near_m", "far_m", "low", "high"),
    [(0.0, 200.0, 1, 65_535), (0.5, 100.0, 250, 50_000), (0.501, 100.001, 251, 50_000), (0.002, 131.07, 1, 65_535),
     (0.6, 0.6, 300, 300), (1.0, 131.068, 500, 65_534)],
)  # fmt: skip
def test_a_range_gate_lets_through_just_the_steps_of_2_mm_within_it(
    near_m: float, far_m: float, low: int, high: int
) -> None:
    found = limits(Gate(255.0, 105.5, near_m, far_m))
    assert (found.low, found.high) == (low, high)
    assert (found.start, found.width) == (25_500.0, 21_050.0)


def test_one_batch_has_one_return_mode(data_payload: Callable[..., bytes]) -> None:
    both = packets_of([data_payload(0, range(12)), data_payload(0, range(12), mode=0x39)])
    pieces = [len(shots) for shots in HDL32E.decode(both, np.zeros(2, np.int64))]
    assert pieces == [384, 192]
    with pytest.raises(
        PacketError, match=r"^lidar packets: single and dual return mode in one batch, expected one mode$"
    ):
        velodyne.firings.decode(HDL32E.firing, both, np.zeros(2, np.int64), None, HDL32E.lasers)
