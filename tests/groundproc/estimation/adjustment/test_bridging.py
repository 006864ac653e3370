"""Where the lidar does not hold the path, the smoother's motion is laid between the good ends."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.adjustment.adjusted import own_part
from groundproc.estimation.adjustment.bridging import (
    KEPT,
    SHORTEST,
    START,
    Stretch,
    along_untold_s,
    bridged,
    holds_somewhere,
    misleading,
    stretches,
    unheld,
)
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS
from groundproc.estimation.odometry.matching import TELLS_M
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

START_NS = 1_700_000_000 * 10**9
SECONDS = 60.0
BEGIN_NS, END_NS = START_NS + 20 * 10**9, START_NS + 40 * 10**9


def flown() -> Trajectory:
    """A wide circle at 5 m/s, nose ahead."""
    time_ns = START_NS + np.arange(0, int(SECONDS * 1e9), STEP_NS)
    seconds = (time_ns - START_NS) * 1e-9
    angle = seconds * 5.0 / 40.0
    place = np.column_stack([40.0 * np.cos(angle), 40.0 * np.sin(angle), 10.0 + np.sin(seconds)])
    quat = frames.quat_exp(np.column_stack([0.05 * np.sin(seconds), 0.03 * np.cos(seconds), angle]))
    rows = len(time_ns)
    step_s = STEP_NS * 1e-9
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])) / step_s
    return Trajectory(
        LocalFrame(0.0, 0.0, 0.0), time_ns, place, np.gradient(place, step_s, axis=0), quat,
        np.concatenate([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]]),
        np.full((rows, 3), 0.01), np.full((rows, 3), 1e-4), np.ones(rows, np.bool_),
    )  # fmt: skip


def moved(path: Trajectory, turn_rad: Array, shift_m: Array) -> Trajectory:
    turn = frames.quat_exp(turn_rad[None])
    mat = frames.mat_from_quat(turn)[0]
    quat = frames.quat_multiply(np.repeat(turn, len(path), axis=0), path.quat_local_ins_wxyz)
    return replace(path, position_m=path.position_m @ mat.T + shift_m, quat_local_ins_wxyz=quat)


def smoothers(path: Trajectory) -> Trajectory:
    """The same motion elsewhere, and said to be known to 2 m and 1 deg."""
    other = moved(path, np.array([0.01, -0.02, 0.3]), np.array([2.0, -3.0, 1.0]))
    rows = len(path)
    return replace(
        other, sigma_position_m=np.full((rows, 3), 2.0), sigma_attitude_rad=np.full((rows, 3), np.deg2rad(1.0))
    )


def on_fixes(path: Trajectory) -> Trajectory:
    """As `smoothers`, but the way is the fixes': elsewhere, and not turned by what the attitudes are off."""
    other = smoothers(path)
    return replace(other, position_m=path.position_m + np.array([2.0, -3.0, 1.0]))


def spoilt(path: Trajectory, begin_ns: int, end_ns: int) -> Trajectory:
    """Between two moments braked, up to 8 m."""
    share = np.clip((path.time_ns - begin_ns) / (end_ns - begin_ns), 0.0, 1.0)
    off = 8.0 * np.sin(np.pi * share)
    return replace(path, position_m=path.position_m + off[:, None] * np.array([1.0, 0.0, 0.0]))


def test_between_good_ends_the_motion_is_the_smoothers() -> None:
    true = flown()
    made = bridged(spoilt(true, BEGIN_NS, END_NS), smoothers(true), [Stretch(BEGIN_NS, END_NS, True, True)])
    np.testing.assert_allclose(made.position_m, true.position_m, rtol=0, atol=1e-6)
    np.testing.assert_allclose(made.velocity_m_s, true.velocity_m_s, rtol=0, atol=1e-3)
    off = frames.quat_multiply(frames.quat_inverse(true.quat_local_ins_wxyz), made.quat_local_ins_wxyz)
    assert np.abs(frames.quat_log(off)).max() < 1e-7
    np.testing.assert_allclose(made.rate_rad_s, true.rate_rad_s, rtol=0, atol=1e-3)


