"""A log played by `swath replay` into the real `swathd`: the second log holds what the first holds, bit for bit."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from flightlog import records
from flightlog.logfile import LogReader


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def contents(log: Path) -> dict[str, list[bytes]]:
    """Packets and bytes by topic."""
    found: dict[str, list[bytes]] = {"data": [], "position": [], "mavlink": []}
    with LogReader(log) as reader:
        for message in reader.messages():
            if message.topic == records.LIDAR.topic:
                found["data"] += [np.asarray(p).tobytes() for p in records.decode_scan(message.data)["data"]]
            elif message.topic == records.POSITION.topic:
                found["position"] += [chunk for _, chunk in records.decode_raw(message.data)]
            elif message.topic == "/mavlink/ins":
                found["mavlink"] += [chunk for _, chunk in records.decode_raw(message.data)]
    return found


def test_a_replayed_flight_is_recorded_bit_for_bit(tmp_path: Path, dual_flight: Any) -> None:
    lidar, position, mavlink = free_port(), free_port(), free_port()
    config = tmp_path / "swathd.yaml"
    tree = {
        "lidar": {
            "address": "127.0.0.1", "data_port": lidar, "position_port": position, "fov": {"start_deg": 0, "end_deg": 0}
        },
        "ins": {"device": f"udp:127.0.0.1:{mavlink}"},
        "recorder": {"directory": str(tmp_path / "logs")},
    }  # fmt: skip
    config.write_text(json.dumps(tree))

    def status() -> dict[str, Any]:
        return dict(json.loads((tmp_path / "logs" / "status.json").read_text()))

    daemon = subprocess.Popen(
        [sys.executable, "-m", "onboard.cli", "run", "--config", str(config)], stderr=subprocess.PIPE, text=True
    )
    try:
        until(lambda: (tmp_path / "logs" / "status.json").exists() or daemon.poll() is not None)
        assert daemon.poll() is None, daemon.communicate()[1]
        words = ["--lidar-port", str(lidar), "--position-port", str(position), "--mavlink", f"udp:127.0.0.1:{mavlink}"]
        program = "import sys; from groundproc.cli import main; sys.exit(main(sys.argv[1:]))"
        command = [sys.executable, "-c", program, "replay", str(dual_flight.log), *words]
        played = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300, env=os.environ)
        assert played.returncode == 0, played.stderr
        packets = len(contents(dual_flight.log)["data"])
        until(lambda: status()["lidar"]["received"] >= packets)
        came_s = status()["uptime_s"]
        until(lambda: status()["uptime_s"] > came_s + 1.5)  # nothing waits anywhere any more
        daemon.send_signal(signal.SIGTERM)
        stderr = daemon.communicate(timeout=120)[1]
    finally:
        daemon.kill()
        daemon.wait()
    assert daemon.returncode == 0, stderr
    (log,) = (tmp_path / "logs").glob("*.mcap")
    sent, recorded = contents(dual_flight.log), contents(log)
    assert len(sent["data"]) > 1000
    assert recorded["data"] == sent["data"]
    assert recorded["position"] == sent["position"]
    assert b"".join(recorded["mavlink"]) == b"".join(sent["mavlink"])


def until(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)
