"""Whether errors of `adjusted` are those that its covariance allows, over flights, seeds and scenes.

Errors of one flight hang together: where the whole lies and how it is turned is one draw a flight, and so a flight counts as one draw of
so many degrees of freedom as it has components (mean of the normalised squared errors over its poses).

How the whole lies is told by instruments of which only the class is known before: how large biases of accelerometers are, how well an
AHRS knows tilt. The covariance is that of errors over flights *whose instruments are drawn from these classes*. With better ones errors are
smaller than stated, which is no fault of the covariance, and so it is judged on a draw of instruments as they are stated
(Cook, Gelman, Rubin 2006). Everything that the simulator draws follows from the seed, whatever the scene. Flights of one seed have the same
instruments and fixes, and would be one draw; each flight has a seed of its own.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import chi2
from statedinstruments import as_stated

from flightlog import frames
from flightlog.logfile import LogReader
from groundproc.accuracy.poses import PoseSeries, common_poses
from groundproc.accuracy.truth import on_lidar_clock, read_truth
from groundproc.estimation import methods
from groundproc.estimation.method import gather
from groundproc.flight.flight import read_flight
from groundproc.flight.pairing import legs
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

BLOCKS = {"position": slice(0, 3), "attitude": slice(3, 6), "both": slice(0, 6)}
EVERY = 10
"""Poses of which one is looked at: each tenth of a second."""
SOAK = [(("survey_fast_gyro", "meadow", "slope")[seed % 3], seed) for seed in range(101, 113)]


def errors(estimated: PoseSeries, true: PoseSeries) -> Array:
    """East, north, up [m], roll, pitch, heading [rad] off, shape (n, 6)."""
    heading, pitch, roll = frames.attitude_of(estimated.mat_local_body)
    truly = frames.attitude_of(true.mat_local_body)
    turned = np.stack([roll - truly[2], pitch - truly[1], heading - truly[0]], axis=1)
    return np.column_stack([estimated.position_m - true.position_m, (turned + np.pi) % (2.0 * np.pi) - np.pi])


def normalised(trajectory: Trajectory, true: Trajectory) -> dict[str, float]:
    """Mean of the normalised squared errors, by block; and by `within` the share of all errors within two sigma."""
    series = common_poses(trajectory, true)[:2]
    off = errors(*series)[::EVERY]
    covariance = trajectory.covariance_at(series[0].time_ns[::EVERY])
    found = {}
    for name, part in BLOCKS.items():
        own = covariance[:, part, part]
        found[name] = float(
            np.einsum("ni,ni->n", off[:, part], np.linalg.solve(own, off[:, part, None])[..., 0]).mean()
        )
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return found | {"within": float((np.abs(off) < 2.0 * sigma).mean())}


def flown(folder: Path, solved: Estimate | None = None) -> dict[str, float]:
    truth = read_truth(folder)
    with LogReader(truth.log) as reader:
        read = read_flight([reader], "ins")
        timeline = legs(read.runs, read.boots, truth.nominal_mount.mat_ins_lidar(), "auto")
        given = gather([reader], read, timeline, truth.nominal_mount, Survey(method="adjusted"))
        made = solved or methods.estimate(given, lambda stage, size: None)
    assert made.method == "adjusted"
    return normalised(on_lidar_clock(made.trajectory, timeline[0].lidar_line, truth), truth.trajectory)


def covers(found: list[dict[str, float]], *, loose: bool) -> None:
    """Sums over flights lie within what 1 and 999 of a thousand such sums do; `loose`: nothing is asked of the lower end."""
    for name, part in BLOCKS.items():
        freedom = len(found) * (part.stop - part.start)
        total = sum(each[name] for each in found)
        assert total < chi2.ppf(0.999, freedom), (name, [each[name] for each in found])
        assert loose or total > chi2.ppf(0.001, freedom), (name, [each[name] for each in found])


@pytest.mark.parametrize(
    "flights",
    [
        ["house_flight"],
        # a flight and a whole adjustment more
        pytest.param(["house_flight", "meadow_flight"], marks=pytest.mark.soak),
    ],
    ids=["house", "house and meadow"],
)
def test_over_a_house_and_a_meadow_the_covariance_covers_the_errors(
    flights: list[str], request: pytest.FixtureRequest, adjustment: Callable[[Any], Estimate]
) -> None:
    found = [flown(each.folder, adjustment(each)) for each in map(request.getfixturevalue, flights)]
    covers(found, loose=True)
    assert np.mean([each["within"] for each in found]) >= 0.9


# twelve flights of 14 s over three scenes, and a whole adjustment each
@pytest.mark.soak
def test_over_many_seeds_and_scenes_the_covariance_is_that_of_the_errors(simulated: Callable[..., Any]) -> None:
    from simulator.plans import plan

    found = []
    for name, seed in SOAK:
        flight = plan(name)
        options = as_stated(flight.options, seed)
        found.append(flown(simulated(f"coverage_{name}_{seed}", flight.scene, 14.0, options, seed=seed).folder))
    covers(found, loose=False)
    assert np.mean([each["within"] for each in found]) >= 0.95
