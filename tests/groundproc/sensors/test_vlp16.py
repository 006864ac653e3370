"""The VLP-16's file against velodyne-decoder on a recording, and against its manual's figures written out."""

import json
import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pytest
import velodyne_decoder

from flightlog import hdl32e as packet
from flightlog import records
from flightlog.logfile import LogReader, LogWriter
from groundproc import sensors
from groundproc.cli import main
from groundproc.cloud import gpstime
from groundproc.geodesy import Projection, projected_crs
from groundproc.sensors.shots import Gate
from groundproc.trajectory.table import read_trajectory

# VLP-16 manual 63-9243, table of lasers, retyped: elevation [deg] and vertical correction [mm]
TABLE = {
    0: (-15, 11.2), 1: (1, -0.7), 2: (-13, 9.7), 3: (3, -2.2), 4: (-11, 8.1), 5: (5, -3.7), 6: (-9, 6.6), 7: (7, -5.1),
    8: (-7, 5.1), 9: (9, -6.6), 10: (-5, 3.7), 11: (11, -8.1), 12: (-3, 2.2), 13: (13, -9.7), 14: (-1, 0.7), 15: (15, -11.2),
}  # fmt: skip
LIDAR = sensors.lidar("VLP-16")


def payloads(capture: Path) -> list[bytes]:
    """UDP payloads of 1206 bytes of a classic little-endian pcap."""
    content = capture.read_bytes()
    found, at = [], 24
    while at < len(content):
        (size,) = struct.unpack_from("<I", content, at + 8)
        if size == 1206 + 42:
            found.append(content[at + 16 + 42 : at + 16 + size])
        at += 16 + size
    return found


@pytest.fixture(scope="module")
def recorded(recordings: Path) -> list[bytes]:
    return payloads(recordings / "lidar/vlp16_gps.pcap")


def packets_of(content: list[bytes]) -> npt.NDArray[np.void]:
    return np.frombuffer(b"".join(content), packet.DATA_DTYPE)


def test_a_recording_decodes_as_velodyne_decoder_decodes_it(recorded: list[bytes]) -> None:
    config = velodyne_decoder.Config(model=velodyne_decoder.Model.VLP16, min_range=0.0, max_range=1000.0)
    decoder = velodyne_decoder.StreamDecoder(config)
    clouds = [cloud for i, payload in enumerate(recorded) if (cloud := decoder.decode(i * 1.327e-3, payload, True))]
    rest = decoder.finish(True)
    theirs = np.concatenate([cloud[1] for cloud in clouds] + ([rest[1]] if rest else []))
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
    expected = []
    for block in range(0, 12, 2 if dual else 1):
        for cell in range(32):
            firing, laser = divmod(cell, 16)
            since_us = firing * 55.296 + laser * 2.304
            turned = np.deg2rad((azimuths[block] + 40 * since_us / 110.592) / 100)
            elevation, height = np.deg2rad(TABLE[laser][0]), TABLE[laser][1] * 1e-3
            time_ns = 1_000 + (block // 2 if dual else block) * 110_592 + round(since_us * 1000)
            for reach in sorted(ranges[b, cell] * 0.002 for b in ((block, block + 1) if dual else (block,))):
                flat = reach * np.cos(elevation)
                expected.append(
                    (time_ns, laser, flat * np.sin(turned), flat * np.cos(turned), reach * np.sin(elevation) + height)
                )
    time_ns, laser, *xyz = (np.array(column) for column in zip(*expected, strict=True))
    assert (shots.time_ns == time_ns).all()
    assert (shots.laser == laser).all()
    np.testing.assert_allclose(shots.xyz_m, np.stack(xyz, axis=1), atol=1.5e-5)  # float32 of 100 m


def disguised(log: Path, output: Path) -> None:
    """The log of a flight with its lidar replaced by a VLP-16 that turns at 10 Hz and sees 12 m everywhere; position packets left out."""
    with LogReader(log) as reader, output.open("wb") as stream:
        writer = LogWriter(stream, metadata={"swath.session": {"lidar": "VLP-16"}}, attachments=reader.attachments)
        for message in reader.messages():
            if message.topic == records.LIDAR.topic:
                old = records.decode_scan(message.data)
                new = old[::2].copy()  # about one packet in 1.1 ms; a VLP-16 sends one in 1.3 ms
                since = (new["data"]["stamp_us"].astype(np.int64) * 1000)[:, None] + 110_592 * np.arange(12)
                new["data"]["blocks"]["azimuth"] = since // 1000 * 36_000 // 100_000 % 36_000
                new["data"]["blocks"]["returns"]["range"] = 6_000
                new["data"]["return_mode"], new["data"]["product"] = 0x37, 0x22
                writer.write(message.topic, message.log_time_ns, records.encode_scan(message.log_time_ns, new))
            elif message.topic.startswith(records.MAVLINK.topic):
                writer.write(message.topic, message.log_time_ns, message.data)
        writer.finish()


def test_a_flight_with_it_is_processed_by_receive_times(plain_flight: Any, tmp_path: Path) -> None:
    log, out = tmp_path / "v.mcap", tmp_path / "out"
    disguised(plain_flight.log, log)
    assert main(["process", str(log), "-o", str(out), "--method", "ins", "--fov", "all"]) == 3  # by receive times
    quality = json.loads((out / "quality.json").read_text())
    assert quality["lidar"]["model"] == "VLP-16"
    assert quality["sync"]["method"] == "host"
    assert "no gyro readings" in quality["sync"]["note"]
    cloud = laspy.read(out / "cloud.laz")
    assert set(np.unique(cloud["laser"]).tolist()) == set(range(16))
    assert (np.asarray(cloud["range"]) == 12.0).all()
    assert len(cloud) > 100_000
    # 12 m from where the lidar was, 0.16 m below the INS, with its vertical correction of 11 mm and the file's millimetres
    trajectory = read_trajectory(out / "trajectory.csv")
    some = slice(None, None, 997)
    utc_ns = trajectory.time_ns[0] + np.rint(
        (np.asarray(cloud.gps_time)[some] - gpstime.gps_time_s(trajectory.time_ns[:1])[0]) * 1e9
    ).astype(np.int64)
    poses, known = trajectory.where_covered(utc_ns)
    centre = Projection(trajectory.frame, projected_crs(quality["crs"]["epsg"])).exact(poses.position_m[known])
    reach = np.linalg.norm(cloud.xyz[some][known] - centre, axis=1)
    # the projection stretches by up to 4e-4
    assert np.abs(reach - 12.0).max() < 0.16 + 0.011 + 12.0 * 4e-4 + 0.01
