import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from flightlog import records
from flightlog.logfile import LogReader
from groundproc.cli import main

TCPDUMP = shutil.which("tcpdump")


@pytest.mark.root
@pytest.mark.skipif(os.geteuid() != 0, reason="capturing from an interface needs root")
@pytest.mark.skipif(TCPDUMP is None, reason="tcpdump is not installed")
@pytest.mark.parametrize("interface", ["lo", "any"])
def test_what_tcpdump_captures_is_imported_whole(
    interface: str,
    turning: Callable[..., list[tuple[int, bytes]]],
    position_payload: Callable[..., bytes],
    tmp_path: Path,
) -> None:
    receivers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for receiver in receivers:
        receiver.bind(("127.0.0.1", 0))
    lidar_port, position_port = (int(receiver.getsockname()[1]) for receiver in receivers)
    capture, log = tmp_path / "live.pcap", tmp_path / "live.mcap"
    command = [str(TCPDUMP), "-i", interface, "-U", "-w", str(capture), "-Z", "root", "udp", "dst", "port"]
    sent = [payload for _, payload in turning(0.2)]
    before_ns = time.time_ns()
    with subprocess.Popen([*command, f"({lidar_port} or {position_port})"], stderr=subprocess.PIPE, text=True) as dump:
        assert dump.stderr is not None
        while "listening on" not in dump.stderr.readline():
            assert dump.poll() is None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
            for i, payload in enumerate(sent):
                sensor.sendto(payload, ("127.0.0.1", lidar_port))
                if i % 9 == 0:
                    sensor.sendto(position_payload(i * 553), ("127.0.0.1", position_port))
                time.sleep(0.0002)
        deadline = time.monotonic() + 60
        while capture.stat().st_size < len(sent) * 1248 and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.2)
        dump.send_signal(signal.SIGINT)
    for receiver in receivers:
        receiver.close()
    ports = ["--lidar-port", str(lidar_port), "--position-port", str(position_port)]
    assert main(["import", "--pcap", str(capture), "-o", str(log), *ports]) == 0
    with LogReader(log) as reader:
        scans = [records.decode_scan(m.data) for m in reader.messages((records.LIDAR.topic,))]
        position = [records.decode_position(m.data) for m in reader.messages((records.POSITION.topic,))]
    assert [bytes(packet["data"]) for scan in scans for packet in scan] == sent
    assert sum(len(packets) for _, packets in position) == -(-len(sent) // 9)
    times = [int(t) for scan in scans for t in records.receive_time_ns(scan)]
    assert before_ns <= times[0] <= times[-1] <= time.time_ns()
