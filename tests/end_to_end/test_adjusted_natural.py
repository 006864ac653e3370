"""Method `adjusted` where hardly anything is a plane but the ground, against the simulation's truth."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flightlog.logfile import LogReader
from groundproc.accuracy.judge import Judgement, judge
from groundproc.accuracy.truth import on_lidar_clock, read_truth
from groundproc.estimation import methods
from groundproc.estimation.adjustment import adjusted, windows
from groundproc.estimation.method import gather
from groundproc.flight.flight import read_flight
from groundproc.flight.pairing import legs
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate


def judged(folder: Path, survey: Survey, solved: Estimate | None = None) -> tuple[Estimate, Judgement]:
    truth = read_truth(folder)
    with LogReader(truth.log) as reader:
        read = read_flight([reader], "ins")
        timeline = legs(read.runs, read.boots, truth.nominal_mount.mat_ins_lidar(), "auto")
        given = gather([reader], read, timeline, truth.nominal_mount, survey)
        made = solved or methods.estimate(given, lambda stage, size: None)
        placed = on_lidar_clock(made.trajectory, timeline[0].lidar_line, truth)
        return made, judge([], truth, placed, made.mount)


# a flight and a whole adjustment of its own; in the quick suite: the village is right to the sensor's noise (test_adjusted)
@pytest.mark.soak
def test_over_a_meadow_trees_and_tufts_hold_the_path(meadow_flight: Any, adjustment: Callable[[Any], Estimate]) -> None:
    """It was lost here by metres: noisy normals of the ground braked the take-off, and what is no plane counted for nothing.

    The batch, which had the ground alone, bent the three seconds of hover by 0.4 m: trees and tufts hold it too.
    """
    made, found = judged(meadow_flight.folder, Survey(), adjustment(meadow_flight))
    assert made.method == "adjusted"
    _, smoothed = judged(meadow_flight.folder, Survey(method="filtered"))
    assert made.report["restarts"] == 0
    assert made.report["blind_s"] <= 1.0  # while the map is young
    assert made.warning == ""
    assert found.figures["ate_m"] <= 0.03
    assert found.figures["ate_m"] <= 0.1 * smoothed.figures["ate_m"]
    assert found.figures["rotation_rms_free_deg"] <= 0.045
    assert found.figures["position_within_2_sigma"] >= 0.95
    assert np.isfinite(made.trajectory.sigma_position_m).all()


# the flight of the one above; in the quick suite: the village without the future (test_adjusted)
@pytest.mark.soak
def test_in_time_the_odometry_keeps_the_way_over_a_meadow(meadow_flight: Any) -> None:
    """Once the speed is known, some seconds after the start."""
    _, found = judged(meadow_flight.folder, Survey(method="adjusted", causal=True))
    later = found.courses["time_s"] > 6.0
    assert np.median(found.courses["position_error_m"][later]) <= 0.05
    assert np.median(found.courses["rotation_error_deg"][later]) <= 0.1


# a flight of 26 s and two adjustments; in the quick suite: what a tie and a swinging step do (test_factors, test_batch)
@pytest.mark.soak
def test_along_an_empty_street_no_window_is_worse_than_the_smoother(
    simulated: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Held by 1 cm to the end of the one before, whose speed along the street was not known, the last of three windows was 2.7 m off."""
    from simulator.plans import plan

    street = plan("emptystreet")
    folder = simulated("street_windows", street.scene, 26.0, street.options, seed=21).folder
    _, smoothed = judged(folder, Survey(method="filtered"))
    made, whole = judged(folder, Survey())
    assert "settled" not in made.warning
    for module in (adjusted, windows):
        monkeypatch.setattr(module, "OVERLAP", 30)
    monkeypatch.setattr(adjusted, "WINDOW", 100)
    made, parted = judged(folder, Survey())
    assert len(made.report["windows"]) > 2
    for found in (whole, parted):
        assert found.figures["ate_m"] < smoothed.figures["ate_m"]
        assert found.figures["position_within_2_sigma"] >= 0.95
