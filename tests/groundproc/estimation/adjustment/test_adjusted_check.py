"""The self-check of method adjusted: when what it began from is given instead of what it made of it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flightlog.mount import Mount
from groundproc.estimation.adjustment.run import Run
from groundproc.estimation.adjustment.skew import MISALIGNMENT_RAD
from groundproc.estimation.observations.fixes import SLID_SIGMAS, Fixes
from groundproc.estimation.observations.lasers import UNKNOWNS
from groundproc.sensors.lasers import LaserCorrections


class SeenTrack:
    """Ten seconds in which the lidar saw planes enough."""

    def __init__(self, restarts: int) -> None:
        self.restarts, self.astray, self.matched = restarts, 0, [500] * 100
        self.unheld_m = self.next_unheld_m = [0.01] * 100

    def __len__(self) -> int:
        return len(self.matched)


def run_with(restarts: int, slid: float, outside: tuple[str, ...], refuted: bool = False) -> Run:
    track: Any = SeenTrack(restarts)
    log = [{"chi_square": 0.2, "moved_m": 0.001, "position_drift": slid, "position_rms": 0.3}]
    windows: Any = [SimpleNamespace(log=log, told={})]
    unused: Any = None
    fixes = Fixes("fixes0", unused, 0, unused)
    sources: Any = SimpleNamespace(observations=[fixes], leads=lambda: bool(outside), mat_ins_lidar=np.eye(3))
    return Run(windows, unused, track, unused, sources, refuted=refuted)


@pytest.mark.parametrize(
    ("restarts", "slid", "outside", "refuted", "misled"),
    [
        (0, 2.0, (), False, False),
        (1, 2.0, (), False, False),  # lost, and found again
        (0, 2 * SLID_SIGMAS, (), False, False),  # a bad fix or two: the lidar was never lost
        (1, 2 * SLID_SIGMAS, (), False, True),
        (0, 2 * SLID_SIGMAS, (), True, True),  # never lost, but the smoother goes with the fixes
        (1, 2 * SLID_SIGMAS, ("ppk.pos",), True, False),  # better positions hold it
    ],
)
def test_misled_is_who_ends_away_from_the_fixes_and_lost_the_way_or_is_refuted(
    restarts: int, slid: float, outside: tuple[str, ...], refuted: bool, misled: bool
) -> None:
    run = run_with(restarts, slid, outside, refuted)
    assert run.is_misled() is misled
    if misled:  # is_blind is not asked first: the lidar saw planes enough
        assert "misled" in run.note()
        said = run.warnings()
        assert any("the trajectory is what the adjustment began from" in sentence for sentence in said)
        assert any("lost its way" in sentence for sentence in said) is (restarts > 0)


@pytest.mark.parametrize("misled", [True, False])
def test_mount_and_lasers_are_those_that_the_trajectory_was_made_with(misled: bool) -> None:
    """Where it is the start's, what a misled adjustment thinks of the mount would only turn the cloud away from it."""
    run = run_with(1 if misled else 0, 2 * SLID_SIGMAS, ())
    (window,) = run.windows
    window.values = {
        "ins.turn": (np.array([0.01, 0.0, 0.02]), np.array([0.001, 0.002, 0.003])),
        "ins.lever": (np.array([0.0, 0.1, 0.16]), np.array([0.004, 0.005, 0.006])),
    }
    window.corrections = np.full(UNKNOWNS, 0.004), 1e-8 * np.eye(UNKNOWNS)
    given, nominal = LaserCorrections(), Mount()
    mount, sigma = run.mount(nominal), run.mount_sigma(nominal)
    if misled:
        assert (mount, sigma, run.lasers(given, 32), run.mount_source("log")) == (nominal, None, given, "log")
        return
    assert run.mount_source("log") == "estimated by adjusted, begun from log"
    assert run.lasers(given, 32).range_m == (0.004,) * 32
    turned = nominal.mat_ins_lidar().T @ mount.mat_ins_lidar()
    np.testing.assert_allclose(Rotation.from_matrix(turned).as_rotvec(), [-0.01, 0.0, -0.02], rtol=0, atol=1e-9)
    np.testing.assert_allclose(mount.lidar_position_m(), -mount.mat_ins_lidar() @ [0.0, 0.1, 0.16])
    assert sigma is not None
    # the boresight is found through a gyro whose axes are no better known
    np.testing.assert_allclose(sigma.turn_rad, np.hypot([0.001, 0.002, 0.003], MISALIGNMENT_RAD))
    # the lever arm's covariance in the ins frame, by the nose-down mount
    lever = mount.mat_ins_lidar() @ np.diag(np.square([0.004, 0.005, 0.006]) + 0.003**2) @ mount.mat_ins_lidar().T
    np.testing.assert_allclose(sigma.position_m, np.sqrt(np.diag(lever)))


@pytest.mark.parametrize(
    ("unheld_m", "outside", "warned"), [(0.16, (), True), (0.02, (), False), (0.16, ("ppk.pos",), False)]
)
def test_a_way_that_walls_do_not_tell_is_a_warning_unless_better_positions_do(
    unheld_m: float, outside: tuple[str, ...], warned: bool
) -> None:
    run = run_with(0, 2.0, outside)
    run.track.unheld_m = [unheld_m] * 300
    run.track.matched, run.track.next_unheld_m = [500] * 300, [0.004] * 300
    said = [sentence for sentence in run.warnings() if "one direction of the way" in sentence]
    assert bool(said) is warned
