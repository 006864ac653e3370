"""An estimate's folder: what is written comes back, and what is not whole is refused in one sentence."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from flightlog import frames
from flightlog.errors import ConfigError, LogError, SwathError
from flightlog.mount import Mount
from groundproc.flight.timeline import ClockTie, Line
from groundproc.geodesy import LocalFrame
from groundproc.sensors.lasers import LaserCorrections
from groundproc.trajectory.covariance import Correlation
from groundproc.trajectory.estimate import (
    CHANGED,
    FILES,
    Estimate,
    MountSigma,
    is_estimate,
    read_estimate,
    write_estimate,
)
from groundproc.trajectory.trajectory import HOLD, Trajectory

START_NS = 1_779_272_223_123_456_789
KNOTS = 400


def correlations(count: int, seed: int = 1) -> np.ndarray:
    """Correlation matrices of random errors, more of them than there are states."""
    draws = np.random.default_rng(seed).normal(size=(count, 6, 9))
    covariance = draws @ np.swapaxes(draws, 1, 2)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return np.asarray(covariance / sigma[:, :, None] / sigma[:, None, :])


@pytest.fixture
def estimate() -> Estimate:
    """Two seconds at 200 Hz of nothing in particular, with a gap in it, and something in every field."""
    rng = np.random.default_rng(3)
    time_ns = START_NS + np.arange(KNOTS, dtype=np.int64) * 5_000_000
    quat = frames.quat_exp(np.cumsum(rng.normal(0, 0.002, (KNOTS, 3)), axis=0))
    covered = np.ones(KNOTS, np.bool_)
    covered[[120, -1]] = False
    trajectory = Trajectory(
        LocalFrame(58.394123456789, 15.574987654321, 61.3),
        time_ns,
        np.cumsum(rng.normal(0, 0.02, (KNOTS, 3)), axis=0),
        rng.normal(0, 4, (KNOTS, 3)),
        quat,
        rng.normal(0, 0.4, (KNOTS, 3)),
        rng.uniform(0.01, 2, (KNOTS, 3)),
        rng.uniform(0.001, 0.1, (KNOTS, 3)),
        covered,
        HOLD,
        Correlation(time_ns[::20], correlations(KNOTS // 20)),
    )
    return Estimate(
        trajectory,
        Mount().with_lidar(yaw_deg=1.25, pitch_deg=-19.123456789012345, position_m=(0.01, -0.02, -0.16)),
        "as made up",
        LaserCorrections(range_m=tuple(0.001 * i for i in range(32)), sigma_range_m=(0.002,) * 32),
        (
            ClockTie(17, 10**18, (Line(3, 1.25e-5, 10**12), Line(-(10**18))), "host"),
            ClockTie(2 * 10**18, 3 * 10**18, (Line(4),), "gprmc"),
        ),
        "estimated by adjusted, begun from log",
        MountSigma((0.001, 0.002, 0.003), (0.01, 0.02, 0.03)),
        {"note": "", "rounds": [{"rows": 3, "rms": 0.5}], "none": None, "held": [True, False]},
        "something is odd",
        {"residual_m": np.arange(5.0), "laser": np.array([[1, 2]], np.uint8)},
        method="adjusted",
        note="said",
    )


def same(found: Trajectory, wanted: Trajectory) -> None:
    """Every array to the last bit, but for the correlations, which are rounded once."""
    for field in fields(Trajectory):
        if field.name != "correlation":
            np.testing.assert_array_equal(getattr(found, field.name), getattr(wanted, field.name), err_msg=field.name)
    assert found.correlation is not None
    assert wanted.correlation is not None
    np.testing.assert_array_equal(found.correlation.time_ns, wanted.correlation.time_ns)
    np.testing.assert_allclose(found.correlation.matrix, wanted.correlation.matrix, rtol=0, atol=1e-14)


def test_an_estimate_comes_back_to_the_last_bit(estimate: Estimate, tmp_path: Path) -> None:
    assert not is_estimate(tmp_path)
    write_estimate(tmp_path, estimate)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FILES)
    assert is_estimate(tmp_path)
    found = read_estimate(tmp_path)
    same(found.trajectory, estimate.trajectory)
    for name in ("mount", "sigma_source", "corrections", "ties", "mount_source", "mount_sigma", "report", "warning"):
        assert getattr(found, name) == getattr(estimate, name), name
    assert (found.method, found.note) == (estimate.method, estimate.note)
    assert found.figures.keys() == estimate.figures.keys()
    for name, array in estimate.figures.items():
        np.testing.assert_array_equal(found.figures[name], array)
        assert found.figures[name].dtype == array.dtype


def test_the_same_estimate_is_the_same_bytes(estimate: Estimate, tmp_path: Path) -> None:
    folders = tmp_path / "a", tmp_path / "b"
    for folder in folders:
        folder.mkdir()
        write_estimate(folder, estimate)
    for name in FILES:
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes(), name
    again = tmp_path / "c"
    again.mkdir()
    write_estimate(again, read_estimate(folders[0]))
    for name in FILES:
        if name != "covariance.npz":  # correlations are divided out and multiplied in again
            assert (again / name).read_bytes() == (folders[0] / name).read_bytes(), name


def test_an_estimate_without_correlations_states_diagonal_covariances(estimate: Estimate, tmp_path: Path) -> None:
    write_estimate(tmp_path, replace(estimate, trajectory=replace(estimate.trajectory, correlation=None)))
    with np.load(tmp_path / "covariance.npz") as held:
        time_ns, covariance = held["time_ns"], held["covariance"]
    # a tenth of a second apart, both ends included
    assert time_ns[0] == estimate.trajectory.time_ns[0]
    assert time_ns[-1] == estimate.trajectory.time_ns[-1]
    assert np.diff(time_ns).max() <= 100_000_000
    rows = np.searchsorted(estimate.trajectory.time_ns, time_ns)
    sigma = np.hstack([estimate.trajectory.sigma_position_m, estimate.trajectory.sigma_attitude_rad])[rows]
    np.testing.assert_allclose(covariance, sigma[:, :, None] ** 2 * np.eye(6), rtol=1e-12)


def test_sigmas_that_nobody_stated_stay_unstated(estimate: Estimate, tmp_path: Path) -> None:
    unknown = np.full((KNOTS, 3), np.nan)
    write_estimate(tmp_path, replace(estimate, trajectory=replace(estimate.trajectory, sigma_attitude_rad=unknown)))
    found = read_estimate(tmp_path).trajectory
    assert np.isnan(found.sigma_attitude_rad).all()
    covariance = found.covariance_at(found.time_ns[:3])
    assert np.isfinite(covariance[:, :3, :3]).all()
    assert np.isnan(covariance[:, 3:, :]).all()


def test_a_changed_trajectory_csv_is_believed_and_said(estimate: Estimate, tmp_path: Path) -> None:
    write_estimate(tmp_path, estimate)
    path = tmp_path / "trajectory.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:301]) + "\n")
    found = read_estimate(tmp_path)
    assert len(found.trajectory) == 300
    assert CHANGED in found.note
    # its columns hold tenths of a millimetre
    np.testing.assert_allclose(found.trajectory.position_m, estimate.trajectory.position_m[:300], rtol=0, atol=2e-4)


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_one_sentence(estimate: Estimate, tmp_path: Path, name: str) -> None:
    write_estimate(tmp_path, estimate)
    (tmp_path / name).unlink()
    with pytest.raises(SwathError, match=name) as told:
        read_estimate(tmp_path)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_anywhere_is_one_sentence_or_what_was_written(estimate: Estimate, tmp_path: Path, name: str) -> None:
    write_estimate(tmp_path, estimate)
    path = tmp_path / name
    whole = path.read_bytes()
    for share in np.linspace(0.0, 0.99, 12):
        path.write_bytes(whole[: int(share * len(whole))])
        try:
            read_estimate(tmp_path)
            told = ""
        except SwathError as error:
            told = str(error)
        # a table or a YAML file may end at the end of a line
        assert name in told or name in ("trajectory.csv", "mount.yaml", "lasers.yaml", "ties.yaml")
        assert "\n" not in told


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"time_ns": np.array([2, 1], np.int64)}, "position_m"),
        ({"position_m": np.zeros((KNOTS, 2))}, "position_m"),
        ({"frame": np.zeros(2)}, "frame"),
        ({"interpolation": np.array("straight")}, "interpolation"),
        ({"covered": np.zeros(KNOTS)}, "covered"),
    ],
)
def test_arrays_of_another_kind_are_refused(
    estimate: Estimate, tmp_path: Path, changed: dict[str, np.ndarray], expected: str
) -> None:
    write_estimate(tmp_path, estimate)
    path = tmp_path / "trajectory.npz"
    with np.load(path) as held:
        arrays = {name: held[name] for name in held.files}
    np.savez(path, **(arrays | changed))
    with pytest.raises(LogError, match=expected):
        read_estimate(tmp_path)


def test_an_interrupted_writing_leaves_no_folder_that_reads(estimate: Estimate, tmp_path: Path) -> None:
    """The report goes first and comes last: files of two runs are never taken for one estimate."""
    write_estimate(tmp_path, estimate)
    broken = replace(estimate, figures={"object": np.array([object()])})
    with pytest.raises(ValueError, match="pickle"):
        write_estimate(tmp_path, broken)
    with pytest.raises(LogError, match=r"report\.json"):
        read_estimate(tmp_path)
    assert not [path.name for path in tmp_path.iterdir() if path.name.endswith(".part")]


def test_a_report_of_another_program_is_refused(estimate: Estimate, tmp_path: Path) -> None:
    write_estimate(tmp_path, estimate)
    (tmp_path / "report.json").write_text(json.dumps({"clouds": []}))
    with pytest.raises(ConfigError, match=r"report\.json.*clouds"):
        read_estimate(tmp_path)
