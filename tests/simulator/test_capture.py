"""Files of the ground recording: bytes of a real capture, and the geodesy behind the positions."""

import io
import struct

import numpy as np
import pytest

from simulator.capture import PcapWriter, tlog_record, udp_frame
from simulator.geodesy import Origin, geodetic

# the first data packet of a real HDL-32E of 2012: Ethernet, IP and UDP headers
REAL_HEADERS = bytes.fromhex(
    "ffffffffffff60768820126e0800"
    "450004d200004000ff11b4a9c0a801c9ffffffff"
    "0940094004be0000"
)  # fmt: skip


def test_headers_of_a_data_packet_are_those_of_a_real_sensor():
    frame = udp_frame(bytes(1206), 2368)
    assert frame[:42] == REAL_HEADERS
    assert len(frame) == 1248


def test_a_position_packet_makes_a_frame_of_554_bytes():
    frame = udp_frame(bytes(512), 8308)
    assert len(frame) == 554
    assert struct.unpack_from(">2H", frame, 34) == (8308, 8308)


@pytest.mark.parametrize(
    ("resolution", "magic", "fraction"), [("us", 0xA1B2C3D4, 123456), ("ns", 0xA1B23C4D, 123456789)]
)
def test_pcap_stamps_are_in_the_unit_of_the_magic_number(resolution, magic, fraction):
    stream = io.BytesIO()
    PcapWriter(stream, resolution).write([(1_700_000_000_123_456_789, 2368, b"abc")])
    content = stream.getvalue()
    assert struct.unpack_from("<I", content)[0] == magic
    assert struct.unpack_from("<4I", content, 24) == (1_700_000_000, fraction, 45, 45)


def test_a_tlog_record_is_microseconds_big_endian_and_the_frame():
    assert tlog_record(1_700_000_000_123_456_789, b"\xfe").hex() == f"{1_700_000_000_123_456:016x}fe"


def test_local_points_have_the_coordinates_that_pyproj_gives():
    pyproj = pytest.importorskip("pyproj")
    origin = Origin()
    points = np.random.default_rng(1).uniform(-400, 400, (50, 3))
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 "
        f"+lon_0={origin.longitude_deg} +lat_0={origin.latitude_deg} +h_0={origin.height_msl_m + origin.undulation_m} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    longitude, latitude, height = pipeline.transform(*points.T)
    ours = geodetic(points, origin)
    # 1e-11 deg is a micrometre
    assert np.abs(ours[0] - latitude).max() < 1e-11
    assert np.abs(ours[1] - longitude).max() < 1e-11
    assert np.abs(ours[2] + origin.undulation_m - height).max() < 1e-6
