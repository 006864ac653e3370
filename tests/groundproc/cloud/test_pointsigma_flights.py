"""Sigmas of points of twenty flights over five scenes, their instruments drawn as they are stated: errors against the true echoes.

Errors of a flight hang together: the datum, the mount and the heading are one draw each. So a flight counts as one.
"""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.stats import chi2
from statedinstruments import as_stated
from truepoints import compared, shares, sizes

from groundproc.cli import main
from groundproc.survey import Survey

if TYPE_CHECKING:
    from conftest import Simulated

SCENES = ("survey_fast_gyro", "meadow", "slope", "wood", "facades")
SEEDS = range(200, 220)
SECONDS = 12.0


def flown(simulated: Callable[..., "Simulated"], seed: int) -> "Simulated":
    """One revolution in ten of a flight whose log names a second antenna, and the positions of that."""
    from simulator.faults import Outage
    from simulator.plans import plan
    from simulator.rtk import solution
    from simulator.simulation import Job, Simulation

    name = SCENES[seed % len(SCENES)]
    flight = plan("meadow" if name == "wood" else name)
    scene = "wood" if name == "wood" else flight.scene
    options = as_stated(flight.options, seed)
    spread = float(Survey().boresight_sigma_deg * np.sqrt(3.0))  # uniform, of that sigma
    mount = replace(
        options.mount, boresight_deg=(0.0, 0.0, 0.0), boresight_spread_deg=spread, gps_position_m=(0.1, 0.0, 0.3)
    )
    options = replace(options, mount=mount, rtk=replace(options.rtk, hz=5.0))
    made = simulated(f"pointsigma_{name}_{seed}", scene, SECONDS, options, seed=seed, every=10, points=True)
    again = Simulation(Job(scene, SECONDS, seed, made.folder, options))
    text = solution(
        again.flight,
        options.rtk,
        again.clocks,
        again.origin,
        again.mount.gps_position_m,
        Outage.of(options.faults),
        seed,
    )
    (made.folder / "rtk.pos").write_text(text)
    (made.folder / "geoid").write_text(str(again.origin.undulation_m))
    return made


# twenty flights, processed twice each; in the quick suite one (test_pointsigma)
@pytest.mark.soak
def test_errors_of_points_are_those_of_their_sigmas_with_and_without_a_better_receiver(
    simulated: Callable[..., "Simulated"],
) -> None:
    told: dict[str, list[list[float]]] = {"autopilot": [], "receiver": []}
    for seed in SEEDS:
        flight = flown(simulated, seed)
        better = ["--positions", str(flight.folder / "rtk.pos"), "--geoid", (flight.folder / "geoid").read_text()]
        for kind, more in (("autopilot", []), ("receiver", better)):
            out = flight.folder / kind
            words = ["process", str(flight.log), "--method", "filtered", "--until", "trajectory", "-o", str(out)]
            assert main([*words, *more, "--force"]) in (0, 3)
            found = compared(flight.folder, out, frozenset({"sigma", "incidence"}))
            everywhere = np.ones(len(found.points), bool)
            within, size = shares(found, everywhere), sizes(found, everywhere)
            told[kind].append([*within[1], *within[2], *size])
    for kind, rows in told.items():
        means = np.mean(rows, axis=0)
        if path := os.environ.get("SWATH_FIGURES"):
            with Path(path).open("a") as file:
                file.write(json.dumps({f"points_within_sigma_{kind}": means.tolist()}) + "\n")
        # 20 flights are at least 20 draws of each
        square = np.square(rows)[:, 4:].mean(axis=0)
        low, high = (float(chi2.ppf(share, len(rows))) / len(rows) for share in (0.001, 0.999))
        assert (square < high).all(), (kind, square)
        assert (square > low).all(), (kind, square)
        # 0.68 to 0.07 in plan and 0.10 in height, 0.95 to 0.035 and 0.05, one sigma of 40 and 20 draws
        assert means[0] > 0.68 - 2 * 0.07, (kind, means)
        assert means[1] > 0.68 - 2 * 0.10, (kind, means)
        assert means[2] > 0.95 - 2 * 0.035, (kind, means)
        assert means[3] > 0.95 - 2 * 0.05, (kind, means)
