"""Clouds of other programs: every point format, and extra bytes that are or are not ours."""

from pathlib import Path

import laspy
import numpy as np
import pytest

from flightlog.errors import CaptureError
from groundproc.cloud import reader
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.reader import look
from groundproc.cloud.rewriter import Rewriter


def foreign(path: Path, point_format: int, count: int = 50) -> laspy.LasData:
    """A cloud with all fields of its format, and extra bytes."""
    rng = np.random.default_rng(point_format)
    header = laspy.LasHeader(version="1.4" if point_format > 5 else "1.2", point_format=point_format)
    header.scales = np.full(3, 0.01)
    header.offsets = np.array([1000.0, 2000.0, 0.0])
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("range", np.int32, "range [ft]"),
            laspy.ExtraBytesParams("azimuth", np.float32, "heading [deg]"),
            laspy.ExtraBytesParams("laser", np.uint32, "laser"),
            laspy.ExtraBytesParams("Amplitude", np.uint16, "dB", scales=np.array([0.1]), offsets=np.array([3.0])),
        ]
    )
    cloud = laspy.LasData(header)
    cloud.points = laspy.ScaleAwarePointRecord.zeros(count, header=header)
    for name in cloud.points.array.dtype.names:
        part = cloud.points.array[name]
        if part.dtype.kind == "f":
            part[:] = rng.uniform(100, 300, count)
        else:
            bounds = np.iinfo(part.dtype)
            part[:] = rng.integers(bounds.min, bounds.max, count, endpoint=True)
    for name in "XYZ":
        cloud.points.array[name] = rng.integers(-1000, 1000, count)
    cloud.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    cloud.write(path)
    return cloud


@pytest.mark.parametrize("point_format", [0, 1, 2, 3, 6, 7, 8])
def test_every_point_format_is_read_as_laspy_reads_it(tmp_path: Path, point_format: int) -> None:
    theirs = foreign(tmp_path / "a.laz", point_format)
    cloud = look(tmp_path / "a.laz")
    assert cloud.timed == (point_format not in (0, 2))
    (chunk,) = reader.chunks(cloud, Clock() if cloud.timed else None)
    points = chunk.points
    np.testing.assert_allclose(points.xyz_m, theirs.xyz, rtol=0.0, atol=1e-9)
    for name in ("intensity", "return_number", "number_of_returns", "classification", "user_data", "point_source_id"):
        assert (points[name] == np.asarray(theirs[name])).all()
    angle = np.asarray(theirs.scan_angle) * 0.006 if point_format > 5 else np.asarray(theirs.scan_angle_rank)
    np.testing.assert_allclose(points["scan_angle"], angle, rtol=1e-6)
    assert ("red" in points) == (point_format in (2, 3, 7, 8))
    assert ("nir" in points) == (point_format == 8)
    # extra bytes of our names: in feet, in degrees, too wide for our column
    assert "range" not in points
    np.testing.assert_allclose(points["azimuth"], np.asarray(theirs["azimuth"]), rtol=1e-6)
    assert "laser" not in points


def test_a_cloud_written_anew_keeps_what_the_table_does_not_know(tmp_path: Path) -> None:
    for point_format in (1, 3, 6, 7, 8):
        theirs = foreign(tmp_path / "a.laz", point_format)
        cloud = look(tmp_path / "a.laz")
        with Rewriter(cloud, tmp_path / "b.laz") as new:
            for chunk in reader.chunks(cloud, columns=()):
                assert not chunk.points.columns
                stored = new.write(chunk.record, np.full((len(chunk.points), 3), [0.02, 0.0, -0.004]))
        again = laspy.read(tmp_path / "b.laz")
        np.testing.assert_allclose(stored, again.xyz, rtol=0.0, atol=1e-9)
        for name in theirs.points.array.dtype.names:
            moved = {"X": 2}.get(name, 0)
            assert (
                again.points.array[name]
                == theirs.points.array[name] + np.array(moved).astype(again.points.array[name].dtype)
            ).all()
        assert again.header.point_format == theirs.header.point_format


@pytest.mark.parametrize("point_format", [1, 7])
def test_a_cloud_written_anew_takes_more_attributes_and_replaces_those_of_the_same_name(
    tmp_path: Path, point_format: int
) -> None:
    theirs = foreign(tmp_path / "a.laz", point_format)
    cloud = look(tmp_path / "a.laz")
    rng = np.random.default_rng(3)
    given = {
        "reflectance": rng.random(len(theirs)).astype(np.float32),
        "azimuth": rng.integers(0, 36000, len(theirs)) * 0.01,
        "classification": rng.integers(0, 20, len(theirs)).astype(np.uint8),
    }
    with Rewriter(cloud, tmp_path / "b.laz", added=given) as new:
        for chunk in reader.chunks(cloud, columns=()):
            new.write(chunk.record, columns=given)
    again = laspy.read(tmp_path / "b.laz")
    for name in set(theirs.points.array.dtype.names) - {"azimuth", "raw_classification", "classification"}:
        assert (again.points.array[name] == theirs.points.array[name]).all()
    assert (np.asarray(again.classification) == given["classification"]).all()
    (chunk,) = reader.chunks(look(tmp_path / "b.laz"), columns=("reflectance", "azimuth"))
    assert (chunk.points["reflectance"] == given["reflectance"]).all()
    np.testing.assert_allclose(chunk.points["azimuth"], given["azimuth"], rtol=1e-6)


def test_times_are_asked_for_and_not_there(tmp_path: Path) -> None:
    foreign(tmp_path / "a.laz", 2)
    cloud = look(tmp_path / "a.laz")
    (chunk,) = reader.chunks(cloud)
    assert not chunk.points.time_ns.any()
    with pytest.raises(CaptureError, match="have no gps_time"):
        next(reader.chunks(cloud, Clock()))


def test_what_is_no_cloud_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "a.laz").write_bytes(b"not a cloud" * 100)
    with pytest.raises(CaptureError, match=r"a\.laz: is no LAS or LAZ file"):
        look(tmp_path / "a.laz")
    with pytest.raises(CaptureError, match=r"none\.laz: cannot be read"):
        look(tmp_path / "none.laz")
