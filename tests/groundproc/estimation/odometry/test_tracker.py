"""What keeps the odometry going: positions and attitudes in time and late, the history that these are compared with."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from flightlog.constants import STANDARD_GRAVITY_M_S2
from groundproc.estimation.odometry.grid import SLICE_NS, STEPS
from groundproc.estimation.odometry.history import KEPT, History
from groundproc.estimation.odometry.motion import Motion
from groundproc.estimation.odometry.odometry import Odometry, Step
from groundproc.estimation.odometry.slices import Slice
from groundproc.estimation.odometry.stated import Attitudes, Fix, Positions, Recorded
from groundproc.estimation.odometry.tracker import CHECKED, FEWEST, Tracker
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

NORTH_M_S = 5.0
SLICES = 300
START_NS = 1_700_000_000 * 10**9
ACCEL_OFF_M_S2 = 0.02
"""The accelerometer's error along the way: 9 m in 30 s, where no position corrects it."""


def straight() -> tuple[Motion, Trajectory]:
    """30 s north at 5 m/s, level, and nothing of it is seen by a lidar."""
    count = SLICES * STEPS
    force = np.tile([0.0, ACCEL_OFF_M_S2, STANDARD_GRAVITY_M_S2], (count, 1))
    motion = Motion(START_NS, np.zeros((count, 3)), force, np.ones(count, np.bool_), 1e-3, 1e-2, "lidar")
    time_ns = START_NS + np.arange(-10, SLICES + 10) * SLICE_NS
    north = NORTH_M_S * (time_ns - START_NS) * 1e-9
    rows = len(time_ns)
    place = np.stack([np.zeros(rows), north, np.full(rows, 7.0)], axis=1)
    zero = np.zeros((rows, 3))
    speed = np.tile([0.0, NORTH_M_S, 0.0], (rows, 1))
    level = np.tile([1.0, 0.0, 0.0, 0.0], (rows, 1))
    flags = np.ones(rows, np.bool_)
    return motion, Trajectory(LocalFrame(0.0, 0.0, 0.0), time_ns, place, speed, level, zero, zero, zero, flags)


class Late:
    """True positions, known some time after they were true."""

    def __init__(self, delay_ns: int) -> None:
        self._delay_ns, self._next_ns = delay_ns, START_NS + SLICE_NS
        self.lever_m = np.zeros(3)

    def fixes(self, now_ns: int) -> Sequence[Fix]:
        found = []
        while self._next_ns + self._delay_ns <= now_ns:
            north = NORTH_M_S * (self._next_ns - START_NS) * 1e-9
            found.append(Fix(self._next_ns, np.array([0.0, north, 7.0]), np.full(3, 0.5), 5.0))
            self._next_ns += 200_000_000
        return found

    def attitude(self, now_ns: int) -> tuple[int, Array] | None:
        time_ns = (now_ns - self._delay_ns) // SLICE_NS * SLICE_NS
        return (time_ns, np.array([1.0, 0.0, 0.0, 0.0])) if time_ns >= START_NS else None


def flown(delay_ns: int) -> Tracker:
    motion, rough = straight()
    tracker = Tracker(motion, rough, np.eye(3), np.zeros(3), np.zeros(3), Late(delay_ns), keep=False)
    for number in range(SLICES):
        tracker.feed(Slice(number, np.empty(0, np.int64), np.empty((0, 3), np.float32)))
    return tracker


@pytest.mark.parametrize("delay_ns", [0, 300_000_000, 1_000_000_000, 2_000_000_000])
def test_a_position_counts_for_its_own_time_however_late_it_comes(delay_ns: int) -> None:
    """Taken for the present, positions 2 s late would drag the path back by 10 m."""
    track = flown(delay_ns).track
    assert track is not None
    assert (track.restarts, track.late_fixes) == (0, 0)
    assert track.fixes == (SLICES * SLICE_NS - SLICE_NS - delay_ns) // 200_000_000 + 1
    off = np.array(track.position_m[100:]) - np.array([0.0, 0.0, 7.0])
    off[:, 1] -= NORTH_M_S * SLICE_NS * 1e-9 * np.arange(100, SLICES + 1)
    assert np.abs(off).max() < 1.0
    turn = frames.quat_log(track.quat[-1][None])[0]
    assert np.abs(np.rad2deg(turn)).max() < 3.0


