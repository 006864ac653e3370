"""Points chosen by time, area, line and class, each counted by what left it out; and spans of time as people write them."""

import numpy as np
import pytest
import shapely

from flightlog.errors import UsageError
from groundproc.cloud.points import Points
from groundproc.cloud.selection import SURFACES, Area, Lines, Selection, Times
from groundproc.cloud.spans import spans_ns

UTC_NS = 1_777_629_720_000_000_000  # 2026-05-01T10:02:00Z


def points(count: int = 1000) -> Points:
    rng = np.random.default_rng(1)
    columns = {
        "classification": rng.choice(np.array([1, 2, 7, 18, 69], np.uint8), count),
        "point_source_id": rng.integers(1, 6, count).astype(np.uint16),
    }
    return Points(UTC_NS + np.arange(count) * 10**9, rng.uniform(0, 100, (count, 3)), columns)


def test_what_each_choice_leaves_out_is_counted_once_and_adds_up() -> None:
    some = points()
    spans = np.array([[UTC_NS + 100 * 10**9, UTC_NS + 600 * 10**9]])
    selection = Selection([Times("times", spans), Area(shapely.box(0, 0, 50, 100)), SURFACES, Lines(frozenset({1, 3}))])
    kept = selection.of(some)
    second = np.arange(len(some))
    expected = (
        (second >= 100) & (second < 600) & (some.xyz_m[:, 0] <= 50)
        & np.isin(some["classification"], [1, 2]) & np.isin(some["point_source_id"], [1, 3])
    )  # fmt: skip
    np.testing.assert_array_equal(kept.xyz_m, some.xyz_m[expected])
    assert selection.left_out["times"] == 500
    assert sum(selection.left_out.values()) + len(kept) == len(some)
    assert all(selection.left_out.values())


def test_inside_and_outside_of_an_area_are_each_other_s_rest_whatever_its_shape() -> None:
    some = points(20_000)
    ring = shapely.Point(50, 50).buffer(40).difference(shapely.Point(50, 50).buffer(20))
    shape = shapely.union(ring, shapely.box(0, 0, 10, 10))
    inside, outside = Area(shape).keeps(some), Area(shape, outside=True).keeps(some)
    np.testing.assert_array_equal(inside, ~outside)
    assert abs(inside.mean() - shape.area / 1e4) < 5 * np.sqrt(shape.area / 1e4 / 20_000)
    distance = np.hypot(some.xyz_m[:, 0] - 50, some.xyz_m[:, 1] - 50)
    assert not inside[(distance < 19.5) | (distance > 60.0) & (some.xyz_m[:, :2].min(axis=1) > 10.0)].any()


def test_points_without_a_class_are_no_noise() -> None:
    bare = Points(np.zeros(3, np.int64), np.zeros((3, 3)))
    assert SURFACES.keeps(bare).all()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("60/480", (UTC_NS + 60 * 10**9, UTC_NS + 480 * 10**9)),
        ("0.5/1.25", (UTC_NS + 5 * 10**8, UTC_NS + 125 * 10**7)),
        ("2026-05-01T10:03:00Z/2026-05-01T12:04:00.5+02:00", (UTC_NS + 60 * 10**9, UTC_NS + 120_500_000_000)),
        ("2026-05-01T10:03:00/90", (UTC_NS + 60 * 10**9, UTC_NS + 90 * 10**9)),
    ],
)
def test_spans_are_seconds_or_utc(text: str, expected: tuple[int, int]) -> None:
    np.testing.assert_array_equal(spans_ns([text], UTC_NS), [expected])


def test_an_open_end_holds_for_ever() -> None:
    (begin, end), (start, until) = spans_ns(["/60", "60/"], UTC_NS)
    assert begin < 0 < end == start == UTC_NS + 60 * 10**9 < until


@pytest.mark.parametrize(
    "text", ["60", "60-480", "480/60", "a/b", "nan/5", "1e300/2e300", "1/2/3", "2026-13-01T00:00:00Z/"]
)
def test_what_is_no_span_is_one_sentence_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match=r"times '.*START/END"):
        spans_ns([text], UTC_NS)
