"""Data packets as an HDL-32E at 600 rpm sends them, made with struct; and network namespaces to send them in."""

import ctypes
import os
import shutil
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import pytest

T = TypeVar("T")


def packet(number: int, mark: int = 1, mode: int = 0x37, product: int = 0x21, rpm: float = 600.0) -> bytes:
    """The packet of that number; `mark` is in every intensity."""
    step = rpm * 360 / 60 * 46.08e-6 * 100
    blocks = b""
    for block in range(12):
        azimuth = round((number * 12 + block) * step) % 36000
        blocks += struct.pack("<HH", 0xEEFF, azimuth) + struct.pack("<HB", 1000 + number % 1000, mark) * 32
    return blocks + struct.pack("<IBB", round(number * 552.96) % 3_600_000_000, mode, product)


def from_address(address: str, port: int = 0) -> socket.socket:
    """A socket that sends from an address of this machine."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    sock.bind((address, port))
    return sock


def needs_namespaces() -> None:
    if os.geteuid() != 0:
        pytest.skip("network namespaces need root")
    if shutil.which("ip") is None:
        pytest.skip("`ip` is not installed")


@contextmanager
def cable(aboard: list[str], sensor: list[str]) -> Iterator[tuple[str, str]]:
    """Two network namespaces, `aboard` and `sensor`, joined by a cable, with their addresses; their names."""
    names = f"swath-a{os.getpid()}", f"swath-s{os.getpid()}"
    try:
        for name in names:
            run("ip", "netns", "add", name)
            run("ip", "-n", name, "link", "set", "lo", "up")
        run("ip", "-n", names[0], "link", "add", "lidar0", "type", "veth", "peer", "name", "head0", "netns", names[1])
        for name, device, addresses in zip(names, ("lidar0", "head0"), (aboard, sensor), strict=True):
            run("ip", "-n", name, "link", "set", device, "up")
            for address in addresses:
                run("ip", "-n", name, "addr", "add", address, "dev", device)
        inside(names[0], lambda: _loose(("all", "default", "lidar0")))
        yield names
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], check=False, capture_output=True)


def _loose(interfaces: tuple[str, ...]) -> None:
    for interface in interfaces:
        Path(f"/proc/sys/net/ipv4/conf/{interface}/rp_filter").write_text("0")


def run(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True)


def inside(namespace: str, make: Callable[[], T]) -> T:
    """Call something in a network namespace; a socket made there stays there."""
    made: list[T] = []
    libc = ctypes.CDLL(None, use_errno=True)

    def enter() -> None:
        with Path(f"/run/netns/{namespace}").open() as file:
            assert libc.setns(file.fileno(), 0x40000000) == 0
        made.append(make())

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    return made[0]


class Stream:
    """Sends data packets (and position packets) at the sensor's rate from a thread, until `stop`."""

    def __init__(
        self,
        sock: socket.socket,
        data: tuple[str, int],
        position: tuple[str, int] | None = None,
        lose: int = 0,
        **how: Any,
    ) -> None:
        self.sock, self.data, self.position, self.lose, self.how = sock, data, position, lose, how
        self.sent = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        turn = [packet(number, **self.how) for number in range(1808)]
        imu = struct.pack("<14x12H", *[tag << 12 for tag in range(4)] * 3).ljust(512, b"\0")
        begin, done = time.monotonic(), 0
        while not self._stop.wait(0.005):
            due = int((time.monotonic() - begin) / 552.96e-6)
            for number in range(done, due):
                if not self.lose or number % self.lose:
                    with suppress(OSError):  # the cable is out
                        self.sock.sendto(turn[number % 1808], self.data)
                        self.sent += 1
                if self.position and number % 9 == 0:
                    with suppress(OSError):
                        self.sock.sendto(imu, self.position)
            done = due

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
