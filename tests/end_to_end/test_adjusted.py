"""Method `adjusted` from the log on, against the simulation's truth."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import tied
from scipy.stats import chi2

from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from flightlog.records import LIDAR
from groundproc.accuracy.judge import judge
from groundproc.accuracy.truth import on_lidar_clock, read_truth
from groundproc.estimation import methods
from groundproc.estimation.adjustment import adjusted, windows
from groundproc.estimation.method import gather
from groundproc.estimation.odometry.track import Track
from groundproc.flight.flight import read_flight
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate

SECONDS = 20.0
DRAWS = 12
"""By so many draws the adjustment knows a sigma: to a fifth, one sigma."""

Array = npt.NDArray[np.float64]


@dataclass
class Judged:
    """An estimate and its figures."""

    estimate: Estimate
    figures: dict[str, Any]
    fix_sigma_m: Array
    """What the receiver says of a fix: east, north, up."""


@pytest.fixture(scope="module")
def flight(house_flight: Any) -> Any:
    return house_flight


@pytest.fixture(scope="module")
def hovers(simulated: Callable[..., Any]) -> list[Any]:
    """Nothing to see but a flat field, twice: what the compass and the fixes do in 15 s is luck."""
    from simulator.plans import plan

    return [simulated(f"adjusted_hover_{seed}", "field", 15.0, plan("hover").options, seed=seed) for seed in (11, 12)]


def judged(
    folder: Path, survey: Survey, log: Path | None = None, *, cloud: Path | None = None, solved: Estimate | None = None
) -> Judged:
    """Estimate where it is not solved yet, and compare with the truth as the benchmark does; a cloud by a log of its scans."""
    truth = read_truth(folder)
    with LogReader(log or truth.log) as reader, LogReader(cloud or truth.log) as scans:
        read = read_flight([reader], "ins")
        timeline = tied.timeline(log or truth.log, read, truth.nominal_mount.mat_ins_lidar())
        given = gather([reader], read, timeline, truth.nominal_mount, survey)
        made = solved or methods.estimate(given, lambda stage, size: None)
        placed = on_lidar_clock(made.trajectory, timeline[0].lidar_line, truth)
        lasers = made.corrections.table(read.lidar.lasers)
        found = judge([scans] if cloud else [], truth, placed, made.mount, lasers)
    return Judged(made, found.figures, given.fixes[0].sigma_m.max(axis=0))


@pytest.fixture(scope="module")
def scans(flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A third of its revolutions, whole ones from the first to the last: how thick the cloud is, millions of its points tell as well."""
    path: Path = tmp_path_factory.mktemp("scans") / "flight.mcap"
    seen = 0
    with LogReader(flight.log) as reader, path.open("wb") as stream:
        writer = LogWriter(stream, metadata=dict(reader.metadata), attachments=dict(reader.attachments))
        for message in reader.messages():
            seen += message.topic == LIDAR.topic
            if message.topic != LIDAR.topic or seen % 3 == 0:
                writer.write(message.topic, message.log_time_ns, bytes(message.data))
        writer.finish()
    return path


@pytest.fixture(scope="module")
def whole(flight: Any, scans: Path, adjustment: Callable[[Any], Estimate]) -> Judged:
    return judged(flight.folder, Survey(), cloud=scans, solved=adjustment(flight))


@pytest.fixture(scope="module")
def autopilots(flight: Any) -> Judged:
    return judged(flight.folder, Survey(method="ins"))


@contextmanager
def short_windows(slices: int, overlap: int) -> Iterator[list[int]]:
    """Windows of a long flight, on a short one; gives the numbers of slices whose clusters are held when a window is adjusted."""
    held: list[int] = []
    adjust_window = windows.adjust_window

    def counted(track: Track, *rest: Any, **named: Any) -> Any:
        held.append(sum(len(clusters) > 0 for clusters in track.clusters))
        return adjust_window(track, *rest, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adjusted, "adjust_window", counted)
        patch.setattr(adjusted, "WINDOW", slices)
        for module in (adjusted, windows):
            patch.setattr(module, "OVERLAP", overlap)
        yield held


