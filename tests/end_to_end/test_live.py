"""`swath live` against the simulation's truth: in real time from the network, and behind a log that grows."""

import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pytest

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from groundproc.accuracy.alignment import best_rigid
from groundproc.cli import main
from groundproc.trajectory.table import read_trajectory

Array = npt.NDArray[np.float64]

SWATH = [sys.executable, "-c", "import sys; from groundproc.cli import main; sys.exit(main(sys.argv[1:]))"]
FLIGHT_S = 18.0
START_S = 5.0
"""What the start may take: 3 s of clocks and gyros, and the searches for them."""
POSITION_RMS_M = 0.05
"""A tenth of a second old and without a look back: an odometry of 2 cm ranges on planes, begun from a moving autopilot's attitude."""


@pytest.fixture(scope="module")
def flight(live_flight: Any) -> Any:
    return live_flight


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def rows(folder: Path) -> npt.NDArray[np.void]:
    return np.asarray(np.genfromtxt(folder / "trajectory_live.csv", delimiter=",", names=True, dtype=None))


def utc_of(flight: Any, lidar_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """True UTC of lidar times, which swath carries on over the hour: whole hours between the two mean nothing."""
    clock, utc = flight.truth["clocks"]["lidar"], flight.truth["clocks"]["utc"]
    hour = 3600 * 10**9
    since = lidar_ns - clock["start_ns"]
    since -= np.round((since - FLIGHT_S * 5e8) / hour).astype(np.int64)[0] * hour
    return np.asarray(utc["start_ns"] + np.rint(since / (1 + clock["drift_ppm"] * 1e-6)).astype(np.int64))


def errors_m(flight: Any, table: npt.NDArray[np.void]) -> Array:
    """Distances from the truth after one rigid alignment."""
    truth = read_trajectory(flight.poses_file)
    poses, covered = truth.where_covered(utc_of(flight, table["lidar_ns"].astype(np.int64)))
    estimated = np.stack([table[name] for name in ("east_m", "north_m", "up_m")], axis=1)[covered]
    true = poses.position_m[covered]
    assert covered.sum() >= 0.95 * len(table)
    rigid = best_rigid(estimated, true)
    return np.asarray(np.linalg.norm(rigid.points(estimated) - true, axis=1))


class Live:
    """A running `swath live` that listens."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.lidar, self.position, self.mavlink = free_port(), free_port(), free_port()
        self.page = free_port(socket.SOCK_STREAM)
        words = ["--address", "127.0.0.1", "--lidar-port", str(self.lidar), "--position-port", str(self.position)]
        words += ["--mavlink", f"udp:127.0.0.1:{self.mavlink}", "--port", str(self.page), "--json", "-o", str(folder)]
        self.process = subprocess.Popen(
            [*SWATH, "live", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stderr is not None
        for line in self.process.stderr:
            if line.startswith("listening"):
                return
        pytest.fail(f"it ended with {self.process.wait()}")

    def get(self, path: str) -> tuple[http.client.HTTPMessage, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.page, timeout=120)
        connection.request("GET", path)
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        return answer.headers, body

    def wait_until_it_has_caught_up(self) -> None:
        """Until no slice was added for two seconds: the player has ended, and nothing that it sent waits any more."""
        before, quiet, end = -1.0, 0, time.monotonic() + 120
        while quiet < 4:
            assert time.monotonic() < end
            time.sleep(0.5)
            now = json.loads(self.get("/status")[1])["seconds"]
            quiet, before = quiet + 1 if now == before else 0, now

    def end(self) -> list[dict[str, Any]]:
        """SIGTERM; what it told."""
        self.process.send_signal(signal.SIGTERM)
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        told = [json.loads(line) for line in self.process.stdout]
        self.process.stdout.close()
        self.process.stderr.close()
        assert self.process.wait() == 0
        return told


def test_a_flight_is_followed_in_real_time(tmp_path: Path, flight: Any) -> None:
    live = Live(tmp_path / "live")
    try:
        words = ["--lidar-port", str(live.lidar), "--position-port", str(live.position)]
        words += ["--mavlink", f"udp:127.0.0.1:{live.mavlink}"]
        subprocess.run([*SWATH, "replay", str(flight.log), *words], check=True, capture_output=True)
        live.wait_until_it_has_caught_up()
        status = json.loads(live.get("/status")[1])
        head, body = live.get("/points?generation=0&from=0")
        told = live.end()
    finally:
        if live.process.returncode is None:
            live.process.kill()
            live.process.wait()
    table = rows(live.folder)
    assert len(table) >= 10 * (FLIGHT_S - START_S)
    assert (np.diff(table["lidar_ns"]) == 100_000_000).all()
    assert np.sqrt(np.mean(np.square(errors_m(flight, table)))) < POSITION_RMS_M
    assert status["drops"]["queue"] == status["drops"]["kernel"] == status["drops"]["rejected"] == 0
    assert status["cloud"]["points"] >= int(head["X-Count"]) > 50_000
    assert len(body) == 13 * int(head["X-Count"])
    assert {one["state"] for one in told} >= {"tracking"}
    cloud = laspy.read(live.folder / "cloud_live.laz")
    assert len(cloud.points) == status["cloud"]["points"]


@pytest.fixture(scope="module")
def followed(flight: Any, tmp_path_factory: pytest.TempPathFactory) -> npt.NDArray[np.void]:
    """Rows of a log that was followed while it grew."""
    folder = tmp_path_factory.mktemp("followed")
    grown, out = folder / "grown.mcap", folder / "live"
    content = flight.log.read_bytes()
    grown.write_bytes(content[:100_000])

    def grow() -> None:
        with grown.open("ab") as file:
            for start in range(100_000, len(content), 3_000_017):
                file.write(content[start : start + 3_000_017])
                file.flush()
                time.sleep(0.1)

    writer = threading.Thread(target=grow)
    writer.start()
    try:
        code = main(["live", "--follow", str(grown), "--port", "0", "-o", str(out)])
    finally:
        writer.join()
    assert code == 0
    return rows(out)


def test_a_log_that_grows_is_followed_to_its_end(followed: npt.NDArray[np.void], flight: Any) -> None:
    assert len(followed) >= 10 * (FLIGHT_S - START_S)
    assert np.sqrt(np.mean(np.square(errors_m(flight, followed)))) < POSITION_RMS_M


# the flight once more by the other method; in the quick suite both are held to the truth, each for itself
@pytest.mark.soak
def test_it_agrees_with_the_causal_method_on_the_log(
    tmp_path: Path, flight: Any, followed: npt.NDArray[np.void]
) -> None:
    """Behind the log, and by `swath process --method adjusted --causal`: the same filter in other slices."""
    words = ["--method", "adjusted", "--causal", "--products", "trajectory.gpx", "-o", str(tmp_path / "processed")]
    assert main(["process", str(flight.log), *words]) == 0
    table, causal = followed, read_trajectory(tmp_path / "processed" / "trajectory.csv")
    poses, covered = causal.where_covered(table["utc_ns"].astype(np.int64))
    estimated = np.stack([table[name] for name in ("east_m", "north_m", "up_m")], axis=1)[covered]
    # UTC labels of the live rows may be late by the link's delay: along the path that is no difference between methods
    velocity = np.gradient(poses.position_m[covered], 0.1, axis=0)
    rigid = best_rigid(estimated, poses.position_m[covered])
    off = rigid.points(estimated) - poses.position_m[covered]
    late_s = (off * velocity).sum() / np.square(velocity).sum()
    assert abs(late_s) < 0.1
    off = off - late_s * velocity
    assert len(off) > 10 * (FLIGHT_S - START_S)
    assert np.sqrt(np.square(off).sum(axis=1).mean()) < POSITION_RMS_M


# the flight followed once more; in the quick suite: the smoother with one unit only (test_filtered), and the live view with both
@pytest.mark.soak
def test_without_the_lidars_own_unit_the_autopilots_carries_it(tmp_path: Path, flight: Any) -> None:
    """No position packets, as where port 8308 is not sent down: RAW_IMU at 25 Hz, on clocks tied by receive times."""
    bare = tmp_path / "bare.mcap"
    with LogReader(flight.log) as reader, bare.open("wb") as file:
        writer = LogWriter(file, metadata=dict(reader.metadata), attachments=dict(reader.attachments))
        for message in reader.messages():
            if message.topic != records.POSITION.topic:
                writer.write(message.topic, message.log_time_ns, bytes(message.data))
        writer.finish()
    assert main(["live", "--follow", str(bare), "--port", "0", "-o", str(tmp_path / "live")]) == 0
    table = rows(tmp_path / "live")
    assert len(table) >= 10 * (FLIGHT_S - START_S - 1.0)
    assert np.sqrt(np.mean(np.square(errors_m(flight, table)))) < 3 * POSITION_RMS_M


def told_of(log: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """What the last line of JSON says after a log was followed."""
    capsys.readouterr()
    assert main(["live", "--follow", str(log), "--port", "0", "--json", "-o", str(out)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    last: dict[str, Any] = json.loads(lines[-1])
    return last


def test_an_autopilot_that_starts_again_is_tied_again(
    tmp_path: Path, rebooted_flight: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    status = told_of(rebooted_flight.log, tmp_path / "live", capsys)
    assert status["counts"]["reboots"] == 1
    assert status["counts"]["clock_jumps"] == 0
    boot, lidar = rebooted_flight.truth["clocks"]["boot"], rebooted_flight.truth["clocks"]["lidar"]
    before_s = (boot["start_ns"] - lidar["start_ns"]) * 1e-9
    assert status["sync"] is not None
    # the new boot's clock began some 20 s after the old one's: an offset that is older by that and by whole hours
    off_s = (status["sync"]["offset_s"] - before_s) % 3600.0
    assert off_s > 10.0
    assert off_s < 3600.0 - 10.0
    assert len(rows(tmp_path / "live")) > 10 * 35


def test_a_lidar_clock_that_is_set_in_flight_begins_anew_in_the_same_frame(
    tmp_path: Path, flight: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    jumped, cut_ns = tmp_path / "jumped.mcap", 0
    with LogReader(flight.log) as reader, jumped.open("wb") as file:
        cut_ns = (reader.start_ns + reader.end_ns) // 2
        writer = LogWriter(file, metadata=dict(reader.metadata), attachments=dict(reader.attachments))
        for message in reader.messages():
            data = bytes(message.data)
            if message.topic == records.LIDAR.topic and message.log_time_ns > cut_ns:
                packets = records.decode_scan(data)
                packets["data"]["stamp_us"] = (packets["data"]["stamp_us"] + 1_000_000_000) % 3_600_000_000
                data = records.encode_scan(message.log_time_ns, packets)
            elif message.topic == records.POSITION.topic and message.log_time_ns > cut_ns:
                times, samples = records.decode_position(data)
                samples = samples.copy()
                samples["stamp_us"] = (samples["stamp_us"] + 1_000_000_000) % 3_600_000_000
                chunks = [(int(t), np.asarray(each).tobytes()) for t, each in zip(times, samples, strict=True)]
                data = records.encode_raw(message.log_time_ns, chunks, "velodyne")
            writer.write(message.topic, message.log_time_ns, data)
        writer.finish()
    status = told_of(jumped, tmp_path / "live", capsys)
    assert status["counts"]["clock_jumps"] >= 1
    table = rows(tmp_path / "live")
    assert (np.diff(table["utc_ns"]) > 0).all()
    steps = np.diff(table["lidar_ns"])
    (jump,) = np.flatnonzero(np.abs(steps) > 900 * 10**9)
    assert min(jump, len(table) - jump) > 20
    # metres apart as the autopilot's positions are wrong, and not in another frame
    places = np.stack([table[name] for name in ("east_m", "north_m", "up_m")], axis=1)
    flown_m = 5.0 * (table["utc_ns"][jump + 1] - table["utc_ns"][jump]) * 1e-9
    assert np.linalg.norm(places[jump + 1] - places[jump]) < flown_m + 3 * 5.0


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (["--follow", "none.mcap"], 1, "none.mcap: no such file"),
        (["--mavlink", "udp:nothing"], 2, "--mavlink 'udp:nothing': expected udp:ADDRESS:PORT"),
        (["--points", "5"], 2, "--points 5: expected 10000 or more"),
        (["--gyro-delay-ms", "80"], 2, "gyro_delay_ms: 80"),
        (["--address", "203.0.113.7"], 1, "UDP port 2368 at 203.0.113.7 cannot be opened"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, sentence: str
) -> None:
    out = tmp_path / "out"
    assert main(["live", "-o", str(out), "--port", "0", *words]) == code
    errors = capsys.readouterr().err.strip()
    assert errors.count("\n") == 0
    assert sentence in errors
    assert not out.exists()


def test_nothing_heard_leaves_no_cloud(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--address", "127.0.0.1", "--lidar-port", str(free_port()), "--position-port", str(free_port())]
    words += ["--mavlink", f"udp:127.0.0.1:{free_port()}", "--port", "0", "--duration", "1.2"]
    assert main(["live", "-o", str(tmp_path / "out"), *words]) == 0
    assert "no pose" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["trajectory_live.csv"]