def test_what_the_smoother_does_not_know_of_the_way_between_is_in_sigma() -> None:
    true = flown()
    made = bridged(spoilt(true, BEGIN_NS, END_NS), smoothers(true), [Stretch(BEGIN_NS, END_NS, True, True)])
    inside = (made.time_ns >= BEGIN_NS) & (made.time_ns <= END_NS)
    np.testing.assert_array_equal(made.sigma_position_m[~inside], true.sigma_position_m[~inside])
    middle = int(np.searchsorted(made.time_ns, (BEGIN_NS + END_NS) // 2))
    # errors of 2 m that last a minute are 1.1 m another after 10 s
    assert made.sigma_position_m[middle, 0] == pytest.approx(
        2.0 * np.sqrt(2.0 * (1.0 - np.exp(-10.0 / 60.0))), rel=0.01
    )
    assert made.sigma_position_m[inside].max(axis=0)[0] < 2.0
    assert np.rad2deg(made.sigma_attitude_rad[middle]).min() >= 1.0


def test_what_the_ends_do_not_agree_on_is_spread_over_the_time_between() -> None:
    true = flown()
    drifting = smoothers(true)
    gone_s = (true.time_ns - START_NS) * 1e-9
    drifting = replace(drifting, position_m=drifting.position_m + 0.1 * gone_s[:, None] * np.array([0.0, 1.0, 0.0]))
    made = bridged(spoilt(true, BEGIN_NS, END_NS), drifting, [Stretch(BEGIN_NS, END_NS, True, True)])
    # 2 m in 20 s: a drift that is even is all taken out
    assert np.linalg.norm(made.position_m - true.position_m, axis=1).max() < 1e-6


@pytest.mark.parametrize(("before", "after"), [(False, True), (True, False)])
def test_at_an_end_of_the_flight_it_hangs_on_the_one_good_pose(before: bool, after: bool) -> None:
    true = flown()
    begin_ns, end_ns = (START_NS, BEGIN_NS) if after else (END_NS, int(true.time_ns[-1]))
    torn = replace(true, position_m=true.position_m.copy())
    good = torn.time_ns >= end_ns if after else torn.time_ns <= begin_ns
    torn.position_m[~good] += 5.0
    made = bridged(torn, on_fixes(true), [Stretch(begin_ns, end_ns, before, after)])
    np.testing.assert_allclose(made.position_m, true.position_m, rtol=0, atol=1e-6)
    off = frames.quat_multiply(frames.quat_inverse(true.quat_local_ins_wxyz), made.quat_local_ins_wxyz)
    assert np.abs(frames.quat_log(off)).max() < 1e-7


def test_what_the_smoother_does_not_cover_stays_as_it_is() -> None:
    true = flown()
    made = spoilt(true, BEGIN_NS, END_NS)
    short = smoothers(true).before(START_NS + 30 * 10**9)
    assert bridged(made, short, [Stretch(BEGIN_NS, END_NS, True, True)]) is made
    assert bridged(made, smoothers(true), []) is made


def test_the_last_moments_that_the_smoother_does_not_cover_go_on_from_where_it_ends() -> None:
    true = flown()
    torn = replace(true, position_m=true.position_m.copy())
    loose = torn.time_ns > END_NS
    torn.position_m[loose] += 5.0
    short = on_fixes(true).before(int(true.time_ns[-1]) - 100_000_000)
    made = bridged(torn, short, [Stretch(END_NS, int(true.time_ns[-1]), True, False)])
    np.testing.assert_allclose(made.position_m, true.position_m, rtol=0, atol=1e-6)
    assert (np.diff(made.sigma_position_m[loose], axis=0) >= 0.0).all()


def test_only_long_stretches_are_bridged_and_those_that_all_but_touch_are_one() -> None:
    loose = np.zeros(600, np.bool_)
    loose[50:130] = loose[133:200] = True  # three slices between them
    loose[300 : 300 + SHORTEST - 1] = True
    loose[480:] = True
    first, last = stretches(loose, START_NS)
    assert (first.begin_ns, first.end_ns) == (START_NS + 50 * SLICE_NS, START_NS + 200 * SLICE_NS)
    assert (first.held_before, first.held_after) == (True, True)
    assert (last.begin_ns, last.held_after) == (START_NS + 480 * SLICE_NS, False)
    assert stretches(np.r_[np.zeros(START, np.bool_), np.ones(200, np.bool_)], 0)[0].held_before is False


def test_blind_is_who_sees_nothing_and_misled_who_sees_nothing_that_tells_the_way() -> None:
    track: Any = SimpleNamespace(unheld_m=[0.01] * 60, matched=[500] * 60, astray=0)
    track.unheld_m[:5], track.unheld_m[20:25] = [np.inf] * 5, [2.0 * TELLS_M] * 5
    track.next_unheld_m = track.unheld_m
    track.unheld_m[40:45], track.matched[40:45] = [np.inf] * 5, [0] * 5
    assert np.flatnonzero(misleading(track)).tolist() == [20, 21, 22, 23, 24]
    assert np.flatnonzero(unheld(track)).tolist() == [20, 21, 22, 23, 24, 40, 41, 42, 43, 44]


def seen(slices: int, unheld_m: float, next_unheld_m: float, matched: int = 500, astray: int = 0) -> Any:
    return SimpleNamespace(
        unheld_m=[unheld_m] * slices, next_unheld_m=[next_unheld_m] * slices, matched=[matched] * slices, astray=astray
    )


def test_a_single_direction_that_is_not_told_leaves_the_others_to_the_adjustment() -> None:
    """Along a street or a bank: its other five directions are better than a smoother's."""
    street = seen(200, 10.0 * TELLS_M, 0.02)
    assert not misleading(street).any()
    assert unheld(street).sum() == 200 - START
    assert misleading(seen(200, 10.0 * TELLS_M, 2.0 * TELLS_M)).sum() == 200 - START


@pytest.mark.parametrize(
    ("open_share", "seconds"),
    [(1.0, 20.0), (0.8, 20.0), (0.3, 0.0), (0.0, 0.0)],
)
def test_a_street_without_anything_across_it_is_told_though_planes_that_lean_seem_to_hold_it_at_times(
    open_share: float, seconds: float
) -> None:
    track = seen(400, 0.02, 0.004)
    untold = np.full(400, 0.02)
    untold[100:300] = np.where((np.arange(200) % 10) < 10 * open_share, 0.16, 0.02)
    track.unheld_m = untold.tolist()
    # what lies within half of ten seconds of it counts too
    assert along_untold_s(track) == pytest.approx(seconds, abs=10.1 if seconds else 0.0)
    track.next_unheld_m = [0.2] * 400
    assert along_untold_s(track) == 0.0  # two directions: that is bridged


def test_who_has_led_astray_is_believed_where_he_is_sure() -> None:
    assert not misleading(seen(200, 0.05, 0.05)).any()
    assert misleading(seen(200, 0.05, 0.05, astray=1)).sum() == 200 - START
    assert not misleading(seen(200, 0.01, 0.01, astray=1)).any()


@pytest.mark.parametrize(("held", "kept"), [(KEPT + 1, True), (KEPT - 1, False)])
def test_a_few_seconds_that_hold_are_worth_keeping(held: int, kept: bool) -> None:
    """Most of the flight is over water: what is seen of the shore stays."""
    track = seen(300, np.inf, np.inf, matched=0)
    for column, value in ((track.unheld_m, 0.01), (track.next_unheld_m, 0.01), (track.matched, 500)):
        column[100 : 100 + held] = [value] * held
    assert holds_somewhere(track) is kept


@pytest.mark.parametrize(("blind", "kept"), [(0, True), (10, True), (20, False)])
def test_of_a_flight_of_four_seconds_half_of_what_counts_is_long_enough(blind: int, kept: bool) -> None:
    track = seen(38, 0.01, 0.01, matched=500)
    track.matched[START : START + blind] = [0] * blind
    assert holds_somewhere(track) is kept


@pytest.mark.parametrize(
    ("runs", "number", "first_s", "last_s"),
    [
        ({0: 50.0}, 0, 0.0, SECONDS),  # before the lidar's first return and after its last too
        ({0: 25.0, 2: 50.0}, 0, 0.0, 25.0),
        ({0: 25.0, 2: 50.0}, 2, 25.0, SECONDS),
    ],
)
def test_what_is_handed_back_of_a_run_is_all_of_it(
    runs: dict[int, float], number: int, first_s: float, last_s: float
) -> None:
    start = flown()
    placed: Any = [
        SimpleNamespace(run=run, last_lidar_ns=START_NS + int(end_s * 1e9), utc_from_lidar=lambda time_ns: time_ns)
        for run, end_s in runs.items()
    ]
    part = own_part(start, placed, number)
    seconds = (part.time_ns - START_NS) * 1e-9
    step_s = STEP_NS * 1e-9
    assert seconds[0] == pytest.approx(first_s, abs=1.5 * step_s)
    assert seconds[-1] == pytest.approx(last_s, abs=1.5 * step_s)
