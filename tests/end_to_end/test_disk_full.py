"""The disk of the real `swathd` runs out of space, and gets some again."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from recording import recording, run

from flightlog import records
from flightlog.logfile import LogReader
from onboard import logfolder

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root to mount a small file system"),
]


def health(folder: Path) -> tuple[int, str]:
    command = [sys.executable, "-m", "onboard.cli", "health", "--config", str(folder / "swathd.yaml")]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    return answer.returncode, answer.stdout


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_the_lidar_stops_mavlink_goes_on_then_the_log_is_closed_and_begins_again_when_there_is_room(
    tmp_path: Path,
) -> None:
    disk, status = tmp_path / "disk", tmp_path / "status.json"
    disk.mkdir()
    run("mount", "-t", "tmpfs", "-o", "size=40m", "tmpfs", disk)

    def recorder() -> dict[str, object]:
        tree: dict[str, dict[str, object]] = json.loads(status.read_text())
        return tree["recorder"]

    try:
        with recording(tmp_path, disk / "logs", lidar=True, segment_s=3600, min_free_mb=16) as daemon:
            wait_for(lambda: status.exists() and recorder()["space"] == "room")
            filler = disk / "other"
            filler.write_bytes(bytes(logfolder.free_bytes(disk) - (12 << 20)))
            wait_for(lambda: recorder()["space"] == "low")
            code, said = health(tmp_path)
            assert code == 2
            assert "the lidar is not recorded" in said
            time.sleep(2.0)
            filler.write_bytes(bytes(filler.stat().st_size + (9 << 20)))
            wait_for(lambda: recorder()["space"] == "full")
            assert "nothing is recorded" in health(tmp_path)[1]
            wait_for(lambda: len(logfolder.read_manifest(disk / "logs")) == 1)
            filler.unlink()
            wait_for(lambda: recorder()["space"] == "room" and recorder()["segments"] == 2)
            time.sleep(1.0)
            daemon.terminate()
            assert daemon.wait(120) == 0
        first, second = sorted((disk / "logs").glob("*.mcap"))
        lines = logfolder.read_manifest(disk / "logs")
        for log in (first, second):
            assert lines[log.name]["sha256"] == logfolder.sha256(log)
            with LogReader(log) as reader:
                topics = [(message.topic, message.log_time_ns) for message in reader.messages()]
                assert not reader.damage
            assert any(topic == records.LIDAR.topic for topic, _ in topics)
            if log == first:  # MAVLink went on for 2 s after the lidar's last packet
                last = dict(topics)
                assert last["/mavlink/ins"] - last[records.LIDAR.topic] > 1.5e9
    finally:
        run("umount", "-l", disk)
