"""Shots against velodyne-decoder on a recording, and against a plain loop written from the manual."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import velodyne_decoder
from hypothesis import given, settings
from hypothesis import strategies as st
from velodynes import Manual, Told, by_hand, by_velodyne_decoder, packets_of, payloads

from flightlog import hdl32e, records
from flightlog.errors import PacketError
from groundproc.sensors import firings
from groundproc.sensors import hdl32e as model
from groundproc.sensors.shots import Gate, LaserTable, Shots

# 63-9113 Rev A, page 10, retyped: elevation of each laser in firing order
ELEVATIONS_DEG = [
    -30.67, -9.33, -29.33, -8.00, -28.00, -6.67, -26.67, -5.33, -25.33, -4.00, -24.00, -2.67, -22.67, -1.33, -21.33, 0.00,
    -20.00, 1.33, -18.67, 2.67, -17.33, 4.00, -16.00, 5.33, -14.67, 6.67, -13.33, 8.00, -12.00, 9.33, -10.67, 10.67,
]  # fmt: skip
MANUAL = Manual(ELEVATIONS_DEG, [0.0] * 32, laser_ns=1_152, firing_ns=46_080, block_ns=46_080)


def decode(
    packets: npt.NDArray[np.void],
    time_ns: npt.NDArray[np.int64],
    gate: Gate | None = None,
    lasers: LaserTable | None = None,
) -> Shots:
    """Packets of one mode by the HDL-32E's file."""
    return firings.decode(model.LIDAR.firing, packets, time_ns, gate, lasers or model.LIDAR.lasers)


def assert_same(shots: Shots, expected: Told) -> None:
    """Whole numbers equal, coordinates to what float32 holds of them (131 m: 8 um)."""
    assert len(shots) == len(expected.returns)
    assert (shots.gated.outside_fov, shots.gated.no_return, shots.gated.out_of_range) == expected[1:]
    if not expected.returns:
        return
    time_ns, x, y, z, azimuth, ranges, intensity, laser, returns = (
        np.array(column) for column in zip(*expected.returns, strict=True)
    )
    assert (shots.time_ns == time_ns).all()
    assert (shots.range_m == (ranges * 0.002).astype(np.float32)).all()
    assert (shots.intensity == intensity).all()
    assert (shots.laser == laser).all()
    assert (shots.returns == returns).all()
    np.testing.assert_allclose(shots.xyz_m, np.stack([x, y, z], axis=1), rtol=0, atol=1e-5)
    off = (np.rad2deg(shots.azimuth_rad) * 100 - azimuth + 18_000) % 36_000 - 18_000
    assert np.abs(off).max() < 0.001  # of coordinates as float32: 2^-24 each, 1e-7 rad together


@pytest.fixture(scope="module")
def monterey(recordings: Path) -> list[bytes]:
    return payloads(recordings / "lidar/hdl32e_monterey.pcap")


def test_a_recording_decodes_as_velodyne_decoder_decodes_it(monterey: list[bytes]) -> None:
    theirs = by_velodyne_decoder(monterey, velodyne_decoder.Model.HDL32E, 553e-6)
    ours = decode(packets_of(monterey), np.arange(len(monterey), dtype=np.int64) * 553_000)
    assert len(ours) == len(theirs) > 800_000
    assert (ours.intensity == theirs["intensity"]).all()
    assert (hdl32e.RING[ours.laser] == theirs["ring"]).all()
    # their x is forward, their y left; their vertical offset leaves the horizontal distance alone
    elevation = np.deg2rad(np.array(ELEVATIONS_DEG))[ours.laser]
    their_steps = np.hypot(theirs["x"].astype(float), theirs["y"]) / np.cos(elevation) / 0.002
    assert np.abs(their_steps - ours.range_m / 0.002).max() < 0.05  # float32
    across = np.hypot(ours.xyz_m[:, 0] + theirs["y"], ours.xyz_m[:, 1] - theirs["x"])
    assert across.mean() < 0.001
    # they take the step over the packet from its ends, we its median: both know it to an encoder step of 0.01 deg
    assert (across <= np.deg2rad(0.011) * ours.range_m).all()