def test_the_whole_flight_is_right_to_the_sensors_noise(whole: Judged, autopilots: Judged) -> None:
    figures = whole.figures
    assert whole.estimate.method == "adjusted"
    assert whole.estimate.warning == ""
    assert figures["ate_m"] <= 0.02
    assert figures["rotation_rms_deg"] <= 0.06
    assert figures["cloud_floor_ratio"] <= 1.25
    # what it began from
    assert autopilots.figures["ate_m"] > 0.2
    assert autopilots.figures["rotation_rms_deg"] > 1.0


def test_what_is_common_to_the_flight_is_found_within_its_sigma(flight: Any, whole: Judged) -> None:
    """Boresight, lever arm, delay and both gyros' biases: errors over sigmas are a draw of chi-square, too large no more than too small."""
    truth = read_truth(flight.folder)
    estimated = whole.estimate.report["estimated"]
    off_deg = np.abs(whole.figures["boresight_error_deg"])
    nominal = judge([], truth, truth.trajectory, truth.nominal_mount).figures
    assert np.linalg.norm(off_deg) < 0.5 * np.linalg.norm(nominal["boresight_error_deg"])
    # both units are carried along in the lidar's axes; its gyros 1, 2, 3 look forward, left and up (manual, p. 8)
    to_lidar = truth.nominal_mount.mat_ins_lidar().T
    forward, left, up = flight.truth["lidar_gyro_offset_deg_s"]
    errors = {
        "ins.turn_deg": off_deg,
        "ins.lever_m": to_lidar @ whole.figures["lever_error_m"],
        "ins.delay_s": np.array([whole.figures["time_error_ms"] * 1e-3]),
        "ins.bias_deg_s": estimated["ins.bias_deg_s"]["value"] - to_lidar @ flight.truth["ins_gyro_bias_deg_s"],
        "lidar.bias_deg_s": np.array(estimated["lidar.bias_deg_s"]["value"]) - [-left, forward, up],
    }
    over = np.concatenate([error / np.array(estimated[name]["sigma"]) for name, error in errors.items()])
    assert chi2.ppf(0.0005, len(over)) < np.square(over).sum() < chi2.ppf(0.9995, len(over)), over


def test_no_sigma_is_below_what_noise_allows_nor_above_what_was_known_before(flight: Any, whole: Judged) -> None:
    from simulator.plans import plan

    options, estimated = plan("survey_fast_gyro").options, whole.estimate.report["estimated"]
    # where nothing is learned the sigma is its prior, as well as the draws know it; of some 40 components the luckiest
    low, high = (np.sqrt(chi2.ppf(p, DRAWS) / DRAWS) for p in (1e-3 / 40, 1 - 1e-3 / 40))
    for name, entry in estimated.items():
        value, sigma, prior = (np.array(entry[key]) for key in ("value", "sigma", "prior_sigma"))
        assert value.shape == sigma.shape == prior.shape
        assert (sigma < high * prior).all(), name
    # a bias is the mean of what the gyro says less what the path turns: white noise alone leaves so much
    samples = {"ins": SECONDS * options.link.raw_sensors_hz, "lidar": SECONDS / (9 * 552.96e-6)}
    white = {"ins": options.ins.gyro_noise_deg_s, "lidar": options.gyros.noise_deg_s}
    for unit, noise in white.items():
        sigma = np.array(estimated[f"{unit}.bias_deg_s"]["sigma"])
        assert (sigma > low * noise / np.sqrt(samples[unit])).all(), unit
    # the whole flight hangs on the fixes, whose error lasts for tau: their mean is that good (a Gauss-Markov process), a fix is worse
    ratio = SECONDS / options.ins.gnss_tau_s
    of_mean = np.sqrt(2.0 * (ratio - 1.0 + np.exp(-ratio))) / ratio
    sigma = np.median(whole.estimate.trajectory.sigma_position_m[:, :2], axis=0)
    assert (sigma > 0.8 * of_mean * options.ins.gnss_sigma_m).all()
    assert (sigma < 1.2 * whole.fix_sigma_m[:2]).all()
    off = np.array(whole.figures["absolute_mean_error_m"]) / np.median(
        whole.estimate.trajectory.sigma_position_m, axis=0
    )
    assert np.square(off).sum() < chi2.ppf(0.9995, 3)


