"""A flight with a VLP-16, from its log to the cloud."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from groundproc.cli import main
from groundproc.cloud import gpstime
from groundproc.geodesy import Projection, projected_crs
from groundproc.trajectory.table import read_trajectory


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
    words = ["--method", "ins", "--fov", "all", "--products", "cloud.laz"]
    assert main(["process", str(log), "-o", str(out), *words]) == 3  # by receive times
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
