"""The whole recorder stands still for four seconds: the kernel's receive buffer holds what comes meanwhile."""

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from recording import recording

from flightlog import records
from flightlog.logfile import LogReader
from onboard.config import LidarConfig

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(
        os.geteuid() != 0, reason="needs root to allow a receive buffer as large as `swathd install` does"
    ),
]

STALL_S = 4.0
_LIMIT = Path("/proc/sys/net/core/rmem_max")


@pytest.fixture
def large_buffers() -> Iterator[None]:
    before = int(_LIMIT.read_text())
    _LIMIT.write_text(str(max(before, LidarConfig().receive_buffer_kb << 10)))
    yield
    _LIMIT.write_text(str(before))


@pytest.mark.usefixtures("large_buffers")
def test_four_seconds_of_standstill_cost_no_packet_and_no_receive_time(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    with recording(tmp_path, logs, lidar=True, segment_s=3600) as daemon:
        time.sleep(2.0)
        for _ in range(2):
            daemon.send_signal(signal.SIGSTOP)
            time.sleep(STALL_S)
            daemon.send_signal(signal.SIGCONT)
            time.sleep(1.5)
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(120) == 0
    scans, dropped = [], 0
    (path,) = logs.glob("*.mcap")
    with LogReader(path) as log:
        for message in log.messages((records.LIDAR.topic, records.LIDAR_ACCOUNT.topic)):
            if message.topic == records.LIDAR.topic:
                scans.append(records.decode_scan(message.data))
            else:
                dropped += records.decode_account(message.data).kernel_drops
    packets = np.concatenate(scans)
    assert dropped == 0
    assert (np.diff(packets["data"]["stamp_us"].astype(np.int64)) == 1).all()
    late_ns = records.receive_time_ns(packets) - packets["data"]["stamp_us"] * (1e9 / 1808)
    assert np.ptp(late_ns) < 0.5 * STALL_S * 1e9  # stamps are the kernel's: they do not wait for us
    if figures := os.environ.get("SWATH_FIGURES"):
        with Path(figures).open("a") as file:
            file.write(json.dumps({"receiver_stall_lost_packets": dropped}) + "\n")
