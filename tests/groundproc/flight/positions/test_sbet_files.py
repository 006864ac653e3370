"""SBET and its accuracy file, packed by hand."""

import struct
from collections.abc import Callable
from pathlib import Path

import gnss
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flightlog import frames
from flightlog.clock import gps_week_to_utc_ns
from flightlog.errors import LogError, UsageError
from groundproc.flight.positions.sbet import read_sbet

WEEK = 2300
PLACE = (58.39, 15.62, 110.0)


def records(
    start_s: float = 302_400.0, count: int = 400, wander: float = 0.0, wound: bool = True, lie: float = 0.0
) -> list[tuple[float, ...]]:
    """A climb to the north-east at 200 Hz, 5 m/s east, 3 m/s north, 1 m/s up, written with a wander angle."""
    times = start_s + np.arange(count) / 200
    east, north, up = 5.0, 3.0, 1.0
    enu = np.outer(times - start_s, [east, north, up])
    place = gnss.ecef(*PLACE) + enu @ gnss.mat_enu_ecef(*PLACE[:2])
    # geodetic by small steps from the start: radii of curvature; the way is 18 m long
    lat, lon = np.deg2rad(PLACE[:2])
    w2 = 1 - gnss.E2 * np.sin(lat) ** 2
    meridian, prime = gnss.A_M * (1 - gnss.E2) / w2**1.5, gnss.A_M / np.sqrt(w2)
    latitude = lat + enu[:, 1] / (meridian + PLACE[2])
    longitude = lon + enu[:, 0] / ((prime + PLACE[2]) * np.cos(lat))
    assert np.abs(gnss.ecef(np.rad2deg(latitude), np.rad2deg(longitude), PLACE[2] + enu[:, 2]) - place).max() < 1e-3
    # in the wander frame, whose x axis points to the azimuth of -wander
    turn = wander if wound else 0.0
    x = north * np.cos(turn) - east * np.sin(turn)
    y = east * np.cos(turn) + north * np.sin(turn)
    roll, pitch, heading = 0.1, -0.2, 1.3
    return [
        (t, a, b, PLACE[2] + h, x + lie, y, -up, roll, pitch, heading + wander, wander, 0.0, 0.0, 9.8, 0.0, 0.0, 0.0)
        for t, a, b, h in zip(times % 604_800, latitude, longitude, enu[:, 2], strict=True)
    ]


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def make(rows: list[tuple[float, ...]], name: str = "sbet_1.out") -> Path:
        path = tmp_path / name
        path.write_bytes(b"".join(struct.pack(f"<{len(row)}d", *row) for row in rows))
        return path

    return make


@pytest.mark.parametrize("wander", [0.0, 0.7, -2.0])
def test_attitude_and_velocity_do_not_depend_on_the_wander_angle(write: Callable[..., Path], wander: float) -> None:
    found = read_sbet(write(records(wander=wander)), week=WEEK)
    assert found.time_ns[0] == gps_week_to_utc_ns(WEEK, 302_400_000)
    assert np.diff(found.time_ns).tolist() == [5_000_000] * 399
    assert (found.point, found.height_reference) == ("ins", "ellipsoid")
    assert found.velocity_m_s is not None
    np.testing.assert_allclose(found.velocity_m_s[0], [5.0, 3.0, 1.0], rtol=0, atol=1e-9)
    assert found.quat_place_ins_wxyz is not None
    # scipy: roll, pitch, heading of forward-right-down in north-east-down, then swapped to right-forward-up in east-north-up
    frd = Rotation.from_euler("ZYX", [1.3, -0.2, 0.1]).as_matrix()
    swap = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    np.testing.assert_allclose(
        frames.mat_from_quat(found.quat_place_ins_wxyz[0]), swap @ frd @ swap, rtol=0, atol=1e-12
    )


def test_velocities_are_believed_only_as_far_as_the_positions_bear_them_out(write: Callable[..., Path]) -> None:
    plain = read_sbet(write(records(wander=0.7, wound=False)), week=WEEK)
    assert plain.velocity_m_s is not None
    np.testing.assert_allclose(plain.velocity_m_s[0], [5.0, 3.0, 1.0], rtol=0, atol=1e-9)
    assert "wander angle was not applied" in plain.notes[0]
    # platform heading and velocities of a file that counts the angle the other way round
    rows = [(*row[:10], -row[10], *row[11:]) for row in records(wander=0.7)]
    other, usual = read_sbet(write(rows), week=WEEK), read_sbet(write(records(wander=0.7)), week=WEEK)
    assert "other way round" in other.notes[0]
    assert usual.notes == ()
    assert other.quat_place_ins_wxyz is not None
    assert usual.quat_place_ins_wxyz is not None
    np.testing.assert_allclose(other.quat_place_ins_wxyz, usual.quat_place_ins_wxyz, rtol=0, atol=1e-12)
    wrong = read_sbet(write(records(lie=4.0)), week=WEEK)
    assert wrong.velocity_m_s is None
    assert "contradict" in wrong.notes[0]


