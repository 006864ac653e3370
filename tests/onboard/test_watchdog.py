"""The watchdog is earned: the daemon in this process, its socket heard as systemd would hear it."""

import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from flightlog.stopflag import StopFlag
from onboard import config
from onboard.daemon import Daemon


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(tmp_path / "notify"))
        sock.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield sock


def heard(systemd: socket.socket) -> list[str]:
    found = []
    while True:
        try:
            found.append(systemd.recv(4096).decode())
        except BlockingIOError:
            return found


def listen_for(systemd: socket.socket, word: str, limit_s: float = 90.0) -> list[str]:
    found: list[str] = []
    deadline = time.monotonic() + limit_s
    while not any(word in one for one in found):
        assert time.monotonic() < deadline, found
        found += heard(systemd)
        time.sleep(0.05)
    return found


def test_no_stroke_while_the_disk_holds_the_recorder_and_strokes_again_after(
    systemd: socket.socket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = threading.Event()
    free.set()
    sync = os.fdatasync

    def stalling(descriptor: int) -> None:
        free.wait(300)
        sync(descriptor)

    monkeypatch.setattr(os, "fdatasync", stalling)
    path = tmp_path / "swathd.yaml"
    path.write_text(
        f"lidar: {{address: 127.0.0.1, data_port: 42368, position_port: 48308}}\nins: {{device: null}}\n"
        f"recorder: {{directory: {tmp_path}/logs, min_free_mb: 1}}\n"
    )
    stop = StopFlag()
    daemon = Daemon(config.load(path), path, stop)
    thread = threading.Thread(target=daemon.run)
    thread.start()
    try:
        listen_for(systemd, "WATCHDOG=1")
        free.clear()
        listen_for(systemd, "recorder has made no progress")
        time.sleep(2.5)
        assert [word for word in heard(systemd) if word == "WATCHDOG=1"] == []
        free.set()
        listen_for(systemd, "WATCHDOG=1")
    finally:
        free.set()
        stop.set()
        thread.join(120)
    assert "STOPPING=1" in heard(systemd)
