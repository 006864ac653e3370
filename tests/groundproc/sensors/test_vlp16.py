"""The VLP-16's file against velodyne-decoder on a recording, and against its manual's figures written out."""

import struct
from pathlib import Path

import numpy as np
import pytest
import velodyne_decoder
from velodynes import Manual, by_hand, by_velodyne_decoder, packets_of, payloads

from groundproc import sensors
from groundproc.sensors.shots import Gate

# VLP-16 manual 63-9243, table of lasers, retyped: elevation [deg] and vertical correction [mm]
TABLE = {
    0: (-15, 11.2), 1: (1, -0.7), 2: (-13, 9.7), 3: (3, -2.2), 4: (-11, 8.1), 5: (5, -3.7), 6: (-9, 6.6), 7: (7, -5.1),
    8: (-7, 5.1), 9: (9, -6.6), 10: (-5, 3.7), 11: (11, -8.1), 12: (-3, 2.2), 13: (13, -9.7), 14: (-1, 0.7), 15: (15, -11.2),
}  # fmt: skip
MANUAL = Manual(*zip(*TABLE.values(), strict=True), laser_ns=2_304, firing_ns=55_296, block_ns=110_592)
LIDAR = sensors.lidar("VLP-16")


@pytest.fixture(scope="module")
def recorded(recordings: Path) -> list[bytes]:
    return payloads(recordings / "lidar/vlp16_gps.pcap")


def test_a_recording_decodes_as_velodyne_decoder_decodes_it(recorded: list[bytes]) -> None:
    theirs = by_velodyne_decoder(recorded, velodyne_decoder.Model.VLP16, 1.327e-3)
    (ours,) = LIDAR.decode(packets_of(recorded), np.arange(len(recorded), dtype=np.int64) * 1_327_104)
    assert len(ours) == len(theirs) > 50_000
    assert (ours.intensity == theirs["intensity"]).all()
    pairs = set(zip(ours.laser.tolist(), theirs["ring"].tolist(), strict=True))
    assert len(pairs) == 16
    assert [ring for _, ring in sorted(pairs)] == np.argsort(np.argsort([TABLE[k][0] for k in range(16)])).tolist()
    # their x is forward, their y left; the vertical correction leaves the horizontal distance alone
    elevation = np.deg2rad(np.array([TABLE[k][0] for k in range(16)], float))[ours.laser]
    their_steps = np.hypot(theirs["x"].astype(float), theirs["y"]) / np.cos(elevation) / 0.002
    assert np.abs(their_steps - ours.range_m / 0.002).max() < 0.05  # float32
    across = np.hypot(ours.xyz_m[:, 0] + theirs["y"], ours.xyz_m[:, 1] - theirs["x"])
    assert across.mean() < 0.001
    # both know the step of a packet to an encoder step of 0.01 deg
    assert (across <= np.deg2rad(0.011) * ours.range_m).all()


def test_the_recording_is_recognised_and_an_hdl32e_is_refused(recorded: list[bytes]) -> None:
    packets = packets_of(recorded)
    assert LIDAR.valid(packets).all()
    assert not sensors.lidar("HDL-32E").valid(packets).any()


@pytest.mark.parametrize("mode", [0x37, 0x39])
def test_a_packet_decodes_as_a_loop_written_from_the_manual_does(mode: int) -> None:
    rng = np.random.default_rng(mode)
    dual = mode == 0x39
    ranges, strength = rng.integers(500, 50_000, (12, 32)), rng.integers(0, 256, (12, 32))
    azimuths = [35_900 + 40 * (block // 2 if dual else block) for block in range(12)]  # 20 deg/s past 0
    content = b""
    for block in range(12):
        content += struct.pack("<HH", 0xEEFF, azimuths[block] % 36_000)
        content += b"".join(struct.pack("<HB", *each) for each in zip(ranges[block], strength[block], strict=True))
    content += struct.pack("<IBB", 5, mode, 0x22)
    (shots,) = LIDAR.decode(packets_of([content]), np.array([1_000], np.int64), Gate())
    expected = by_hand(MANUAL, content, 1_000, Gate()).returns
    assert len(expected) == 12 * 32
    assert shots.time_ns.tolist() == [each.time_ns for each in expected]
    assert shots.laser.tolist() == [each.laser for each in expected]
    assert shots.returns.tolist() == [each.returns for each in expected]
    np.testing.assert_allclose(
        shots.xyz_m, [(each.x_m, each.y_m, each.z_m) for each in expected], rtol=0, atol=1.5e-5
    )  # float32 of 100 m
