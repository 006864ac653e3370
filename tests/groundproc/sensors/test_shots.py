"""Windows, tables of lasers, counters and slices of shots: numbers small enough to be told by eye."""

import numpy as np
import pytest

from flightlog.errors import ConfigError
from groundproc import sensors
from groundproc.sensors.shots import Gate, Gated, LaserTable, Shots, turns


def some_shots() -> Shots:
    """To the right, ahead, to the left and behind: lasers 0, 1, 0, 1 at 0 and 30 deg."""
    return Shots(
        np.arange(4, dtype=np.int64) * 1000,
        np.array([[2, 0, 0], [0, 2, 1], [-2, 0, 0], [-1e-7, -2, 1]], np.float32),
        np.array([2, 3, 4, 5], np.float32),
        np.array([10, 20, 30, 40], np.uint8),
        np.array([0, 1, 0, 1], np.uint8),
        np.array([0x11, 0x21, 0x22, 0x11], np.uint8),
        LaserTable.of_elevations([0.0, 30.0]),
        Gated(1, 2, 3),
    )


@pytest.mark.parametrize(
    ("start_deg", "end_deg", "window_deg"),
    [
        (255.0, 105.0, (255.0, 210.0)),
        (-105.0, 105.0, (255.0, 210.0)),
        (0.0, 360.0, (0.0, 360.0)),
        (90.0, 90.0, (90.0, 360.0)),
        (90.0, 450.0, (90.0, 360.0)),
        (10.0, 10.5, (10.0, 0.5)),
        (370.0, 380.0, (10.0, 10.0)),
    ],
)
def test_a_window_is_a_start_within_the_turn_and_a_width(
    start_deg: float, end_deg: float, window_deg: tuple[float, float]
) -> None:
    assert Gate(start_deg, end_deg).window_deg() == window_deg


def test_a_table_of_lasers_is_in_radians_and_without_corrections() -> None:
    table = LaserTable.of_elevations([-30, 0, 90])
    assert len(table) == 3
    np.testing.assert_allclose(table.elevation_rad, [-np.pi / 6, 0.0, np.pi / 2])
    assert table.range_offset_m.tolist() == table.height_m.tolist() == [0.0] * 3
    assert LaserTable.of_elevations([0, 1], [0.01, -0.02]).height_m.tolist() == [0.01, -0.02]
    rows = LaserTable(table.elevation_rad, np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0])).kernel_rows()
    expected = [[np.sqrt(0.75), 1.0, 0.0], [-0.5, 0.0, 1.0], [0.1, 0.2, 0.3], [1.0, 2.0, 3.0]]
    np.testing.assert_allclose(rows, expected, rtol=0, atol=1e-15)


def test_counters_add_up_reason_by_reason() -> None:
    assert Gated(1, 2, 3) + Gated(10, 20, 30) == Gated(11, 22, 33)
    assert Gated() == Gated(0, 0, 0)


def test_a_part_of_the_shots_keeps_what_belongs_together_and_leaves_the_counters_behind() -> None:
    shots = some_shots()
    for part in (shots[1:3], shots[np.array([False, True, True, False])]):
        assert len(part) == 2
        assert part.time_ns.tolist() == [1000, 2000]
        assert part.xyz_m.tolist() == [[0, 2, 1], [-2, 0, 0]]
        assert part.range_m.tolist() == [3, 4]
        assert part.intensity.tolist() == [20, 30]
        assert part.laser.tolist() == [1, 0]
        assert part.returns.tolist() == [0x21, 0x22]
        assert part.lasers is shots.lasers
        assert part.gated == Gated(), "else the sum over all parts would count them again"


def test_azimuth_grows_clockwise_from_straight_ahead_and_elevation_is_the_lasers() -> None:
    shots = some_shots()
    np.testing.assert_allclose(np.rad2deg(shots.azimuth_rad), [90.0, 0.0, 270.0, 180.0], rtol=0, atol=1e-5)
    np.testing.assert_allclose(np.rad2deg(shots.elevation_rad), [0.0, 30.0, 0.0, 30.0])


def test_a_turn_begins_straight_behind_and_nowhere_else() -> None:
    azimuth = np.deg2rad([170.0, 179.9, 180.1, 270.0, 359.9, 0.1, 179.0, 181.0])
    assert turns(azimuth, None).tolist() == [2, 7]
    assert turns(azimuth[2:7], float(azimuth[1])).tolist() == [0], "of the shot before them it is known where it was"
    assert turns(azimuth[2:7], float(azimuth[2])).tolist() == []
    assert turns(azimuth[:0], None).tolist() == []


def test_a_model_that_nobody_knows_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(
        ConfigError, match=r"^survey\.yaml: model 'HDL-64E' is not known; known are HDL-32E, VLP-16, line"
    ):
        sensors.lidar("HDL-64E", "survey.yaml")
    with pytest.raises(ConfigError, match=r"^lidar: model '' is not known"):
        sensors.lidar("")


def test_a_topic_has_its_models() -> None:
    assert [model.name for model in sensors.of_topic("/velodyne_packets")] == ["HDL-32E", "VLP-16"]
    assert [model.name for model in sensors.of_topic("/line_scan")] == ["line scanner"]
    assert sensors.of_topic("/chatter") == []
