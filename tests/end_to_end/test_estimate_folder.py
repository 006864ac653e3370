"""The folder of `swath process` gives the same cloud again: mount, lasers, clock and covariance lie beside the trajectory."""

import json
import shutil
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pytest

from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from flightlog.records import LIDAR
from groundproc.cli import main
from groundproc.trajectory.estimate import read_estimate

Array = npt.NDArray[np.float64]


SECONDS = 11.0
"""Gyros tie clocks from 10 s on; what is estimated must differ from what was given, and need not be good."""


@pytest.fixture(scope="module")
def flight(house_flight: Any) -> Any:
    """A boresight that is off by up to a degree."""
    return house_flight


@pytest.fixture(scope="module")
def log(flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The beginning of it."""
    return begun(flight, tmp_path_factory.mktemp("begun") / "flight.mcap")


@pytest.fixture(scope="module")
def thin(flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One tenth of a second of points in twenty, for what any point tells."""
    return begun(flight, tmp_path_factory.mktemp("thin") / "flight.mcap", every=20)


def begun(flight: Any, path: Path, every: int = 1) -> Path:
    scans = 0
    with LogReader(flight.log) as reader, path.open("wb") as stream:
        writer = LogWriter(stream, metadata=dict(reader.metadata), attachments=dict(reader.attachments))
        for message in reader.messages():
            scans += message.topic == LIDAR.topic
            if message.log_time_ns < reader.start_ns + SECONDS * 1e9 and (
                message.topic != LIDAR.topic or scans % every == 0
            ):
                writer.write(message.topic, message.log_time_ns, bytes(message.data))
        writer.finish()
    return path


@pytest.fixture(scope="module")
def direct(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The products of a run that estimates all there is: mount and lasers too."""
    return processed(
        log,
        tmp_path_factory.mktemp("direct") / "out",
        "--method",
        "adjusted",
        "--lasers",
        "estimate",
        "--products",
        "cloud.laz,adjustment.png,lasers.png",
    )


def processed(log: Path, folder: Path, *words: Any) -> Path:
    # packets that are left out on purpose are no good verdict
    sound = (0, 3) if log.parent.name.startswith("thin") else (0,)
    assert main(["process", str(log), *(str(word) for word in words), "-o", str(folder)]) in sound
    return folder


def again(log: Path, folder: Path, trajectory: Path) -> Path:
    """Placed with an estimate, without pictures."""
    return processed(log, folder, "--trajectory", trajectory, "--products", "cloud.laz")


@pytest.fixture(scope="module")
def placed(thin: Path, direct: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Few points, by all that the folder holds."""
    return again(thin, tmp_path_factory.mktemp("placed") / "out", direct / "trajectory.csv")


def points(folder: Path) -> Array:
    cloud = laspy.read(folder / "cloud.laz")
    return np.stack([np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)], axis=1)


def quality(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "quality.json").read_text())
    return content