@pytest.mark.parametrize("mode", [hdl32e.ReturnMode.STRONGEST, hdl32e.ReturnMode.LAST, hdl32e.ReturnMode.DUAL])
def test_shots_are_timed_as_velodyne_decoder_times_them(monterey: list[bytes], mode: int) -> None:
    # the mode byte of real packets is changed, as no dual return recording is at hand; equal azimuths per pair of blocks
    packets = packets_of(monterey[:10]).copy()
    packets["return_mode"] = mode
    packets["blocks"]["returns"]["range"] = np.arange(1000, 1384).reshape(12, 32)  # no equal echoes, no empty ones
    if mode == hdl32e.ReturnMode.DUAL:
        packets["blocks"]["azimuth"][:, 1::2] = packets["blocks"]["azimuth"][:, ::2]
    points = by_velodyne_decoder([packet.tobytes() for packet in packets], velodyne_decoder.Model.HDL32E, 553e-6)
    shots = decode(packets, np.zeros(10, np.int64))
    assert len(points) == len(shots) == 10 * 12 * 32
    seconds = points["time"].astype(float).reshape(10, -1)
    theirs_ns = np.sort((seconds - seconds.min(axis=1, keepdims=True)) * 1e9, axis=1)
    ours_ns = np.sort(shots.time_ns.reshape(10, -1), axis=1)
    # float32 seconds within a scan of 0.1 s are good to 4 ns
    assert np.abs(theirs_ns - ours_ns).max() < 10


def test_a_recording_decodes_as_the_loop_by_hand_does(monterey: list[bytes]) -> None:
    chosen = [p for p in monterey if any(struct.unpack_from("<H", p, 100 * b + 2)[0] == 36_000 for b in range(12))]
    assert chosen, "the recording has an azimuth of 36000"
    for payload in [*chosen, *monterey[::300]]:
        for gate in (Gate(), Gate(255.0, 105.0, 1.0, 70.0)):
            shots = decode(packets_of([payload]), np.array([7_000_000_000], np.int64), gate)
            assert_same(shots, by_hand(MANUAL, payload, 7_000_000_000, gate))


@st.composite
def turning_packet(draw: st.DrawFn) -> bytes:
    """A packet of a sensor that turns at 5 to 20 Hz, perhaps with a hole in its azimuths; few distinct ranges, so that pairs meet."""
    dual = draw(st.booleans())
    step = draw(st.floats(8.0, 34.0))
    first = draw(st.one_of(st.integers(0, 36_000), st.sampled_from([10_480, 10_499, 25_490, 35_950, 35_999, 36_000])))
    hole_at, hole = draw(st.integers(1, 11)), draw(st.sampled_from([0, 0, 4_000, 21_000]))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    ranges = rng.choice([0, 0, 1, 499, 500, 501, 2_500, 30_000, 50_000, 50_001, 65_535], (12, 32))
    intensities = rng.choice([0, 7, 255], (12, 32))
    blocks = b""
    for block in range(12):
        firing = block // 2 if dual else block
        azimuth = round(first + firing * step + (hole if firing >= hole_at else 0))
        azimuth = azimuth if azimuth <= 36_000 else azimuth % 36_000
        blocks += struct.pack("<HH", 0xEEFF, azimuth)
        blocks += b"".join(struct.pack("<HB", *v) for v in zip(ranges[block], intensities[block], strict=True))
    return blocks + struct.pack("<IBB", 123, 0x39 if dual else draw(st.sampled_from([0x37, 0x38])), 0x21)


