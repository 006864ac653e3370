"""The directions of beams that a cloud of several echoes tells, where no trajectory is there."""

from pathlib import Path

import laspy
import numpy as np
import pytest

from groundproc.cloud import reader
from groundproc.radiometry.sensorpath import recovered

SENSOR = np.array([100.0, 0.0, 700.0])
"""700 m up and beside, going north by 60 m/s."""


def _strip(path: Path, shots: int, half_m: float) -> None:
    """Shots of a strip with two echoes up to 20 m apart, 3 cm of noise, `half_m` to either side of its middle."""
    rng = np.random.default_rng(3)
    time_s = np.sort(rng.uniform(0.0, 2.0, shots))
    sensor = SENSOR + np.column_stack([np.zeros(shots), 60.0 * time_s, np.zeros(shots)])
    low = np.column_stack(
        [rng.uniform(-half_m, half_m, shots), sensor[:, 1] + rng.normal(0, 1, shots), np.zeros(shots)]
    )
    way = (sensor - low) / np.linalg.norm(sensor - low, axis=1)[:, None]
    high = low + way * rng.uniform(4, 20, shots)[:, None]
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = [0.001] * 3
    las = laspy.LasData(header)
    las.xyz = np.stack([high, low], axis=1).reshape(-1, 3) + rng.normal(0, 0.03, (2 * shots, 3))
    las.gps_time, las.return_number = np.repeat(time_s, 2), np.tile([1, 2], shots)
    las.number_of_returns, las.point_source_id = np.full(2 * shots, 2), np.full(2 * shots, 7)
    las.write(path)


@pytest.mark.parametrize(("shots", "half_m"), [(2000, 150.0), (2000, 10.0), (60, 60.0)])
def test_wide_narrow_and_thin_strips_tell_where_beams_came_from(tmp_path: Path, shots: int, half_m: float) -> None:
    _strip(tmp_path / "s.laz", shots, half_m)
    cloud = reader.look(tmp_path / "s.laz")
    path = recovered(cloud)
    assert path is not None
    (chunk,) = reader.chunks(cloud, columns=())
    place, known = path.at(chunk)
    assert known.all()
    sensor = SENSOR + np.column_stack(
        [0 * chunk.record.gps_time, 60.0 * chunk.record.gps_time, 0 * chunk.record.gps_time]
    )
    away, true = place - chunk.points.xyz_m, sensor - chunk.points.xyz_m
    cosine = (away * true).sum(axis=1) / np.linalg.norm(away, axis=1) / np.linalg.norm(true, axis=1)
    assert np.rad2deg(np.arccos(cosine)).max() < 2.0
