"""An hour's packets through the real `swathd`, ten times as fast: its memory stays below 100 MB, and where it was."""

import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from recording import free_port

from flightlog import hdl32e, records
from flightlog.logfile import LogReader

ROOT = Path(__file__).resolve().parents[2]
TIMES = 10
SECONDS = 3600 / TIMES
RATE = TIMES * 1e9 / hdl32e.PACKET_NS
LEAST_FREE_BYTES = 12e9
"""4.6 GB of logs."""
ALLOWED_MB, ALLOWED_GROWTH_MB = 100.0, 2.0


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Path]:
    """A folder with room for the logs, emptied afterwards."""
    free = shutil.disk_usage(tmp_path).free
    if free < LEAST_FREE_BYTES:
        pytest.skip(f"{free / 1e9:.0f} GB free in {tmp_path}, an hour needs {LEAST_FREE_BYTES / 1e9:.0f}")
    yield tmp_path
    shutil.rmtree(tmp_path)


def resident_mb(pid: int) -> float:
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


def watch(pid: int, end: threading.Event, samples: list[float]) -> None:
    while not end.wait(1.0):
        samples.append(resident_mb(pid))


def logged(logs: Path) -> tuple[int, int]:
    """Packets that became something, and those counted as lost."""
    taken = lost = 0
    for path in logs.glob("*.mcap"):
        with LogReader(path) as log:
            for message in log.messages((records.LIDAR_ACCOUNT.topic,)):
                account = records.decode_account(message.data)
                taken += account.kept + account.masked_packets
                lost += account.kernel_drops + account.queue_drops
            assert not log.damage
    return taken, lost


# six minutes by the clock
@pytest.mark.soak
def test_an_hour_of_packets_in_six_minutes_leaves_memory_where_it_was(place: Path) -> None:
    port, mavlink_port, logs = free_port(), free_port(), place / "logs"
    settings = {
        "lidar": {"address": "127.0.0.1", "data_port": port, "position_port": free_port()},
        "ins": {"device": f"udp:127.0.0.1:{mavlink_port}"},
        "recorder": {"directory": str(logs)},
    }
    (place / "swathd.yaml").write_text(json.dumps(settings))
    daemon = [sys.executable, "-m", "onboard.cli", "run", "--config", str(place / "swathd.yaml")]
    sender = [sys.executable, str(ROOT / "benchmarks" / "capture.py"), "--send", f"--rate={RATE}"]
    sender += [f"--seconds={SECONDS}", f"--port={port}", f"--mavlink-port={mavlink_port}"]
    samples: list[float] = []
    end = threading.Event()
    with subprocess.Popen(daemon, stderr=subprocess.DEVNULL) as process:
        try:
            time.sleep(2.0)
            watching = threading.Thread(target=watch, args=(process.pid, end, samples))
            watching.start()
            sent = json.loads(subprocess.run(sender, check=True, capture_output=True, text=True).stdout)["sent"]
            time.sleep(1.0)
        finally:
            end.set()
            watching.join()
            process.terminate()
        assert process.wait(60) == 0

    assert sent == pytest.approx(3600e9 / hdl32e.PACKET_NS, rel=0.01)
    taken, lost = logged(logs)
    assert taken + lost == sent
    quarter = len(samples) // 4
    growth = statistics.median(samples[-quarter:]) - statistics.median(samples[quarter : 2 * quarter])
    if figures := os.environ.get("SWATH_FIGURES"):
        found = {
            "memory_hour_mb": round(max(samples), 1),
            "memory_hour_growth_mb": round(growth, 2),
            "hour_packets": sent,
            "hour_packets_lost": lost,
        }
        with Path(figures).open("a") as file:
            file.write(json.dumps(found) + "\n")
    assert max(samples) < ALLOWED_MB
    assert growth < ALLOWED_GROWTH_MB
