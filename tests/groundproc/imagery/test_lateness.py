"""Attitudes that are later than places: an autopilot's gyros behind their filters, beside a receiver with a clock of its own."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from imageblock import disturbed, fly, true_camera, write_block

from flightlog.mount import Mount
from groundproc.cli import main
from groundproc.imagery.rotations import STRAIGHT_DOWN
from groundproc.trajectory.estimate import Estimate, write_estimate

LATE_S = 0.008


def test_late_attitudes_are_not_taken_for_the_camera_s_clock(tmp_path: Path) -> None:
    """At 6 m/s they would put images 5 cm ahead. Boresight and clock are off by pixels each, and neither hides the other."""
    truth = true_camera()
    flown = fly(truth, per_strip=5, seed=5, points=400)
    behind = flown.trajectory.where_covered(flown.trajectory.time_ns - round(LATE_S * 1e9))
    late = np.where(behind[1][:, None], behind[0].quat_local_ins_wxyz, flown.trajectory.quat_local_ins_wxyz)
    shaken = replace(flown, trajectory=replace(flown.trajectory, quat_local_ins_wxyz=late))
    trajectory = disturbed(shaken, 8, np.array([0.02, 0.02, 0.03]), np.array([0.005, 0.005, 0.02]))
    guess = replace(
        truth, mat_cam_ins=STRAIGHT_DOWN.copy(), origin_cam_m=-STRAIGHT_DOWN @ truth.lever_arm_m, timeshift_s=0.0,
        sigma={"boresight_deg": 1.0, "timeshift_s": 0.1, "lever_arm_m": 0.005},
    )  # fmt: skip
    write_block(flown, tmp_path, guess, trajectory, 0.3, 12)
    write_estimate(tmp_path, Estimate(trajectory, Mount(), "as drawn", method="filtered"))
    files = ("points.csv", "rig.yaml", "trajectory.csv", "times.csv", "control.csv")
    options = ("--image-points", "--rig", "--trajectory", "--times", "--control")
    words = [word for name, file in zip(options, files, strict=True) for word in (name, str(tmp_path / file))]
    assert main(["images", *words, "-o", str(tmp_path / "out")]) in (0, 3)
    told = json.loads((tmp_path / "out" / "bundle.json").read_text())
    assert all(one["accepted"] for one in told["held_out"])
    assert abs(told["attitudes_late_s"] - LATE_S) < 3.0 * told["attitudes_late_sigma_s"] < 0.008
    camera = told["cameras"][0]
    assert abs(camera["timeshift_s"] - truth.timeshift_s) < 3.0 * camera["timeshift_sigma_s"] < 0.006
    assert max(np.hypot(one["dx"], one["dy"]) for one in told["check"]) < 0.05
