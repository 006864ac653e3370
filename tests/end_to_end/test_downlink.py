"""The real `swathd` with a live downlink: a second one on the ground records the same, and a slow link takes nothing from the first."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flightlog import records
from flightlog.logfile import LogReader

SWATH = [sys.executable, "-c", "import sys; from groundproc.cli import main; sys.exit(main(sys.argv[1:]))"]
SWATHD = [sys.executable, "-m", "onboard.cli"]


def until(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


class Swathd:
    """A running daemon and its ports."""

    def __init__(self, folder: Path, wrap: list[str] | None = None, **more: Any) -> None:
        folder.mkdir()
        self.lidar, self.position, self.mavlink = free_port(), free_port(), free_port()
        self.logs = folder / "logs"
        address = {"address": "127.0.0.1", "data_port": self.lidar, "position_port": self.position}
        tree = {
            "lidar": address | {"fov": {"start_deg": 0, "end_deg": 0}},
            "ins": {"device": f"udp:127.0.0.1:{self.mavlink}"},
            "recorder": {"directory": str(self.logs)},
            **more,
        }
        config = folder / "swathd.yaml"
        config.write_text(json.dumps(tree))
        self.process = subprocess.Popen(
            [*(wrap or []), *SWATHD, "run", "--config", str(config)], stderr=subprocess.PIPE, text=True
        )
        until(lambda: (self.logs / "status.json").exists() or self.process.poll() is not None)
        assert self.process.poll() is None, self.process.communicate()[1]

    def play(self, log: Path, wrap: list[str] | None = None) -> None:
        words = ["--lidar-port", str(self.lidar), "--position-port", str(self.position)]
        words += ["--mavlink", f"udp:127.0.0.1:{self.mavlink}"]
        subprocess.run(
            [*(wrap or []), *SWATH, "replay", str(log), *words], check=True, capture_output=True, timeout=300
        )

    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.logs / "status.json").read_text())
        return found

    def wait_for_all(self, log: Path) -> None:
        """Every data packet of a log came, and the daemon has since gone on for so long that nothing waits anywhere."""
        with LogReader(log) as reader:
            packets = sum(len(records.decode_scan(m.data)) for m in reader.messages((records.LIDAR.topic,)))
        until(lambda: self.status()["lidar"]["received"] + self.status()["lidar"]["kernel_drops"] >= packets)
        came_s = self.status()["uptime_s"]
        until(lambda: self.status()["uptime_s"] > came_s + 1.5)

    def stop(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        stderr = self.process.communicate(timeout=120)[1]
        assert self.process.returncode == 0, stderr

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()

    def contents(self) -> dict[str, bytes]:
        (log,) = self.logs.glob("*.mcap")
        return contents(log)


def contents(log: Path) -> dict[str, bytes]:
    """Packets and bytes by topic."""
    found: dict[str, list[bytes]] = {records.LIDAR.topic: [], records.POSITION.topic: [], "/mavlink/ins": []}
    with LogReader(log) as reader:
        for message in reader.messages(tuple(found)):
            if message.topic == records.LIDAR.topic:
                found[message.topic].append(np.ascontiguousarray(records.decode_scan(message.data)["data"]).tobytes())
            else:
                found[message.topic] += [chunk for _, chunk in records.decode_raw(message.data)]
    return {topic: b"".join(parts) for topic, parts in found.items()}


def test_a_swathd_on_the_ground_records_what_the_one_aboard_does(tmp_path: Path, dual_flight: Any) -> None:
    ground = Swathd(tmp_path / "ground")
    try:
        ports = {"lidar_port": ground.lidar, "position_port": ground.position, "mavlink_port": ground.mavlink}
        aboard = Swathd(tmp_path / "aboard", downlink={"address": "127.0.0.1", "rate_kbit_s": 100_000, **ports})
        try:
            aboard.play(dual_flight.log)
            aboard.wait_for_all(dual_flight.log)
            ground.wait_for_all(dual_flight.log)
            aboard.stop()
        finally:
            aboard.kill()
        ground.stop()
    finally:
        ground.kill()
    down = aboard.status()["downlink"]
    assert (down["thinned"], down["dropped"], down["unheard"], down["trouble"]) == (0, 0, 0, "")
    assert aboard.contents() == contents(dual_flight.log)
    assert ground.contents() == aboard.contents()


SLOW = """
set -e
ip link set lo up
ip link add slow type veth peer name far
ip address add 10.77.0.1/24 dev slow
ip link set slow up
ip link set far up
ip neighbour add 10.77.0.2 lladdr 02:00:00:00:00:02 dev slow
tc qdisc add dev slow root tbf rate 4mbit burst 10kb latency 2s
echo ready
exec sleep 600
"""


@pytest.mark.root
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: makes a network namespace")
@pytest.mark.skipif(not all(map(shutil.which, ("unshare", "ip", "tc", "nsenter"))), reason="needs iproute2, util-linux")
def test_a_slow_link_to_the_ground_takes_nothing_from_the_recording(tmp_path: Path, dual_flight: Any) -> None:
    """36 Mbit/s of dual return packets for a link of 4: nine of ten are dropped and counted, none is missing in the log."""
    with subprocess.Popen(["unshare", "--net", "sh", "-c", SLOW], stdout=subprocess.PIPE, text=True) as network:
        try:
            assert network.stdout is not None
            assert network.stdout.readline() == "ready\n"
            inside = ["nsenter", "--net", "--target", str(network.pid)]
            aboard = Swathd(tmp_path / "aboard", inside, downlink={"address": "10.77.0.2", "rate_kbit_s": 100_000})
            try:
                aboard.play(dual_flight.log, inside)
                aboard.wait_for_all(dual_flight.log)
                aboard.stop()
            finally:
                aboard.kill()
        finally:
            network.kill()
    down, lidar = aboard.status()["downlink"], aboard.status()["lidar"]
    assert aboard.contents() == contents(dual_flight.log)
    assert (lidar["kernel_drops"], lidar["queue_drops"]) == (0, 0)
    assert down["trouble"] == ""
    assert 0 < down["sent"] < down["dropped"]
