"""`swath calibrate` from the log on, against the simulation's truth: lasers, compass, and what a later flight makes of the files."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flightlog.hdl32e import LASERS
from flightlog.logfile import LogReader
from groundproc.accuracy.judge import judge
from groundproc.accuracy.truth import on_lidar_clock, read_truth
from groundproc.cli import main
from groundproc.estimation import methods
from groundproc.estimation.calibration.compass import BINS, read_compass
from groundproc.estimation.dynamic.dynamic import with_compass
from groundproc.estimation.method import gather
from groundproc.flight.flight import read_flight
from groundproc.flight.pairing import legs
from groundproc.sensors.lasers import ESTIMATE, read_lasers
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate

SECONDS = 20.0


@pytest.fixture(scope="module")
def flight(simulated: Callable[..., Any]) -> Any:
    """Along buildings at 5 m/s, lasers off by 7 mm and 0.03 deg, gyros at 100 Hz, boresight, delay and scales off."""
    from simulator.plans import plan

    options = plan("survey_fast_gyro").options
    lidar = replace(options.lidar, laser_bias_m=0.007, elevation_error_deg=0.03)
    return simulated("calibrated_flight", "village", SECONDS, replace(options, lidar=lidar), seed=11, points=True)


@pytest.fixture(scope="module")
def made(flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("calibrate") / "out"
    assert main(["calibrate", str(flight.log), "--lasers", "-o", str(folder)]) == 0
    return folder


def made_with(folder: Path, survey: Survey, compass: Path | None = None) -> tuple[Estimate, Any]:
    """An estimate, its headings corrected by a curve where one is given; judged with its cloud where it is adjusted."""
    truth = read_truth(folder)
    with LogReader(truth.log) as reader:
        read = read_flight([reader], "ins")
        timeline = legs(read.runs, read.boots, truth.nominal_mount.mat_ins_lidar(), "auto")
        estimate = methods.estimate(
            gather([reader], read, timeline, truth.nominal_mount, survey), lambda stage, size: None
        )
        trajectory = (
            estimate.trajectory if compass is None else with_compass(estimate.trajectory, read_compass(compass))
        )
        placed = on_lidar_clock(trajectory, timeline[0].lidar_line, truth)
        cloud = [reader] if survey.method == "adjusted" else []
        lasers = estimate.corrections.table(read.lidar.lasers)
        return estimate, judge(cloud, truth, placed, estimate.mount, lasers).figures


# A flight of its own and a whole adjustment. In the quick suite: offsets within their sigma and the curve of a compass, from
# observations made up (observations/test_lasers, test_dynamic), what the command says (test_calibrate_command), and a flight
# whose lasers are estimated and told (test_estimate_folder).
@pytest.mark.soak
def test_offsets_of_the_lasers_are_found_within_their_sigma(made: Path, flight: Any) -> None:
    """A bias is what a range is too long by, and an elevation error what a laser looks too high: corrections take off and add."""
    found, report = read_lasers(made / "lasers.yaml"), json.loads((made / "calibration.json").read_text())["lasers"]
    true = np.concatenate(
        [-np.array(flight.truth["laser_bias_m"]), np.deg2rad(flight.truth["laser_elevation_error_deg"])]
    )
    off = np.concatenate([report["range_m"], np.deg2rad(report["elevation_deg"])]) - true
    sigma = np.concatenate([report["sigma_range_m"], np.deg2rad(report["sigma_elevation_deg"])])
    covariance = np.array(report["correlation"]) * np.outer(sigma, sigma)
    assert np.abs(off / sigma).max() < 4.0
    # together, as they are correlated: the mean of 64 squares is 1 to a fifth
    assert off @ np.linalg.solve(covariance + np.diag((0.03 * sigma) ** 2), off) / len(off) < 2.0
    # one against the others they are known to a tenth of what they were
    assert np.std(off[:LASERS]) < 0.1 * np.std(true[:LASERS])
    assert np.std(off[LASERS:]) < 0.15 * np.std(true[LASERS:])
    np.testing.assert_allclose(found.range_m, report["range_m"], rtol=0, atol=1e-5)
    assert (made / "lasers.png").stat().st_size > 10_000


def assert_sharper(before: dict[str, float], after: dict[str, float]) -> None:
    """15 mm of noise, and what 7 mm of bias and 0.03 deg at 10 to 20 m add to it."""
    assert after["point_rms_m"] < 0.9 * before["point_rms_m"]
    assert after["ate_m"] < before["ate_m"] + 0.002


# the flight of the one above, adjusted once more
@pytest.mark.soak
def test_a_later_run_with_the_file_has_the_sharper_cloud(made: Path, flight: Any) -> None:
    without, before = made_with(flight.folder, Survey(method="adjusted"))
    given, after = made_with(flight.folder, Survey(method="adjusted", lasers=str(made / "lasers.yaml")))
    assert not any(without.corrections.range_m)
    assert given.corrections == read_lasers(made / "lasers.yaml")
    assert_sharper(before, after)


# the flight of the one above, adjusted once more
@pytest.mark.soak
def test_processing_finds_the_same_lasers_by_itself(made: Path, flight: Any) -> None:
    """The adjustment is the one of `swath calibrate`, whose lasers are judged above; here its estimate and its cloud are too."""
    _, before = made_with(flight.folder, Survey(method="adjusted"))
    estimated, itself = made_with(flight.folder, Survey(method="adjusted", lasers=ESTIMATE))
    found = read_lasers(made / "lasers.yaml")
    np.testing.assert_allclose(found.range_m, estimated.corrections.range_m, rtol=0, atol=1e-3)
    assert estimated.report["lasers"]["range_held"] == [False] * LASERS
    assert_sharper(before, itself)


# the flight of the one above
@pytest.mark.soak
def test_the_compass_curve_holds_where_it_was_flown_and_says_where_it_was_not(made: Path, flight: Any) -> None:
    report = json.loads((made / "calibration.json").read_text())["compass"]
    assert (made / "compass.yaml").exists() == report["found"]
    assert report["found"]
    curve, options = read_compass(made / "compass.yaml"), flight.truth["options"]["ins"]
    true = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    phase = flight.truth["compass_phase_rad"]
    error = np.deg2rad(
        options["compass_offset_deg"]
        + options["compass_bias_deg"] * (np.sin(true + phase[0]) + 0.3 * np.sin(2 * true + phase[1]))
    )
    heading = (true + error) % (2.0 * np.pi)
    sector = (heading / (2.0 * np.pi) * BINS).astype(int)
    flown = np.isin(sector, np.round(np.array(report["headings_seen_deg"]) / report["sector_deg"]).astype(int))
    assert 0.0 < curve.seen < 1.0
    off, sigma = curve.trim_rad(heading) + error, curve.sigma_rad(heading)
    assert np.abs(off / sigma)[flown].max() < 3.0
    assert np.abs(off / sigma).max() < 4.0
    assert np.rad2deg(sigma[~flown]).max() > 1.5 * np.rad2deg(sigma[flown]).min()
    assert "of all headings flown" in (made / "compass.yaml").read_text().splitlines()[1]


# the flight of the one above
@pytest.mark.soak
def test_headings_of_the_autopilot_are_mended_by_the_file(made: Path, flight: Any) -> None:
    """Its compass is off by 8 deg and more, over part of the circle; what an AHRS sways by on its own, 1 deg, stays."""
    _, before = made_with(flight.folder, Survey(method="ins"))
    _, after = made_with(flight.folder, Survey(method="ins"), made / "compass.yaml")
    assert after["absolute_heading_rms_deg"] < 0.5 * before["absolute_heading_rms_deg"]


def test_an_estimate_is_asked_of_the_adjustment_only(
    gps_flight: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["process", str(gps_flight.log), "--lasers", "estimate", "-o", str(tmp_path / "out")]
    for more in (["--method", "filtered"], ["--causal"]):
        assert main([*words, *more]) == 2
        assert "only method adjusted finds them" in capfd.readouterr().err
    lost = ["process", str(gps_flight.log), "--lasers", str(tmp_path / "none.yaml"), "-o", str(tmp_path / "out")]
    assert main(lost) != 0
    assert "none.yaml: cannot be read" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()