GATES = st.sampled_from([
    Gate(), Gate(255.0, 105.0), Gate(105.0, 255.0), Gate(-105.0, 105.0, 1.0, 100.0), Gate(0.0, 360.0, 1.0, 100.0),
    Gate(359.9, 0.1), Gate(12.0, 12.5, 0.5, 60.0), Gate(90.0, 90.0),
])  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(payload=turning_packet(), gate=GATES)
def test_any_packet_decodes_as_the_loop_by_hand_does(payload: bytes, gate: Gate) -> None:
    shots = decode(packets_of([payload]), np.array([-5], np.int64), gate)
    expected = by_hand(MANUAL, payload, -5, gate)
    # exactly on the edge the last bit of a float decides; every shot of the packet is asked, those without a return too
    everywhere = b"".join(payload[100 * b : 100 * b + 4] + 32 * b"\x64\x00\x00" for b in range(12)) + payload[1200:]
    near_edge = any(
        min((row.azimuth_cdeg / 100 - edge) % 360, (edge - row.azimuth_cdeg / 100) % 360) < 1e-7
        for row in by_hand(MANUAL, everywhere, -5, Gate()).returns
        for edge in (gate.fov_start_deg, gate.fov_end_deg)
    )
    if not near_edge or shots.gated.outside_fov == expected.outside_fov:
        assert_same(shots, expected)


@settings(max_examples=100, deadline=None)
@given(noise=st.binary(min_size=1200, max_size=1200), mode=st.sampled_from([0x37, 0x39]))
def test_packets_of_noise_give_shots_of_finite_place(noise: bytes, mode: int) -> None:
    shots = decode(packets_of([noise + struct.pack("<IBB", 0, mode, 0x21)]), np.zeros(1, np.int64))
    np.testing.assert_allclose(np.linalg.norm(shots.xyz_m.astype(float), axis=1), shots.range_m, rtol=1e-5)
    assert ((shots.azimuth_rad >= 0) & (shots.azimuth_rad <= np.float32(2 * np.pi))).all()
    assert (shots.range_m > 0).all()


