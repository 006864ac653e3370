"""Times of points over the end of the GPS week, and points that have none."""

from pathlib import Path

import numpy as np

from flightlog.clock import gps_week_to_utc_ns
from groundproc.cloud import reader
from groundproc.cloud.gpstime import Clock, is_week_time

PLACE = Path("c.laz")


def test_case_of_points_over_the_weeks_end(cases: Path) -> None:
    cloud = reader.look(cases / "las_week_end/c.laz")
    assert cloud.week_time
    (chunk,) = reader.chunks(cloud, Clock(2303))
    assert sorted(chunk.points.time_ns.tolist()) == [1_709_423_981_500_000_000, 1_709_423_982_500_000_000]


def test_pieces_of_a_file_are_of_the_week_in_which_the_file_begins() -> None:
    clock = Clock(2303).begun(np.array([604_790.0, 604_799.5]))
    end_ns = gps_week_to_utc_ns(2304, 0)
    assert clock.utc_ns(PLACE, True, np.array([0.5, 604_799.5, 604_800.5])).tolist() == [
        end_ns + 500_000_000, end_ns - 500_000_000, end_ns + 500_000_000,
    ]  # fmt: skip


def test_the_flight_gives_each_point_its_week() -> None:
    end_ns = gps_week_to_utc_ns(2304, 0)
    for near_ns in (end_ns - 10**12, end_ns + 10**12):
        found = Clock(None, near_ns).utc_ns(PLACE, True, np.array([604_799.5, 0.5]))
        assert found.tolist() == [end_ns - 500_000_000, end_ns + 500_000_000]


def test_a_wild_stamp_says_nothing_of_the_kind_of_time() -> None:
    week = np.linspace(302_400.0, 302_500.0, 100)
    assert is_week_time(week)
    assert is_week_time(np.append(week, [1e9, -1.0]))
    assert not is_week_time(np.append(week + 4e8, [0.0]))
