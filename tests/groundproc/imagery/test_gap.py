"""A trajectory that strays for 10 s without GNSS: images around the gap and of the strips beside it bring it back."""

import json
from dataclasses import replace
from pathlib import Path

import imageblock
import numpy as np
import pytest

from groundproc.cli import main
from groundproc.trajectory.table import read_trajectory

GAP_S = (22.0, 32.0)
STRAYS_M = 0.5


@pytest.mark.parametrize("seed", [2])
def test_images_bring_a_gap_back_by_five_times(tmp_path: Path, seed: int) -> None:
    """Most points are of one strip and move with it: that the clock is 40 ms off shows in the others alone."""
    truth = imageblock.true_camera()
    flown = imageblock.fly(truth, strips=4, per_strip=6, points=1500, seed=seed, spacing_m=(11.5, 22.5), height=30.0)
    known = imageblock.disturbed(flown, seed, np.array([0.02, 0.02, 0.03]), np.array([0.05, 0.05, 0.1]))
    share = np.clip((1e-9 * (known.time_ns - imageblock.START_NS) - GAP_S[0]) / (GAP_S[1] - GAP_S[0]), 0.0, 1.0)
    bump = np.sin(np.pi * share)[:, None] ** 2
    known = replace(
        known, position_m=known.position_m + bump * np.random.default_rng(seed).normal(0.0, STRAYS_M, 3),
        sigma_position_m=np.hypot(known.sigma_position_m, STRAYS_M * bump),
    )  # fmt: skip
    rig = replace(
        truth, timeshift_s=0.0, estimate=("f", "pu", "pv", "k1", "k2"), sigma={"f": 20.0, "pu": 10.0, "pv": 10.0}
    )
    imageblock.write_block(flown, tmp_path, rig, known, 0.3, seed)
    given = (("image-points", "points"), ("trajectory", "trajectory"), ("times", "times"), ("control", "control"))
    words = [word for name, file in given for word in (f"--{name}", str(tmp_path / f"{file}.csv"))]
    out = tmp_path / "out"
    assert main(["images", *words, "--rig", str(tmp_path / "rig.yaml"), "-o", str(out)]) == 0
    told = json.loads((out / "bundle.json").read_text())
    assert {one["group"] for one in told["held_out"] if one["accepted"]} >= {"timeshift"}
    camera = told["cameras"][0]
    assert abs(camera["timeshift_s"] - truth.timeshift_s) < 3.3 * camera["timeshift_sigma_s"]
    hybrid = read_trajectory(out / "hybrid" / "trajectory.csv")
    step = np.load(out / "hybrid" / "covariance.npz")["step"][:, :3]
    found = imageblock.FRAME.from_geodetic(*hybrid.frame.to_geodetic(hybrid.position_m + step))
    time_s = 1e-9 * (hybrid.time_ns - imageblock.START_NS)
    inside = (time_s > GAP_S[0] + 1.0) & (time_s < GAP_S[1] - 1.0)
    true_m = flown.trajectory.at(hybrid.time_ns).position_m
    before, after = (
        float(np.sqrt(np.square(place - true_m)[inside].sum(axis=1).mean()))
        for place in (known.at(hybrid.time_ns).position_m, found)
    )
    assert inside.sum() >= 3
    assert after < before / 5.0
    assert after < 0.05