def test_an_equal_pair_is_one_return_and_the_nearer_is_return_one(data_payload: Callable[..., bytes]) -> None:
    payload = bytearray(data_payload(0, [100 * (b // 2) for b in range(12)], mode=0x39))
    struct.pack_into("<HB", payload, 4, 3000, 11)  # laser 0: last at 6 m, strongest at 5 m
    struct.pack_into("<HB", payload, 4 + 3, 2000, 12)  # laser 1: last at 4 m, before the strongest at 5 m
    struct.pack_into("<HB", payload, 4 + 6, 2500, 13)  # laser 2: the same range, another strength
    struct.pack_into("<HB", payload, 4 + 9, 0, 14)  # laser 3: no last return
    shots = decode(packets_of([bytes(payload)]), np.zeros(1, np.int64))
    first = shots.time_ns < 46_080
    rows = list(
        zip(
            shots.laser[first].tolist(),
            np.rint(shots.range_m[first] * 1000).astype(int).tolist(),
            shots.returns[first].tolist(),
            strict=True,
        )
    )
    assert rows[:7] == [
        (0, 5000, 0x21), (0, 6000, 0x22), (1, 4000, 0x21), (1, 5000, 0x22), (2, 5000, 0x21), (2, 5000, 0x22), (3, 5000, 0x11),
    ]  # fmt: skip
    assert set(rows[7:]) == {(k, 5000, 0x11) for k in range(4, 32)}


def test_the_sweep_of_a_block_is_turned_by_sine_and_cosine() -> None:
    """As far as a block may sweep, 2 deg."""
    fraction, elevation = np.linspace(0.0, 1.0, 32), np.deg2rad(ELEVATIONS_DEG)
    for step in (0.0, 8.3, 79.0, 200.0):
        found = np.empty((2, 32))
        firings._directions(step, fraction, np.cos(elevation)[None, :], found)
        angle = np.deg2rad(step / 100.0 * fraction)
        np.testing.assert_allclose(found[0], np.cos(elevation) * np.cos(angle), rtol=1e-10)
        np.testing.assert_allclose(found[1], np.cos(elevation) * np.sin(angle), rtol=0, atol=1e-10)


def test_both_ends_of_a_window_are_within_it(data_payload: Callable[..., bytes]) -> None:
    """The blocks of 90.00 and 91.00 deg: their first lasers fire just there, the others behind."""
    packet = packets_of([data_payload(0, range(8_600, 9_800, 100))])
    shots = decode(packet, np.zeros(1, np.int64), Gate(90.0, 91.0))
    assert (shots.time_ns // 46_080).tolist() == [4] * 32 + [5]
    assert shots.laser.tolist() == [*range(32), 0]
    assert shots.gated.outside_fov == 384 - 33
    dual = packets_of([data_payload(0, np.repeat(range(8_600, 9_200, 100), 2).tolist(), mode=0x39)])
    shots = decode(dual, np.zeros(1, np.int64), Gate(90.0, 91.0))
    assert (shots.time_ns // 46_080).tolist() == [4] * 32 + [5]
    assert shots.gated.outside_fov == 192 - 33


def test_columns_are_as_narrow_as_the_clouds_they_fill(data_payload: Callable[..., bytes]) -> None:
    """Enough packets for memory that is lent, and few."""
    for count in (1, 400):
        packets = packets_of([data_payload(0, range(0, 192, 16))] * count)
        shots = decode(packets, np.zeros(count, np.int64))
        assert len(shots) == 384 * count
        names = ("time_ns", "xyz_m", "range_m", "intensity", "laser", "returns")
        kinds = [getattr(shots, name).dtype for name in names]
        assert kinds == [np.int64, np.float32, np.float32, np.uint8, np.uint8, np.uint8]


def test_a_batch_is_cut_where_the_return_mode_changes(data_payload: Callable[..., bytes]) -> None:
    modes = [0x37, 0x37, 0x39, 0x39, 0x39, 0x38]
    packets = np.zeros(len(modes), records.SCAN_PACKET_DTYPE)
    packets["data"] = packets_of([data_payload(0, [0] * 12, mode=mode) for mode in modes])
    parts = list(model.LIDAR.decode(packets, np.arange(6, dtype=np.int64)))
    assert [len(shots) for shots in parts] == [2 * 384, 3 * 192, 384]
    assert [int(shots.time_ns[0]) for shots in parts] == [0, 2, 5]
    with pytest.raises(PacketError, match="single and dual return mode"):
        decode(packets, np.arange(6, dtype=np.int64))


def test_packets_of_a_log_and_bare_packets_give_the_same(data_payload: Callable[..., bytes]) -> None:
    content = [data_payload(0, [int(i * 1000 + 16.6 * b) for b in range(12)]) for i in range(5)]
    logged = np.zeros(5, records.SCAN_PACKET_DTYPE)
    logged["data"] = packets_of(content)
    times = np.arange(5, dtype=np.int64)
    ours, bare = decode(logged, times), decode(packets_of(content), times)
    assert (ours.xyz_m == bare.xyz_m).all()
    assert len(decode(logged[:0], times[:0])) == 0


def test_corrections_of_a_laser_move_its_points_along_the_beam(data_payload: Callable[..., bytes]) -> None:
    packet = packets_of([data_payload(0, list(range(0, 192, 16)))])
    nominal = model.LIDAR.lasers
    offset = np.zeros(32)
    offset[5] = 0.25
    plain, moved = (
        decode(packet, np.zeros(1, np.int64), lasers=t)
        for t in (nominal, LaserTable(nominal.elevation_rad, offset, nominal.height_m))
    )
    length = np.linalg.norm(moved.xyz_m, axis=1) - np.linalg.norm(plain.xyz_m, axis=1)
    np.testing.assert_allclose(length, np.where(plain.laser == 5, 0.25, 0.0), rtol=0, atol=1e-5)
    assert (moved.range_m == plain.range_m).all()
