"""The card stops answering for ten seconds, with the real `swathd` on it: what was handed to the kernel waits, nobody else does.

The file system of the logs is on a loop device whose own file is on another file system, and that is frozen: requests of the device
are taken and not finished, as with a card that is busy with itself. Writing goes on into memory; the next sync waits.
"""

import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from recording import mounted, recording, run

from flightlog import records
from flightlog.logfile import LogReader

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root to mount and freeze file systems"),
]

STALL_S = 10.0


def test_a_card_that_stalls_for_ten_seconds_costs_nothing_that_is_not_counted(tmp_path: Path) -> None:
    outer, inner = tmp_path / "outer.img", tmp_path / "outer" / "card.img"
    run("truncate", "-s", "700M", outer)
    run("mkfs.ext4", "-q", outer)
    with mounted(outer, tmp_path / "outer"):
        run("truncate", "-s", "400M", inner)
        run("mkfs.ext4", "-q", inner)
        with mounted(inner, tmp_path / "card") as card:
            figures = stalled_recording(tmp_path, card / "logs")
    assert figures["disk_stall_seen_s"] > 0.5 * STALL_S  # the sync did wait; without the stall it takes milliseconds
    assert figures["disk_stall_uncounted"] == 0
    if path := os.environ.get("SWATH_FIGURES"):
        with Path(path).open("a") as file:
            file.write(json.dumps(figures) + "\n")


def stalled_recording(folder: Path, logs: Path) -> dict[str, float]:
    """Record, freeze, thaw, record on; what became of the packets."""
    with recording(folder, logs, lidar=True, segment_s=3600) as daemon:
        time.sleep(3.0)
        run("fsfreeze", "-f", folder / "outer")
        try:
            time.sleep(STALL_S - 1.0)
            during = json.loads((folder / "status.json").read_text())
            time.sleep(1.0)
        finally:
            run("fsfreeze", "-u", folder / "outer")
        assert daemon.poll() is None
        assert during["lidar"]["state"] == "good"  # the receiver and the status went on
        assert during["lidar"]["age_s"] < 0.5 * STALL_S
        time.sleep(3.0)
        after = json.loads((folder / "status.json").read_text())
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(120) == 0
    packets: list[int] = []
    told = 0
    (path,) = logs.glob("*.mcap")
    with LogReader(path) as log:
        for message in log.messages((records.LIDAR.topic, records.LIDAR_ACCOUNT.topic)):
            if message.topic == records.LIDAR.topic:
                packets += records.decode_scan(message.data)["data"]["stamp_us"].tolist()
            else:
                account = records.decode_account(message.data)
                told += account.kernel_drops + account.queue_drops
        assert not log.damage
    assert (np.diff(packets) > 0).all()
    missing = packets[-1] - packets[0] + 1 - len(packets)
    return {
        "disk_stall_seen_s": round(after["recorder"]["slowest_sync_ms"] / 1e3, 2),
        "disk_stall_lost_packets": missing,
        "disk_stall_uncounted": max(0, missing - told),
    }
