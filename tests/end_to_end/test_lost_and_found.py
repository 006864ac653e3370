"""A flight that the lidar and the GNSS leave for seconds is whole again once it sees its old map."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flightlog.logfile import LogReader
from groundproc.accuracy.alignment import align
from groundproc.accuracy.poses import common_poses
from groundproc.accuracy.truth import on_lidar_clock, read_truth
from groundproc.estimation import methods
from groundproc.estimation.method import gather
from groundproc.flight.flight import read_flight
from groundproc.flight.pairing import legs
from groundproc.survey import Survey

GAP_FROM_S = 20.0


# two flights of 44 and 50 s; in the quick suite: how a map is found again (odometry/test_rejoining, test_relocation)
@pytest.mark.soak
@pytest.mark.parametrize(("seed", "gap_s", "seconds"), [(5, 6.0, 44.0), (6, 12.0, 50.0)])
def test_after_seconds_without_lidar_and_satellites_the_map_is_found_again(
    simulated: Callable[..., Any], seed: int, gap_s: float, seconds: float
) -> None:
    """The path then lies metres off; both sides of the gap are as right in themselves and to each other as a flight without one."""
    from simulator.plans import plan

    options = plan("survey_fast_gyro").options
    faults = replace(
        options.faults, lidar_gap_at_s=GAP_FROM_S, lidar_gap_s=gap_s, gnss_gap_at_s=GAP_FROM_S - 8.0, gnss_gap_s=60.0
    )
    flight = simulated(f"lost_{seed}", "village", seconds, replace(options, faults=faults), seed=seed)
    truth = read_truth(flight.folder)
    with LogReader(truth.log) as reader:
        read = read_flight([reader], "ins")
        timeline = legs(read.runs, read.boots, truth.nominal_mount.mat_ins_lidar(), "auto")
        given = gather([reader], read, timeline, truth.nominal_mount, Survey(method="adjusted"))
        made = methods.estimate(given, lambda stage, size: None)
    assert len(made.report["rejoined"]) == 1
    assert made.report["apart"] == 0
    placed = on_lidar_clock(made.trajectory, timeline[0].lidar_line, truth)
    ours, theirs, _ = common_poses(placed, truth.trajectory)
    lidar, true = ours.times_mount(made.mount), theirs.times_mount(truth.mount)
    seen = np.abs(truth.lidar.elapsed_s(ours.time_ns) - GAP_FROM_S - gap_s / 2.0) > gap_s / 2.0 + 0.5
    parts = (lidar.position_m, lidar.mat_local_body, true.position_m, true.mat_local_body)
    motion = align(*(part[seen] for part in parts))
    off = lidar.moved(motion).position_m[seen] - true.position_m[seen]
    assert np.sqrt(np.square(off).sum(axis=1).mean()) < 0.03
