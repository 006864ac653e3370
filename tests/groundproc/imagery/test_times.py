from pathlib import Path

import numpy as np
import pytest

from flightlog.clock import utc_to_gps_ns
from flightlog.errors import CaptureError
from groundproc.imagery.poses import NO_TIME
from groundproc.imagery.times import by_order, times_of

START = 1_700_000_000_000_000_000


def events(count: int, seed: int = 0) -> np.ndarray:
    gaps = np.random.default_rng(seed).uniform(1.5, 4.0, count)
    return START + np.rint(np.cumsum(gaps) * 1e9).astype(np.int64)


def test_as_many_events_as_images_are_paired_in_order() -> None:
    stamps = events(5)
    found = by_order(stamps[::-1], np.full(5, NO_TIME), "x").utc_ns
    assert found.tolist() == stamps.tolist()


@pytest.mark.parametrize("offset_s", [0.0, 3.7, -7200.25])
def test_images_that_are_missing_are_told_by_the_intervals_under_any_clock_offset(offset_s: float) -> None:
    stamps = events(30)
    kept = np.delete(np.arange(30), [4, 5, 17, 29])
    exif = stamps[kept] + round(offset_s * 1e9) + np.random.default_rng(1).integers(-(10**7), 10**7, len(kept))
    timed = by_order(stamps, exif, "x")
    assert timed.utc_ns.tolist() == stamps[kept].tolist()
    assert timed.offset_s == pytest.approx(-offset_s, abs=0.006)
    assert "26 of 26" in timed.note


def test_an_image_without_an_event_is_placed_by_its_own_clock_where_that_is_steady() -> None:
    stamps = events(20)
    exif = np.insert(stamps, 7, stamps[6] + 700_000_000) - 2_500_000_000
    timed = by_order(np.delete(stamps, 3), exif, "x")
    assert timed.own.tolist() == [n in (3, 7) for n in range(21)]
    assert timed.utc_ns.tolist() == (exif + 2_500_000_000).tolist()


def test_an_image_without_an_event_has_no_time_where_clocks_show_whole_seconds() -> None:
    stamps = events(20)
    exif = np.insert(stamps, 7, stamps[6] + 700_000_000) // 10**9 * 10**9
    timed = by_order(np.delete(stamps, 3), exif, "x")
    assert not timed.own.any()
    assert (timed.utc_ns == NO_TIME).sum() >= 2


def test_as_many_events_as_images_that_are_not_theirs_are_told_by_the_intervals() -> None:
    stamps = events(12)
    exif = np.delete(stamps, 2) + 3 * 10**9
    timed = by_order(np.delete(stamps, 9), exif, "x")
    assert timed.own.tolist() == [n == 8 for n in range(11)]
    assert timed.utc_ns.tolist() == (exif - 3 * 10**9).tolist()


def test_a_mrk_is_read_to_the_nanosecond(tmp_path: Path) -> None:
    gps = utc_to_gps_ns(START)
    week, of_week = divmod(gps, 604_800 * 10**9)
    line = "{}\t{}.{:06d}\t[{}]\t 20,N\t -17,E\t 193,V\t58.4,Lat\t15.6,Lon\t60.0,Ellh\t0.01, 0.01, 0.02\t16,Q\n"
    lines = [line.format(n + 1, *divmod((of_week + n * 2 * 10**9) // 1000, 10**6), week) for n in range(3)]
    (tmp_path / "a.MRK").write_text("".join(lines))
    found = times_of(tmp_path / "a.MRK", ["a", "b", "c"], np.full(3, NO_TIME))
    assert found.utc_ns.tolist() == [START, START + 2 * 10**9, START + 4 * 10**9]


def test_a_table_gives_times_by_name(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(f"image,utc_ns\nb.jpg,{START}\n")
    found = times_of(tmp_path / "t.csv", ["x/a.jpg", "x/b.jpg"], np.full(2, NO_TIME))
    assert found.utc_ns.tolist() == [NO_TIME, START]


@pytest.mark.parametrize(
    ("name", "text", "word"),
    [
        ("t.csv", "image,time\na,1\n", "no column utc_ns"),
        ("t.csv", "image,utc_ns\na.jpg,1.7e18\n", "line 2"),
        ("t.csv", "image,utc_ns\nz.jpg,1700000000000000000\n", "none of its images"),
        ("t.csv", "utc_ns\n1700000000000000000\n", "do not tell"),
        ("t.MRK", "hello\n", "line 1"),
        ("t.MRK", "", "no events"),
    ],
)
def test_what_is_no_table_of_times_gets_one_sentence(tmp_path: Path, name: str, text: str, word: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=word):
        times_of(tmp_path / name, ["a.jpg", "b.jpg"], np.full(2, NO_TIME))