def test_what_is_older_than_the_history_is_counted_and_left_out() -> None:
    delay_ns = (KEPT + 5) * SLICE_NS
    track = flown(delay_ns).track
    assert track is not None
    assert track.fixes == 0
    assert track.late_fixes == (SLICES * SLICE_NS - SLICE_NS - delay_ns) // 200_000_000 + 1
    seconds = SLICES * SLICE_NS * 1e-9
    assert track.position_m[-1][1] - NORTH_M_S * seconds == pytest.approx(0.5 * ACCEL_OFF_M_S2 * seconds**2, abs=0.5)


def test_numbers_of_slices_count_from_where_the_grid_begins() -> None:
    tracker = flown(0)
    assert tracker.track is not None
    first, count = tracker.track.first, len(tracker.track)
    tracker.forget(50)
    tracker.track.drop(count - FEWEST)
    assert tracker.track.first == first - 50 + count - FEWEST
    assert len(tracker.track.position_m) == FEWEST + 1


def test_the_path_over_the_last_slices_is_that_of_the_whole() -> None:
    tracker = flown(0)
    assert tracker.track is not None
    whole, last = tracker.track.causal_path(tracker.motion), tracker.track.causal_path(tracker.motion, SLICES - 3)
    assert last.start_ns == START_NS + (SLICES - 3) * SLICE_NS
    np.testing.assert_array_equal(last.position_m, whole.position_m[-3 * STEPS - 1 :])
    np.testing.assert_array_equal(last.quat, whole.quat[-3 * STEPS - 1 :])


def test_the_history_goes_straight_between_two_slices_and_no_further() -> None:
    history = History()
    assert history.at(0) is None
    for i in range(KEPT + 20):
        angle = 0.02 * i
        quat = np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
        history.add(i * SLICE_NS, np.array([float(i), 2.0 * i, 0.0]), quat)
    was = history.at(50 * SLICE_NS + SLICE_NS // 4)
    assert was is not None
    np.testing.assert_allclose(was.position_m, [50.25, 100.5, 0.0])
    angle = 0.02 * 50.25
    np.testing.assert_allclose(was.mat_map_sensor[:2, 0], [np.cos(angle), np.sin(angle)], rtol=0, atol=1e-12)
    assert history.at(19 * SLICE_NS) is None
    assert history.at(20 * SLICE_NS) is not None
    assert history.at((KEPT + 19) * SLICE_NS) is not None
    assert history.at((KEPT + 19) * SLICE_NS + 1) is None
    history.clear()
    assert history.at(50 * SLICE_NS) is None


def test_a_log_gives_each_position_once_and_none_from_before_a_start() -> None:
    time_ns = START_NS + np.arange(20) * 200_000_000
    place = np.arange(60.0).reshape(20, 3)
    positions = Positions(time_ns, place, np.ones((20, 3)), np.array([0.1, 0.0, 0.2]), np.ones(3), 0.1)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (20, 1))
    stated = Recorded(positions, Attitudes(time_ns, quats, np.ones(3), 1.0))
    first = stated.fixes(START_NS + 1_000_000_000)
    assert [fix.time_ns - START_NS for fix in first] == [600_000_000, 800_000_000, 1_000_000_000]
    assert [fix.rate_hz for fix in first] == [5.0] * 3
    np.testing.assert_array_equal(first[0].position_m, place[3])
    assert stated.fixes(START_NS + 1_100_000_000) == []
    assert [fix.time_ns - START_NS for fix in stated.fixes(START_NS + 1_200_000_000)] == [1_200_000_000]
    attitude = stated.attitude(START_NS + 1_100_000_000)
    assert attitude is not None
    assert attitude[0] == START_NS + 1_000_000_000
    # the stream has ended: the last is not the attitude of now
    assert stated.attitude(int(time_ns[-1]) + 250_000_000) is None
    assert stated.attitude(START_NS) is None
    assert Recorded(positions, None).attitude(START_NS + 1_100_000_000) is None


