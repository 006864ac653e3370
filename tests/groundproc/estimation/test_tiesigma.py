"""The share of the clocks in the sigma of every pose."""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pytest

from groundproc.estimation.tiesigma import with_tie_sigma
from groundproc.flight.sync import Sync
from groundproc.flight.timeline import Leg
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import Trajectory

S = 10**9
START = 1_779_272_223 * S


@dataclass(frozen=True)
class _Boot:
    def span_ns(self) -> tuple[int, int]:
        return 0, 100 * S


def leg_with(sigma_s: float, drift_ppm: float = 0.0) -> Leg:
    from groundproc.flight.timebase import UtcTie
    from groundproc.flight.timeline import Line

    found = Sync("gyro", 0, sigma_s * 1e9, 50 * S, sigma_drift_ppm=drift_ppm)
    utc = UtcTie(START, 1.0, "gprmc")
    return Leg(cast(Any, _Boot()), 0, found, utc, (Line(START),), START, START + 100 * S, 100 * S)


def flown() -> Trajectory:
    """East at 8 m/s, north at 6, turning at 0.5 rad/s about up and 0.1 about the right axis; 3 m and 1 deg."""
    n = 101
    one = np.ones((n, 1))
    return Trajectory(
        LocalFrame(58.0, 15.0, 100.0),
        START + np.arange(n) * S,
        np.zeros((n, 3)),
        one * [8.0, 6.0, 0.0],
        one * [1.0, 0.0, 0.0, 0.0],
        one * [0.1, 0.0, 0.5],
        one * [3.0, 3.0, 4.5],
        one * np.deg2rad([1.0, 1.0, 5.0]),
        np.append(np.ones(n - 1, np.bool_), False),
    )


def test_a_pose_that_may_be_late_may_be_off_by_its_speed_and_its_rate() -> None:
    track = flown()
    made, warning = with_tie_sigma(track, [leg_with(0.2)])
    np.testing.assert_allclose(made.sigma_position_m[50], np.hypot([3.0, 3.0, 4.5], [1.6, 1.2, 0.0]))
    # roll about forward, pitch about right, heading about up
    np.testing.assert_allclose(made.sigma_attitude_rad[50], np.hypot(np.deg2rad([1.0, 1.0, 5.0]), [0.0, 0.02, 0.1]))
    assert "200 ms only" in warning
    # a good tie is worth nothing, and is no warning
    made, warning = with_tie_sigma(track, [leg_with(0.0004)])
    np.testing.assert_allclose(made.sigma_position_m, track.sigma_position_m, rtol=1e-5)
    assert warning == ""


def test_the_drift_adds_to_it_away_from_the_reference() -> None:
    made, _ = with_tie_sigma(flown(), [leg_with(0.001, drift_ppm=300.0)])
    # 50 s away: 15 ms
    assert made.sigma_position_m[0, 0] == pytest.approx(np.hypot(3.0, 8.0 * np.hypot(0.001, 0.015)))
    assert made.sigma_position_m[50, 0] == pytest.approx(np.hypot(3.0, 0.008))


def test_a_hopeless_tie_is_in_the_sigma_and_is_said() -> None:
    made, warning = with_tie_sigma(flown(), [leg_with(168.0)])
    assert made.sigma_position_m[:, 0].min() > 1300.0
    assert made.sigma_attitude_rad.max() < 2.0
    assert "168000 ms" in warning
