"""`swathd` as a process, with a lidar and an autopilot that send to it, on a file system of its own where a test wants one."""

import json
import random
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from flightlog import hdl32e

PACKETS_S = 1808
MAVLINK_S = 20


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


class Sources(threading.Thread):
    """A lidar, numbered by its stamps, if it is not silent; and some bytes of an autopilot."""

    def __init__(self, data_port: int, mavlink_port: int, *, lidar: bool) -> None:
        super().__init__(daemon=True)
        packets = np.zeros(1, hdl32e.DATA_DTYPE)
        packets["blocks"]["flag"] = hdl32e.BLOCK_FLAG
        packets["return_mode"], packets["product"] = hdl32e.ReturnMode.STRONGEST, hdl32e.PRODUCT_ID
        packet = bytearray(packets.tobytes())
        dice = random.Random(2)
        for block in range(12):  # noise: what a flat file would compress to nothing
            packet[block * 100 + 4 : block * 100 + 100] = dice.randbytes(96)
        self._packet, self._lidar = bytes(packet), lidar
        self._data, self._mavlink = ("127.0.0.1", data_port), ("127.0.0.1", mavlink_port)
        self._end = threading.Event()

    def run(self) -> None:
        begin, sent, told = time.monotonic(), 0, 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self._end.is_set():
                passed = time.monotonic() - begin
                while self._lidar and sent < passed * PACKETS_S:
                    sender.sendto(self._packet[:1200] + struct.pack("<I", sent) + self._packet[1204:], self._data)
                    sent += 1
                while told < passed * MAVLINK_S:
                    sender.sendto(struct.pack("<I", told), self._mavlink)
                    told += 1
                time.sleep(0.002)

    def stop(self) -> None:
        self._end.set()
        self.join()


def run(*command: object) -> None:
    subprocess.run([str(word) for word in command], check=True, capture_output=True)


@contextmanager
def mounted(image: Path, folder: Path) -> Iterator[Path]:
    folder.mkdir(exist_ok=True)
    run("mount", "-o", "loop", image, folder)
    try:
        yield folder
    finally:
        run("umount", "-l", folder)


@contextmanager
def recording(folder: Path, logs: Path, *, lidar: bool, **recorder: Any) -> Iterator[subprocess.Popen[bytes]]:
    """`swathd` at full rate, or with a silent lidar."""
    data_port, mavlink_port = free_port(), free_port()
    settings = {
        "lidar": {
            "address": "127.0.0.1",
            "data_port": data_port,
            "position_port": free_port(),
            "fov": {"start_deg": 0, "end_deg": 0},
        },
        "ins": {"device": f"udp:127.0.0.1:{mavlink_port}"},
        "recorder": {"directory": str(logs), "segment_s": 1, "min_free_mb": 8, **recorder},
        "status_file": str(folder / "status.json"),
        "health": {"prometheus": str(folder / "swathd.prom")},
    }
    config = folder / "swathd.yaml"
    config.write_text(json.dumps(settings))
    sources = Sources(data_port, mavlink_port, lidar=lidar)
    sources.start()
    command = [sys.executable, "-m", "onboard.cli", "run", "--config", str(config)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as daemon:
        try:
            wait_for_segment(logs)
            yield daemon
        finally:
            sources.stop()
            daemon.kill()


def wait_for_segment(logs: Path) -> None:
    end = time.monotonic() + 120
    while not any(path.stat().st_size for path in logs.glob("*.mcap")):
        assert time.monotonic() < end
        time.sleep(0.05)
