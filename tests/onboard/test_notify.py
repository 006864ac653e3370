import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from onboard import notify


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """The socket that systemd would listen on."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@swath-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(name.replace("@", "\0"))
        sock.settimeout(60)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        yield sock


def test_systemd_hears_us(systemd: socket.socket) -> None:
    notify.ready("recording")
    notify.watchdog()
    notify.status("fine")
    notify.stopping()
    assert [systemd.recv(200) for _ in range(4)] == [
        b"READY=1\nSTATUS=recording", b"WATCHDOG=1", b"STATUS=fine", b"STOPPING=1",
    ]  # fmt: skip


def test_the_fallback_says_the_same_as_the_library(systemd: socket.socket) -> None:
    notify.notify_socket("WATCHDOG=1")
    assert systemd.recv(200) == b"WATCHDOG=1"


def test_without_systemd_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify.ready("x")
    notify.notify_socket("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", "/nonexistent/socket")
    notify.notify_socket("READY=1")


@pytest.mark.parametrize(
    ("usec", "pid", "expected"), [("2000000", "", 2 * 10**9), ("", "", None), ("2000000", "1", None)]
)
def test_the_watchdog_is_ours_only_if_systemd_means_us(
    usec: str, pid: str, expected: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", usec)
    if pid:
        monkeypatch.setenv("WATCHDOG_PID", pid)
    else:
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
    assert notify.watchdog_ns() == expected