def test_the_same_flight_in_windows_is_as_good(flight: Any, scans: Path, whole: Judged) -> None:
    """Five windows of 6 s with 2 s in common: the same path, on the same place, and a cloud as thin."""
    with short_windows(60, 20) as held:
        made = judged(flight.folder, Survey(method="adjusted"), cloud=scans)
    assert len(made.estimate.report["windows"]) == len(held) >= 4
    # memory: a window's clusters and no more, however many windows there were before
    assert max(held) <= 60
    assert made.estimate.warning == ""
    assert made.figures["ate_m"] <= 0.02
    assert made.figures["rotation_rms_deg"] <= 0.06
    assert made.estimate.trajectory.time_ns[0] == whole.estimate.trajectory.time_ns[0]
    assert len(made.estimate.trajectory) == len(whole.estimate.trajectory)
    # no step where windows meet: 5 m/s and what changes it in 5 ms
    steps = np.linalg.norm(np.diff(made.estimate.trajectory.position_m, n=2, axis=0), axis=1)
    assert steps.max() < 0.005
    assert made.figures["cloud_floor_ratio"] <= 1.05 * whole.figures["cloud_floor_ratio"]
    # both are placed by the mean of all fixes, and turned by their course and the compass; lever arms are known to 5 cm before
    ours, theirs = made.estimate.trajectory, whole.estimate.trajectory
    np.testing.assert_allclose(ours.position_m.mean(axis=0), theirs.position_m.mean(axis=0), rtol=0, atol=0.2)
    off = np.abs(ours.position_m - theirs.position_m)
    assert (off < 2.0 * np.hypot(ours.sigma_position_m, theirs.sigma_position_m)).all()
    # nothing of the joining is kept back, and its figures are in the report
    assert made.estimate.report["joining"]["rounds"][-1]["apart_m"] < 0.005
    assert whole.estimate.report["joining"] is None


def test_nothing_of_the_future_costs_centimetres(flight: Any, whole: Judged) -> None:
    made = judged(flight.folder, Survey(causal=True))
    assert made.estimate.report["causal"] is True
    assert made.estimate.warning == ""
    assert whole.figures["ate_m"] < made.figures["ate_m"] <= 0.05


# a second whole adjustment; in the quick suite a cluster's products are those of here byte by byte, by the autopilot's solution
@pytest.mark.soak
def test_runs_are_alike(flight: Any, whole: Judged) -> None:
    """Sums over cores are of fixed parts: the same log gives the same trajectory, to rounding."""
    again = judged(flight.folder, Survey(method="adjusted"))
    np.testing.assert_allclose(
        again.estimate.trajectory.position_m, whole.estimate.trajectory.position_m, rtol=0, atol=1e-6
    )


@pytest.fixture(scope="module")
def hovered(hovers: list[Any]) -> list[tuple[Judged, Judged]]:
    """By the autopilot and by the adjustment."""
    return [(judged(h.folder, Survey(method="ins")), judged(h.folder, Survey(method="adjusted"))) for h in hovers]


def rms_of(found: Sequence[Judged], figure: str) -> float:
    """Of a figure over flights."""
    return float(np.sqrt(np.mean([each.figures[figure] ** 2 for each in found])))


