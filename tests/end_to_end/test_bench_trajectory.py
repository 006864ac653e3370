"""The benchmark of trajectories on a short flight whose revolutions are thinned out, and the parts of its peers."""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flightlog import frames
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.accuracy.truth import read_truth
from groundproc.flight.flight import read_flight
from groundproc.flight.pairing import legs

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
KEYS = {
    "ate_m", "rotation_rms_deg", "cloud_floor_ratio", "facade_floor_ratio", "heading_settle_s", "real_time_factor",
}  # fmt: skip


@pytest.fixture(autouse=True)
def with_benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))


@pytest.fixture
def judged(judged_flight: Any) -> Iterator[LogReader]:
    with LogReader(judged_flight.log) as reader:
        yield reader


def bench(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, BENCHMARKS / "trajectory.py", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)


def test_figures_table_and_pictures_of_a_short_flight(judged_flight: Any, tmp_path: Path) -> None:
    out = tmp_path / "results"
    done = bench("--log", judged_flight.folder, "--cold", "--methods", "ins", "--out", out)
    assert done.returncode == 0, done.stderr
    (figures,) = json.loads(done.stdout.splitlines()[-1]).values()
    assert set(figures) == KEYS
    # a compass wrong by 8 deg and a GNSS by 2 m: far from the floor
    assert 0.05 < figures["ate_m"] < 5.0
    assert 1.0 < figures["rotation_rms_deg"] < 15.0
    assert figures["cloud_floor_ratio"] > 10.0
    assert figures["real_time_factor"] > 0.0
    results = json.loads((out / "trajectory.json").read_text())["results"]
    assert results["truth"]["cloud_floor_ratio"] == pytest.approx(1.0, abs=1e-9)
    assert "| ins |" in (out / "trajectory.md").read_text()
    for name in ("trajectories", "errors", "heading", "sections"):
        assert (out / f"{name}.png").stat().st_size > 10_000, name


# the benchmark started once more; in the quick suite: its figures, table and pictures (above)
@pytest.mark.soak
def test_a_method_that_fails_says_why_and_the_others_go_on(judged_flight: Any, tmp_path: Path) -> None:
    import trajectory

    with pytest.raises(SystemExit, match="slam"):
        trajectory.main(["--methods", "slam", "--log", str(judged_flight.folder), "--cold", "--out", str(tmp_path)])
    log = tmp_path / "flight"
    log.mkdir()
    for name in ("truth.csv", "truth.json", "truth_points.npy"):
        (log / name).symlink_to(judged_flight.folder / name)
    (log / "flight.mcap").write_bytes((judged_flight.folder / "flight.mcap").read_bytes()[:3000])
    done = bench("--log", log, "--cold", "--methods", "ins", "--out", tmp_path / "results")
    assert done.returncode == 1
    figures = json.loads(done.stdout.splitlines()[-1])["ins"]
    assert figures["ate_m"] is None
    assert "flight.mcap" in figures["error"]