@pytest.mark.parametrize(
    ("guide_m_s", "unheld_m", "astray"), [(8.0, 0.05, 1), (5.5, 0.05, 0), (8.0, 0.01, 0), (8.0, 5.0, 0)]
)
def test_what_seems_to_hold_the_path_and_leads_it_elsewhere_is_noticed_in_a_second(
    guide_m_s: float, unheld_m: float, astray: int
) -> None:
    """Held firmly, it is the lidar's to tell; held by nothing, the way is that of the inertial sensors, and no map is wrong."""
    motion, rough = straight()
    east = np.stack([(guide_m_s - NORTH_M_S) * (rough.time_ns - START_NS) * 1e-9, *np.zeros((2, len(rough)))], axis=1)
    guide = replace(rough, position_m=rough.position_m + east)
    tracker = Tracker(motion, rough, np.eye(3), np.zeros(3), np.zeros(3), Late(0), keep=False, guide=guide)
    for number in range(CHECKED + 2):
        if tracker.track is not None:
            tracker.track.unheld_m[:] = [unheld_m] * len(tracker.track)
        tracker.feed(Slice(number, np.empty(0, np.int64), np.empty((0, 3), np.float32)))
    assert tracker.track is not None
    assert (tracker.track.astray, tracker.track.restarts) == (astray, astray)


@pytest.mark.parametrize(("told_m", "share"), [((0.2, 0.01), 0.85), ((5.0, 5.0), 0.0), ((0.01, 0.01), 0.0)])
def test_one_open_direction_goes_with_the_guide(
    told_m: tuple[float, float], share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the start nothing else knows it; where nothing at all is told, or all, the guide has no say."""
    real, east_m_s = Odometry.step, 1.5

    def step(self: Odometry, piece: Slice) -> Step:
        return replace(real(self, piece), unheld_m=told_m[0], next_unheld_m=told_m[1])

    monkeypatch.setattr(Odometry, "step", step)
    motion, rough = straight()
    east = np.stack([east_m_s * (rough.time_ns - START_NS) * 1e-9, *np.zeros((2, len(rough)))], axis=1)
    guide = replace(rough, position_m=rough.position_m + east)
    tracker = Tracker(motion, rough, np.eye(3), np.zeros(3), np.zeros(3), Late(0), keep=False, guide=guide)
    for number in range(20):
        tracker.feed(Slice(number, np.empty(0, np.int64), np.empty((0, 3), np.float32)))
    assert tracker.track is not None
    assert tracker.track.velocity_m_s[-1][0] == pytest.approx(share * east_m_s, abs=0.15 * east_m_s)


class Astray(Late):
    """Positions that are 4 km off, too far to be followed at once, from the tenth second on."""

    def fixes(self, now_ns: int) -> Sequence[Fix]:
        off = np.array([4000.0, 0.0, 0.0])
        return [
            replace(fix, position_m=fix.position_m + off) if fix.time_ns > START_NS + 10 * 10**9 else fix
            for fix in super().fixes(now_ns)
        ]


@pytest.mark.parametrize(("unheld_m", "begun_anew"), [(0.01, False), (0.1, True), (np.inf, True)])
def test_fixes_that_go_away_from_a_path_that_the_lidar_holds_do_not_make_it_begin_anew(
    unheld_m: float, begun_anew: bool
) -> None:
    motion, rough = straight()
    tracker = Tracker(motion, rough, np.eye(3), np.zeros(3), np.zeros(3), Astray(0), keep=False)
    for number in range(130):
        tracker.feed(Slice(number, np.empty(0, np.int64), np.empty((0, 3), np.float32)))
        assert tracker.track is not None
        tracker.track.unheld_m[-1] = unheld_m
    assert tracker.track is not None
    assert (tracker.track.restarts > 0) == begun_anew