# two flights of their own; in the quick suite: errors and sigmas of the village are held to the truth
@pytest.mark.soak
def test_over_a_flat_field_the_place_is_no_worse_than_the_autopilots(hovered: list[tuple[Judged, Judged]]) -> None:
    """Only height and tilt have a witness; the place is that of the smoother, and its sigma says so."""
    raw, made = zip(*hovered, strict=True)
    assert rms_of(made, "ate_m") <= 1.01 * rms_of(raw, "ate_m")
    assert np.mean([each.figures["position_within_2_sigma"] for each in made]) >= 0.9
    assert all(np.median(each.estimate.trajectory.sigma_position_m[:, :2]) > 0.5 for each in made)


# by the two flights of the one above
@pytest.mark.soak
def test_over_a_flat_field_the_heading_is_no_worse_than_the_autopilots(hovered: list[tuple[Judged, Judged]]) -> None:
    raw, made = zip(*hovered, strict=True)
    assert rms_of(made, "rotation_rms_deg") <= rms_of(raw, "rotation_rms_deg")
    for each in made:
        assert np.median(each.estimate.trajectory.sigma_attitude_rad[:, 2]) > np.deg2rad(2.0)


# one more whole adjustment; in the quick suite: how dark seconds are bridged (adjustment/test_bridging)
@pytest.mark.soak
def test_seconds_without_lidar_are_bridged_and_said(flight: Any, autopilots: Judged, tmp_path: Path) -> None:
    """4 s dark: what the inertial sensors carry on is off by their noise, 0.3 m/s^2 at 100 Hz and what is left of their bias."""
    log = tmp_path / "dark.mcap"
    with LogReader(flight.log) as reader, log.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments=dict(reader.attachments))
        for message in reader.messages():
            since_s = (message.log_time_ns - reader.start_ns) * 1e-9
            if message.topic != "/velodyne_packets" or not 8.0 <= since_s < 12.0:
                writer.write(message.topic, message.log_time_ns, bytes(message.data))
        writer.finish()
    made = judged(flight.folder, Survey(method="adjusted"), log)
    assert made.estimate.report["blind_s"] == pytest.approx(4.0, abs=0.3)
    assert "without planes" in made.estimate.report["note"]
    assert made.figures["ate_m"] < 0.5 * autopilots.figures["ate_m"]
    assert made.figures["rotation_rms_deg"] < 0.5 * autopilots.figures["rotation_rms_deg"]
    # the dark seconds are less certain than those about them
    track = made.estimate.trajectory
    seconds = (track.time_ns - track.time_ns[0]) * 1e-9
    dark, bright = (seconds > 9.0) & (seconds < 11.0), (seconds > 14.0) & (seconds < 18.0)
    sigma = np.linalg.norm(track.sigma_attitude_rad[:, :2], axis=1)
    assert np.median(sigma[dark]) > np.median(sigma[bright])


def test_a_track_of_a_second_is_refused(flight: Any, tmp_path: Path) -> None:
    """Ask for it by name and it says what it lacks; as the best it makes room for the next."""
    log = tmp_path / "short.mcap"
    with LogReader(flight.log) as reader, log.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments=dict(reader.attachments))
        for message in reader.messages():
            since_s = (message.log_time_ns - reader.start_ns) * 1e-9
            if message.topic != "/velodyne_packets" or since_s < 1.3:
                writer.write(message.topic, message.log_time_ns, bytes(message.data))
        writer.finish()
    truth = read_truth(flight.folder)
    with LogReader(log) as reader:
        read = read_flight([reader], "ins")
        timeline = tied.timeline(log, read, truth.nominal_mount.mat_ins_lidar())
        given = gather([reader], read, timeline, truth.nominal_mount, Survey())
        made = methods.estimate(given, lambda stage, size: None)
        assert made.method == "filtered"
        assert "tenths of a second" in made.note
        named = replace(given, survey=Survey(method="adjusted"))
        with pytest.raises(Exception, match="tenths of a second"):
            methods.estimate(named, lambda stage, size: None)