def test_a_flight_over_a_meadow_follows_with_the_same_methods(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    import trajectory

    flown: list[tuple[str, Path]] = []

    def measure(arguments: Any, folder: Path) -> dict[str, dict[str, Any]]:
        flown.append((arguments.flight, arguments.out))
        return {
            "ins": {"ate_m": 1.0},
            "kiss_icp": {"error": "lost"} if arguments.flight == "meadow" else {"ate_m": 9.0},
        }

    monkeypatch.setattr(trajectory, "measure", measure)
    assert trajectory.main(["--out", str(tmp_path)]) == 0  # a peer that fails is no failure of ours
    assert flown == [("survey_fast_gyro", tmp_path), ("meadow", tmp_path / "meadow")]
    line = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert set(line["ins"]) == KEYS | {"meadow"}
    assert set(line["ins"]["meadow"]) == KEYS
    assert line["kiss_icp"]["meadow"]["error"] == "lost"
    assert trajectory.main(["--out", str(tmp_path), "--no-meadow"]) == 0
    assert len(flown) == 3


def test_every_method_of_the_command_line_takes_part() -> None:
    from trajectory import own_methods

    from groundproc.estimation.methods import METHODS

    assert set(own_methods()) >= set(METHODS)


# -- what the peers are given


def test_scans_are_whole_revolutions_with_times_that_grow(simulated: Any) -> None:
    from peers.scans import scans

    from simulator.config import Options

    flight = simulated("whole_turns", "field", 1.5, Options())
    with LogReader(flight.log) as reader:
        found = list(scans([reader]))
    ends = np.array([scan.end_ns for scan in found])
    assert 12 <= len(found) <= 14
    assert np.diff(ends) * 1e-9 == pytest.approx(0.1, abs=0.002)  # 600 rpm; a packet is 0.55 ms
    for scan in found:
        assert (np.diff(scan.time_ns) >= 0).all()
        # 210 of 360 deg
        assert (scan.time_ns[-1] - scan.time_ns[0]) * 1e-9 == pytest.approx(0.1 * 210 / 360, abs=0.003)
        azimuth = np.degrees(np.arctan2(scan.points_m[:, 0], scan.points_m[:, 1]))
        assert np.abs(azimuth).max() < 105.5


@pytest.mark.parametrize("fast", [True, False])
def test_gyros_of_the_peers_turn_as_the_lidar_does(judged_flight: Any, judged: LogReader, fast: bool) -> None:
    """Over 0.1 s: the autopilot's by their 25 Hz within 1 deg, the lidar's own, at 1.1 deg/s of noise, within 0.2 deg."""
    from peers import motion

    truth = read_truth(judged_flight.folder)
    flight = read_flight([judged], "ins")
    timeline = legs(flight.runs, flight.boots, truth.nominal_mount.mat_ins_lidar(), "auto")
    run = flight.runs[0]
    gyros = motion.gyros(timeline[0], replace(run, gyro=None) if fast else run, truth.nominal_mount)
    start, hours = truth.lidar.start_ns, run.gyro.time_ns[0] // 3_600_000_000_000 * 3_600_000_000_000
    missed = []
    for second in np.arange(4.0, 17.0, 0.5):
        times = start + np.array([0, 100_000_000]) + int(second * 1e9)
        poses = truth.trajectory.at(times).quat_local_ins_wxyz
        true = frames.mat_from_quat(poses) @ truth.mount.mat_ins_lidar()
        said = gyros.at(int(times[0] + hours), times[1:] + hours)[0]
        missed.append(np.degrees((said.inv() * Rotation.from_matrix(true[0].T @ true[1])).magnitude()))
    assert np.sqrt(np.square(missed).mean()) < (1.0 if fast else 0.2)


def test_a_dense_trajectory_goes_through_the_poses_of_the_lidar() -> None:
    from peers.motion import Pose, dense

    from groundproc.geodesy import LocalFrame

    mount = Mount()
    times = np.arange(0, 2_000_000_001, 100_000_000)
    turns = Rotation.from_rotvec(np.linspace(0, 1, len(times))[:, None] * [0.1, -0.2, 1.0])
    places = np.stack([np.sin(times * 1e-9), np.cos(times * 1e-9), 0.1 * times * 1e-9], axis=1)
    poses = [Pose(int(t), m, p) for t, m, p in zip(times, turns.as_matrix(), places, strict=True)]
    made = dense(poses, None, mount, LocalFrame(58.0, 15.0, 0.0)).at(times[:-2])
    ins = frames.mat_from_quat(made.quat_local_ins_wxyz)
    np.testing.assert_allclose(ins @ mount.mat_ins_lidar(), turns.as_matrix()[:-2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(made.position_m + ins @ mount.lidar_position_m(), places[:-2], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["kiss_icp", "small_gicp_gicp", "small_gicp_vgicp", "small_gicp_vgicp_gyro"])
def test_peers_stay_where_nothing_moves(name: str) -> None:
    """A room of three planes, seen five times from one place: no peer may move by more than the noise of its points."""
    pytest.importorskip("kiss_icp" if name == "kiss_icp" else "small_gicp")
    from peers.motion import Gyros
    from peers.odometries import PEERS
    from peers.scans import Scan

    rng = np.random.default_rng(10)
    room = rng.uniform(-8, 8, (6000, 3))
    room[:2000, 2], room[2000:4000, 0], room[4000:, 1] = -3.0, 8.0, 8.0
    still = Gyros(np.arange(0, 10**9, 10**7), np.zeros((100, 3)))
    seen = [
        Scan(
            room + rng.normal(scale=0.01, size=room.shape),
            np.linspace(0, 58_000_000, len(room)).astype(np.int64) + k * 10**8,
        )
        for k in range(5)
    ]
    poses = PEERS[name](seen, still)
    assert [pose.time_ns for pose in poses] == [scan.end_ns for scan in seen]
    for pose in poses:
        assert np.linalg.norm(pose.position_m) < 0.02
        assert np.abs(pose.mat - np.eye(3)).max() < 0.005