def test_the_week_comes_from_the_user_or_the_flight(write: Callable[..., Path]) -> None:
    path = write(records())
    with pytest.raises(UsageError, match="does not say its GPS week"):
        read_sbet(path)
    truth = gps_week_to_utc_ns(WEEK, 302_400_000)
    for days in (-3, 0, 3):
        assert read_sbet(path, near_utc_ns=truth + days * 86_400 * 10**9).time_ns[0] == truth
    assert read_sbet(path, near_utc_ns=truth + 4 * 86_400 * 10**9).time_ns[0] == truth + 7 * 86_400 * 10**9
    utc = read_sbet(path, week=WEEK, utc_seconds=True)
    assert utc.time_ns[0] - truth == 18 * 10**9


def test_records_that_cannot_be_are_left_out_and_others_thinned(write: Callable[..., Path]) -> None:
    rows = records()
    rows[7] = (rows[7][0], np.nan, *rows[7][2:])
    rows[9] = (*rows[9][:3], 1e300, *rows[9][4:])
    found = read_sbet(write(rows), week=WEEK)
    assert len(found) == 398
    assert found.left_out == {"damaged": 2}
    thin = read_sbet(write(records()), week=WEEK, interval_s=0.1)
    assert np.diff(thin.time_ns).tolist() == [100_000_000] * 19
    assert thin.velocity_m_s is not None


def test_the_end_of_the_week_is_passed(write: Callable[..., Path]) -> None:
    found = read_sbet(write(records(start_s=604_799.0)), week=WEEK)
    assert np.diff(found.time_ns).tolist() == [5_000_000] * 399
    assert found.time_ns[200] == gps_week_to_utc_ns(WEEK + 1, 0)


def test_sbet_and_accuracy_file_start_again_together_at_the_weeks_end(write: Callable[..., Path]) -> None:
    rows = records(start_s=604_799.0)
    path = write(rows)
    times = np.concatenate([[604_798.5], np.arange(604_799.0, 604_801.5, 0.1)]) % 604_800
    write([(t, *(0.01 * (1 + i) for _ in range(6)), 0.5, 0.6, 2.0) for i, t in enumerate(times)], "smrmsg_1.out")
    for near in (None, gps_week_to_utc_ns(WEEK + 1, 0) - 10**12, gps_week_to_utc_ns(WEEK + 1, 0) + 10**12):
        found = read_sbet(path, week=WEEK if near is None else None, near_utc_ns=near)
        assert found.time_ns[200] == gps_week_to_utc_ns(WEEK + 1, 0)
        # sigma grows by 0.01 m each 0.1 s, through the end of the week
        np.testing.assert_allclose(np.diff(found.sigma_m[:, 0]), 0.01 * 0.05, rtol=1e-6)


def test_a_record_without_time_moves_no_other(write: Callable[..., Path]) -> None:
    rows = records()
    rows[7] = (0.0, *rows[7][1:])
    rows[9] = (-1.0, *rows[9][1:])
    truth = gps_week_to_utc_ns(WEEK, 302_400_000)
    for given in ({"week": WEEK}, {"near_utc_ns": truth + 10**12}):
        found = read_sbet(write(rows), **given)
        assert (found.time_ns[0], len(found)) == (truth, 398)
        assert found.left_out["stray_time"] == 1


def test_the_accuracy_file_beside_it_states_the_sigmas(write: Callable[..., Path]) -> None:
    rows = records()
    path = write(rows)
    assert np.isnan(read_sbet(path, week=WEEK).covariance_m2).all()
    accuracy = [(row[0], 0.02, 0.01, 0.03, 0.005, 0.004, 0.006, 0.5, 0.6, 2.0) for row in rows[::10]] + [
        (rows[-1][0] + 0.1, 0.02, 0.01, 0.03, 0.005, 0.004, 0.006, 0.5, 0.6, 2.0)
    ]
    write(accuracy, "smrmsg_1.out")
    found = read_sbet(path, week=WEEK)
    np.testing.assert_allclose(found.sigma_m[7], [0.01, 0.02, 0.03])
    assert found.attitude_covariance_rad2 is not None
    assert found.velocity_covariance_m2_s2 is not None
    np.testing.assert_allclose(np.rad2deg(np.sqrt(np.diag(found.attitude_covariance_rad2[7]))) * 60, [0.5, 0.6, 2.0])
    np.testing.assert_allclose(np.sqrt(np.diag(found.velocity_covariance_m2_s2[7])), [0.004, 0.005, 0.006])
    assert "smrmsg_1.out" in found.sigma_source
    late = write([(row[0] + 100, *row[1:]) for row in accuracy], "other.out")
    with pytest.raises(LogError, match=r"other\.out: covers"):
        read_sbet(path, week=WEEK, accuracy=late)


def test_what_is_no_sbet_is_one_sentence(write: Callable[..., Path], tmp_path: Path) -> None:
    cut = tmp_path / "cut.out"
    cut.write_bytes(write(records()).read_bytes()[:-1])
    with pytest.raises(LogError, match="multiple of 136"):
        read_sbet(cut, week=WEEK)
    with pytest.raises(LogError, match="expected seconds of the GPS week"):
        read_sbet(write([(t + 1.3e9, *rest) for t, *rest in records()]), week=WEEK)
    with pytest.raises(LogError, match="cannot be read"):
        read_sbet(tmp_path / "none.out", week=WEEK)