def test_the_cloud_of_the_folder_is_the_cloud(
    log: Path, direct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """To the last bit; and the folder that this makes is as good as the first."""
    new = again(log, tmp_path / "out", direct / "trajectory.csv")
    said = capsys.readouterr().out
    assert "mount estimated by adjusted, begun from log" in said
    for name in ("cloud.laz", "trajectory.npz", "mount.yaml", "lasers.yaml", "ties.yaml"):
        assert (new / name).read_bytes() == (direct / name).read_bytes(), name
    assert quality(new)["trajectory"]["method"] == "adjusted"
    assert str(direct) in quality(new)["trajectory"]["note"]


def test_which_mount_was_used_and_that_it_was_estimated_is_said(direct: Path) -> None:
    mount = quality(direct)["mount"]
    assert mount["source"] == "estimated by adjusted, begun from log"
    # what is in the report is what the points were placed with, and not what the log has
    used = read_estimate(direct).mount
    assert mount["lidar"]["yaw_deg"] == used.lidar.yaw_deg
    change = quality(direct)["adjusted"]["mount_change"]["yaw_pitch_roll_deg"]
    assert np.abs(change).max() > 0.1
    assert len(mount["sigma"]["turn_deg"]) == len(mount["sigma"]["position_m"]) == 3
    assert 0.0 < max(mount["sigma"]["turn_deg"]) < 1.0


def test_rows_that_were_changed_are_placed_to_a_millimetre(
    thin: Path, direct: Path, placed: Path, tmp_path: Path
) -> None:
    """An empty line makes it another file: its decimals are then all there is of the poses."""
    folder = tmp_path / "changed"
    shutil.copytree(direct, folder)
    with (folder / "trajectory.csv").open("a") as file:
        file.write("\n")
    new = again(thin, tmp_path / "out", folder)
    moved = np.linalg.norm(points(new) - points(placed), axis=1)
    assert np.median(moved) < 0.0005
    # 0.1 mm of the row, 5e-6 deg at 100 m, and the cloud's own millimetre in three axes
    assert moved.max() < 0.0025
    assert "was changed" in quality(new)["trajectory"]["note"]


def test_a_trajectory_that_lies_alone_is_taken_with_the_mount_of_the_log_and_that_is_said(
    thin: Path, direct: Path, placed: Path, tmp_path: Path
) -> None:
    """What the folder is for: without it points move by decimetres."""
    shutil.copy(direct / "trajectory.csv", tmp_path / "trajectory.csv")
    words = ["--trajectory", str(tmp_path / "trajectory.csv"), "--products", "cloud.laz", "-o", str(tmp_path / "out")]
    # whether it is doubted is the matter of the whole flight, below: in its beginning no place is passed twice
    assert main(["process", str(thin), *words]) in (0, 3)
    alone = tmp_path / "out"
    moved = np.linalg.norm(points(alone) - points(placed), axis=1)
    assert np.median(moved) > 0.02
    assert quality(alone)["mount"]["source"] == "log"
    assert quality(alone)["mount"]["sigma"] is None
    assert "lies alone" in quality(alone)["trajectory"]["note"]


# the whole flight adjusted, and placed twice; in the quick suite: that the mount is the log's is said
@pytest.mark.soak
def test_a_trajectory_alone_is_doubted_where_places_are_passed_twice(flight: Any, tmp_path: Path) -> None:
    """By a mount that is decimetres off the beams of one pass go through the points of another."""
    made = processed(flight.log, tmp_path / "made", "--method", "adjusted", "--products", "cloud.laz")
    shutil.copy(made / "trajectory.csv", tmp_path / "trajectory.csv")
    words = ["--trajectory", str(tmp_path / "trajectory.csv"), "--products", "cloud.laz", "-o", str(tmp_path / "out")]
    assert main(["process", str(flight.log), *words]) == 3


def test_clock_and_lasers_are_those_of_the_folder(thin: Path, direct: Path, placed: Path, tmp_path: Path) -> None:
    """A clock that is 20 ms late gives the same points later stamps; ranges that are 0.3 m too long move them by that."""
    folder = tmp_path / "changed"
    shutil.copytree(direct, folder)
    ties = folder / "ties.yaml"
    offset_ns = read_estimate(direct).ties[0].lines[-1].offset_ns
    text = ties.read_text()
    assert text.count(str(offset_ns)) == 1
    ties.write_text(text.replace(str(offset_ns), str(offset_ns + 20_000_000)))
    (folder / "lasers.yaml").write_text("range_m: [" + ", ".join(["0.3"] * 32) + "]\n")
    late = again(thin, tmp_path / "late", folder)
    new_s, old_s = (np.asarray(laspy.read(each / "cloud.laz").gps_time) for each in (late, placed))
    new_s = new_s - 0.02
    # all but the shots at the ends of the trajectory are in both clouds; stamps are right to 0.1 us
    both = max(new_s[0], old_s[0]) - 1e-6, min(new_s[-1], old_s[-1]) + 1e-6
    new, old = ((stamps > both[0]) & (stamps < both[1]) for stamps in (new_s, old_s))
    np.testing.assert_allclose(new_s[new], old_s[old], rtol=0, atol=1e-6)
    assert new.mean() > 0.99
    moved = np.linalg.norm(points(late)[new] - points(placed)[old], axis=1)
    # in 20 ms the aircraft flies 0.1 m and turns by a few tenths of a degree
    assert 0.2 < np.median(moved) < 0.5


def test_the_sigmas_are_the_roots_of_the_written_covariances(direct: Path) -> None:
    with np.load(direct / "covariance.npz") as held:
        time_ns, covariance = held["time_ns"], held["covariance"]
    table = np.genfromtxt(direct / "trajectory.csv", delimiter=",", names=True, dtype=None)
    rows = np.searchsorted(table["utc_ns"], time_ns)
    assert (table["utc_ns"][rows] == time_ns).all()
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    for column, name in enumerate(("east", "north", "up")):
        np.testing.assert_allclose(sigma[:, column], table[f"sigma_{name}_m"][rows], rtol=0, atol=6e-5)
    for column, name in enumerate(("roll", "pitch", "heading"), 3):
        np.testing.assert_allclose(np.rad2deg(sigma[:, column]), table[f"sigma_{name}_deg"][rows], rtol=0, atol=6e-5)
    assert np.diff(time_ns).max() == 100_000_000
    assert np.linalg.eigvalsh(covariance / (sigma[:, :, None] * sigma[:, None, :])).min() > -1e-9


@pytest.mark.parametrize("name", ["mount.yaml", "covariance.npz", "report.json"])
def test_a_folder_that_is_not_whole_is_refused_in_one_sentence(
    log: Path, direct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    folder = tmp_path / "cut"
    shutil.copytree(direct, folder)
    (folder / name).unlink()
    assert main(["process", str(log), "--trajectory", str(folder), "-o", str(tmp_path / "out")]) != 0
    said = capsys.readouterr().err
    assert name in said
    assert said.count("\n") == 1
