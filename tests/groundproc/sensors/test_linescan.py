"""Lines of a scanner to shots: two lines written out by hand, shot by shot."""

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import records
from groundproc.sensors.linescan import LIDAR
from groundproc.sensors.shots import Gate, LaserTable

# angles of the scanner grow from its x (right) towards its y (forward); 90 deg is straight ahead, 0 deg to the right
ANGLES_DEG = (0.0, 45.0, 90.0, 135.0, 180.0)
AZIMUTHS_DEG = (90.0, 45.0, 0.0, 315.0, 270.0)
RANGES_M = ((1.0, 2.0, 3.0, 4.0, 5.0), (0.0, np.nan, 0.5, 60.0, 60.5))
STRENGTHS = ((0.0, 0.6, 254.4, 300.0, -3.0), (1.0, 2.0, np.nan, 4.0, 5.0))
LINE_NS = 1_000_000_000_000_000_000
SHOT_S = 25e-6


def lines() -> npt.NDArray[np.void]:
    """Two lines, 1/18 s apart, of five shots 25 us apart."""
    found = np.zeros(2, records.line_dtype(5))
    found["time_ns"] = LINE_NS, LINE_NS + 55_555_556
    found["angle_min"], found["angle_increment"] = 0.0, np.deg2rad(45.0)
    found["time_increment"], found["scan_time"] = SHOT_S, 1.0 / 18.0
    found["ranges"], found["intensities"] = RANGES_M, STRENGTHS
    return found


def test_each_return_is_where_and_when_its_line_says() -> None:
    given = lines()
    (shots,) = LIDAR.decode(given, given["time_ns"])
    # a range of 0 and one that is no number are no returns
    assert shots.range_m.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 0.5, 60.0, 60.5]
    since_us = np.array([0, 25, 50, 75, 100, 55_555.556 + 50, 55_555.556 + 75, 55_555.556 + 100])
    np.testing.assert_allclose(shots.time_ns - LINE_NS, since_us * 1000, rtol=0, atol=1)
    root = np.sqrt(0.5)
    directions = np.array([[1, 0, 0], [root, root, 0], [0, 1, 0], [-root, root, 0], [-1, 0, 0]])
    expected = shots.range_m[:, None] * directions[[0, 1, 2, 3, 4, 2, 3, 4]]
    np.testing.assert_allclose(shots.xyz_m, expected, rtol=0, atol=1e-5)  # 60 m times the step of an angle of float32
    off_deg = (np.rad2deg(shots.azimuth_rad[:5]) - AZIMUTHS_DEG + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(off_deg, 0.0, rtol=0, atol=1e-4)
    assert shots.intensity.tolist() == [0, 1, 254, 255, 0, 0, 4, 5]
    assert shots.returns.tolist() == [0x11] * 8
    assert shots.laser.tolist() == [0] * 8
    assert shots.elevation_rad.tolist() == [0.0] * 8
    assert (shots.gated.outside_fov, shots.gated.no_return, shots.gated.out_of_range) == (0, 2, 0)
    kinds = [getattr(shots, name).dtype for name in ("time_ns", "xyz_m", "range_m", "intensity", "laser", "returns")]
    assert kinds == [np.int64, np.float32, np.float32, np.uint8, np.uint8, np.uint8]


@pytest.mark.parametrize(
    ("gate", "ranges", "gated"),
    [
        (Gate(min_range_m=2.0, max_range_m=60.0), [2.0, 3.0, 4.0, 5.0, 60.0], (0, 2, 3)),  # both ends included
        (Gate(315.0, 45.0), [2.0, 3.0, 4.0, 0.5, 60.0], (4, 1, 0)),  # both ends included, through straight ahead
        (Gate(44.0, 91.0, min_range_m=1.5), [2.0], (6, 2, 1)),
        (Gate(46.0, 44.0), [1.0, 3.0, 4.0, 5.0, 0.5, 60.0, 60.5], (2, 1, 0)),
        (Gate(180.0, 180.0), [1.0, 2.0, 3.0, 4.0, 5.0, 0.5, 60.0, 60.5], (0, 2, 0)),
    ],
)
def test_what_is_let_through_and_why_the_rest_is_not(
    gate: Gate, ranges: list[float], gated: tuple[int, int, int]
) -> None:
    given = lines()
    (shots,) = LIDAR.decode(given, given["time_ns"], gate)
    assert shots.range_m.tolist() == ranges
    assert (shots.gated.outside_fov, shots.gated.no_return, shots.gated.out_of_range) == gated
    assert len(shots) + sum(gated) == 10, "every shot is a return or counted"


def test_corrections_move_the_points_along_the_beam_and_off_the_plane() -> None:
    given = lines()[:1]
    table = LaserTable(np.deg2rad([30.0]), np.array([0.5]), np.array([0.1]))
    (shots,) = LIDAR.decode(given, given["time_ns"], lasers=table)
    reach = np.array(RANGES_M[0]) + 0.5
    np.testing.assert_allclose(shots.xyz_m[:, 2], reach * 0.5 + 0.1, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*shots.xyz_m[:, :2].T), reach * np.sqrt(0.75), rtol=0, atol=1e-6)
    assert shots.range_m.tolist() == list(RANGES_M[0])
    assert shots.lasers is table


def test_the_time_of_a_line_may_be_another_than_its_stamp() -> None:
    (shots,) = LIDAR.decode(lines()[:1], np.array([7_000], np.int64))
    assert shots.time_ns.tolist() == [7_000, 32_000, 57_000, 82_000, 107_000]


def test_lines_tell_of_themselves_before_they_are_decoded() -> None:
    given = lines()
    digest = LIDAR.digest(given)
    assert digest.azimuth_cdeg.tolist() == [[9_000, 4_500, 0, 31_500, 27_000]] * 2
    assert digest.mode.tolist() == [0, 0]
    assert dict(LIDAR.mode_names) == {0: "single"}
    np.testing.assert_allclose(digest.record_ns, 1e9 / 18, rtol=0, atol=4)  # float32 of 1/18 s
    assert digest.returns == 8
    assert [each.dtype for each in (digest.azimuth_cdeg, digest.mode, digest.record_ns)] == [
        np.int64,
        np.uint8,
        np.int64,
    ]
    assert LIDAR.valid(given).dtype == np.bool_
    assert LIDAR.valid(given).tolist() == [True, True]
    assert LIDAR.stamp_ns(given).tolist() == LIDAR.receive_time_ns(given).tolist() == [LINE_NS, LINE_NS + 55_555_556]


def test_a_line_in_a_log_reads_back_and_lines_of_other_length_are_another_kind() -> None:
    given = lines()
    found = LIDAR.unpack(records.encode_line(given[0]))
    assert found.tobytes() == given[:1].tobytes()
    assert LIDAR.same_kind(given, found)
    assert not LIDAR.same_kind(given, np.zeros(1, records.line_dtype(4)))


def test_nothing_gives_nothing_and_blanks_give_no_return() -> None:
    given = lines()
    assert list(LIDAR.decode(given[:0], given["time_ns"][:0])) == []
    for blank in LIDAR.blanks():
        (shots,) = LIDAR.decode(blank, np.zeros(len(blank), np.int64))
        assert len(blank) > 0
        assert len(shots) == 0
        assert shots.gated.no_return == blank["ranges"].size
