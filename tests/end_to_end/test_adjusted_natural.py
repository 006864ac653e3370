"""Method `adjusted` where hardly anything is a plane but the ground, against the simulation's truth."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flightlog.logfile import LogReader
from groundproc.accuracy.judge import judge
from groundproc.accuracy.truth import on_lidar_clock, read_truth
from groundproc.estimation import methods
from groundproc.estimation.method import gather
from groundproc.flight.flight import read_flight
from groundproc.flight.timeline import legs
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate

SECONDS = 16.0


@pytest.fixture(scope="module")
def meadow(simulated: Callable[..., Any]) -> Any:
    """Three seconds of hover, the take-off and two thirds of a line over rough ground with tufts, trees and two cars."""
    from simulator.plans import plan

    return simulated("adjusted_meadow", "meadow", SECONDS, plan("meadow").options, seed=31)


def judged(folder: Path, survey: Survey) -> tuple[Estimate, dict[str, Any]]:
    truth = read_truth(folder)
    with LogReader(truth.log) as reader:
        read = read_flight([reader], "ins")
        timeline = legs(read.runs, read.boots, truth.nominal_mount.mat_ins_lidar(), "auto")
        made = methods.estimate(gather([reader], read, timeline, truth.nominal_mount, survey), lambda stage, size: None)
        placed = on_lidar_clock(made.trajectory, timeline[0].lidar_line, truth)
        return made, judge([], truth, placed, made.mount).figures


def test_over_a_meadow_trees_and_tufts_hold_the_path(meadow: Any) -> None:
    """It was lost here by metres: noisy normals of the ground braked the take-off, and what is no plane counted for nothing."""
    made, figures = judged(meadow.folder, Survey(method="adjusted"))
    assert made.report["restarts"] == 0
    assert made.report["blind_s"] <= 1.0  # while the map is young
    assert made.warning == ""
    assert figures["ate_m"] <= 0.03
    assert figures["rotation_rms_free_deg"] <= 0.045
    assert figures["position_within_2_sigma"] >= 0.95
    assert np.isfinite(made.trajectory.sigma_position_m).all()


def test_in_time_the_odometry_alone_keeps_the_way_over_a_meadow(meadow: Any) -> None:
    _, figures = judged(meadow.folder, Survey(method="adjusted", causal=True))
    assert figures["ate_m"] <= 0.15
    assert figures["rpe_m"] <= 0.1
