"""The real `swathd` between network namespaces and on a pty: who disturbs it, and what it says of that."""

import json
import os
import pty
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lidar_stream import Stream, cable, from_address, inside, needs_namespaces, packet, run
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.records import SyncMethod, UtcSource

pytestmark = pytest.mark.root
LIDAR, STRANGER, HOST = "192.168.1.201", "192.168.1.66", "192.168.1.10"
SWATHD = [sys.executable, "-m", "onboard.cli"]


class Autopilot:
    """Speaks MAVLink 1 on a pty: heartbeat, attitude at 25 Hz, SYSTEM_TIME; answers TIMESYNC; flips bits if told to."""

    def __init__(self, device: Path) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave, termios.TCSANOW)
        device.symlink_to(os.ttyname(self.slave))
        os.set_blocking(self.master, False)
        self.boot_ns = time.monotonic_ns() - 1_000_000_000_000
        self.armed, self.flip, self.flipped = False, False, 0
        self.heard: list[Any] = []
        self.versions: set[int] = set()
        self._out = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        self._in = dialect.MAVLink(None)
        self._in.robust_parsing = True
        self._random = np.random.default_rng(1)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self.boot_ns

    def _send(self, message: Any) -> None:
        data = bytearray(message.pack(self._out, force_mavlink1=True))
        self._out.seq = (self._out.seq + 1) % 256
        if self.flip and self._random.random() < 0.1:
            self.flipped += 1
            data[self._random.integers(len(data))] ^= 1 << self._random.integers(8)
        os.write(self.master, data)

    def _run(self) -> None:
        tick = 0
        while not self._stop.wait(0.04):
            boot_ms = self._now_ns() // 1_000_000
            self._send(dialect.MAVLink_attitude_message(boot_ms, 0.1, 0.2, 0.3, 0, 0, 0))
            if tick % 10 == 0:
                mode = 0x51 | (0x80 if self.armed else 0)
                self._send(dialect.MAVLink_heartbeat_message(2, 3, mode, 0, 4, 3))
                self._send(dialect.MAVLink_system_time_message(time.time_ns() // 1000 + 3_600_000_000, boot_ms))
            tick += 1
            try:
                data = os.read(self.master, 4096)
            except BlockingIOError:
                continue
            for message in self._in.parse_buffer(data) or []:
                self.versions.add(message.get_msgbuf()[0])
                if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                    self._send(dialect.MAVLink_timesync_message(self._now_ns(), message.ts1))
                self.heard.append(message)

    def texts(self) -> list[str]:
        return [message.text for message in list(self.heard) if message.get_type() == "STATUSTEXT"]

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self.slave)
        os.close(self.master)


class Aircraft:
    """swathd in a namespace, with a lidar's cable and an autopilot."""

    def __init__(self, folder: Path, names: tuple[str, str], **recorder: Any) -> None:
        self.aboard, self.at_lidar = names
        self.logs, self.config = folder / "logs", folder / "swathd.yaml"
        self.autopilot = Autopilot(folder / "ins")
        self.senders: list[socket.socket] = []
        self.streams: list[Stream] = []
        tree = {
            "lidar": {"fov": {"start_deg": 0, "end_deg": 0}},
            "ins": {"device": str(folder / "ins")},
            "recorder": {"directory": str(self.logs), "min_free_mb": 1, **recorder},
        }
        self.config.write_text(json.dumps(tree))
        command = ["ip", "netns", "exec", self.aboard, *SWATHD, "run", "--config", str(self.config)]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)

    def sender(self, address: str, port: int = 0) -> socket.socket:
        self.senders.append(inside(self.at_lidar, lambda: from_address(address, port)))
        return self.senders[-1]

    def stream(self) -> Stream:
        self.streams.append(Stream(self.sender(LIDAR, 2368), (HOST, 2368), (HOST, 8308)))
        return self.streams[-1]

    def status(self) -> dict[str, Any]:
        try:
            return dict(json.loads((self.logs / "status.json").read_text()))
        except (OSError, ValueError):
            return {"lidar": {"state": "", "packets_s": 0.0}, "links": {"ins": {}}, "clocks": {}}

    def health(self) -> tuple[int, str]:
        done = subprocess.run(
            [*SWATHD, "health", "--config", str(self.config)], capture_output=True, text=True, check=False, timeout=120
        )
        return done.returncode, done.stdout

    def stop(self) -> LogReader:
        self.process.send_signal(signal.SIGTERM)
        told = self.process.communicate(timeout=120)[1]
        assert self.process.returncode == 0, told
        self.autopilot.close()
        (log,) = sorted(self.logs.glob("*.mcap"))
        return LogReader(log)

    def kill(self) -> None:
        for stream in self.streams:
            stream.stop()
        for sock in self.senders:
            sock.close()
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
            self.autopilot.close()


@pytest.fixture
def aircraft(tmp_path: Path) -> Iterator[Callable[..., Aircraft]]:
    needs_namespaces()
    made: list[Aircraft] = []

    def make(**recorder: Any) -> Aircraft:
        made.append(Aircraft(tmp_path, names, **recorder))
        return made[0]

    with cable([f"{HOST}/24"], [f"{LIDAR}/24", f"{STRANGER}/24"]) as names:
        yield make
        for one in made:
            one.kill()


def until(condition: Callable[[], bool], what: str, seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"not within {seconds} s: {what}"
        time.sleep(0.05)


def looked_at(aircraft: Aircraft) -> int:
    """The lidar's packets that were recorded or counted as lost."""
    lidar = aircraft.status()["lidar"]
    return int(lidar["kept"]) + int(lidar["kernel_drops"])


def state_is(aircraft: Aircraft, state: str) -> Callable[[], bool]:
    return lambda: aircraft.status()["lidar"]["state"] == state


def test_a_pulled_cable_a_silent_lidar_and_strangers_are_told_apart_and_recorded_around(
    aircraft: Callable[..., Aircraft],
) -> None:
    swathd = aircraft()
    until(state_is(swathd, "no packets"), "nothing came yet, over a cable that is in")
    stranger = swathd.sender(STRANGER)
    stream = swathd.stream()
    until(state_is(swathd, "good"), "packets")

    run("ip", "-n", swathd.at_lidar, "link", "set", "head0", "down")
    until(state_is(swathd, "no link"), "the cable is out")
    code, said = swathd.health()
    assert code == 2
    assert "is the cable plugged in" in said
    until(lambda: "swath: lidar no link" in swathd.autopilot.texts(), "the pilot is told")
    run("ip", "-n", swathd.at_lidar, "link", "set", "head0", "up")
    until(state_is(swathd, "good"), "the cable is in again")

    stream.stop()
    until(state_is(swathd, "silent"), "the lidar sends no more")
    time.sleep(4.0)  # after 3 s of silence the kernel lets all in again
    for _ in range(30):
        stranger.sendto(packet(1, mark=66), (HOST, 2368))
        stranger.sendto(packet(1, mark=66)[:700], (HOST, 2368))
        time.sleep(0.02)
    until(
        lambda: swathd.status()["lidar"]["rejected"].get("data packet from another sender than the lidar", 0) == 30,
        "30",
    )
    assert swathd.status()["lidar"]["rejected"]["data packet of a wrong length"] == 30
    until(lambda: "swath: lidar silent" in swathd.autopilot.texts(), "the pilot is told")
    with swathd.stop() as reader:
        scans = [records.decode_scan(message.data) for message in reader.messages((records.LIDAR.topic,))]
    marks = np.concatenate(scans)["data"]["blocks"]["returns"]["intensity"]
    assert set(np.unique(marks).tolist()) == {1}
    assert sum(map(len, scans)) <= stream.sent


def test_flood_malformed_packets_and_flipped_bits_cost_nothing_that_is_good(aircraft: Callable[..., Aircraft]) -> None:
    swathd = aircraft()
    swathd.autopilot.flip = True
    stranger = swathd.sender(STRANGER)
    until(lambda: swathd.status()["lidar"]["state"] != "", "it runs")
    stream = swathd.stream()
    until(state_is(swathd, "good"), "packets")
    random, end = np.random.default_rng(2), time.monotonic() + 4
    hostile = [packet(1, mark=66), packet(1, mark=66)[:1205], b"", random.bytes(1206), random.bytes(512), bytes(1400)]
    flood = 0
    while time.monotonic() < end:
        for payload in hostile * 8:
            stranger.sendto(payload, (HOST, 2368))
            stranger.sendto(payload, (HOST, 8308))
        flood += 8 * len(hostile)
        # and from the lidar's own address, what is no data packet of its
        stream.sock.sendto(packet(3, mark=66, product=0x22), (HOST, 2368))
        stream.sock.sendto(packet(3, mark=66)[:-1], (HOST, 2368))
        time.sleep(0.002)
    until(lambda: bool(swathd.status()["clocks"].get("ins")), "the clocks are tied")
    status = swathd.status()
    stream.stop()
    until(lambda: looked_at(swathd) >= stream.sent, "all of it was looked at")
    link = status["links"]["ins"]
    flipped = swathd.autopilot.flipped
    with swathd.stop() as reader:
        scans = np.concatenate([records.decode_scan(m.data) for m in reader.messages((records.LIDAR.topic,))])
        accounts = [records.decode_account(m.data) for m in reader.messages((records.LIDAR_ACCOUNT.topic,))]
    assert set(np.unique(scans["data"]["blocks"]["returns"]["intensity"]).tolist()) == {1}
    assert len(scans) == stream.sent - sum(account.kernel_drops for account in accounts)
    assert sum(account.rejected_sender for account in accounts) > 0.9 * flood
    assert status["lidar"]["rejected"]["data packet of another sensor: VLP-16"] > 0
    assert flipped > 5
    assert link["bad_bytes"] > 0
    assert link["autopilot"] == "1/1"


def test_what_is_said_on_the_link_and_the_clocks_in_the_log(aircraft: Callable[..., Aircraft]) -> None:
    swathd = aircraft(lidar="armed")
    until(lambda: swathd.status()["links"]["ins"].get("armed") is False, "the autopilot is heard, and not armed")
    stream = swathd.stream()
    until(state_is(swathd, "good"), "packets")
    until(lambda: "swath: lidar ready, not armed" in swathd.autopilot.texts(), "told")
    assert swathd.status()["lidar"]["kept"] == 0
    swathd.autopilot.armed = True
    until(lambda: swathd.status()["lidar"]["kept"] > 1000, "recorded")
    until(lambda: "swath: lidar recording" in swathd.autopilot.texts(), "told")
    until(lambda: swathd.status()["clocks"].get("ins", {}).get("samples", 0) >= 5, "round trips")
    stream.stop()
    boot_minus_monotonic = -swathd.autopilot.boot_ns
    with swathd.stop() as reader:
        syncs = [records.decode_clock_sync(m.data) for m in reader.messages((records.CLOCK_SYNC.topic,))]
        clock = [records.decode_host_clock(m.data) for m in reader.messages((records.HOST_CLOCK.topic,))][-1]
    ins = [sync for sync in syncs if sync.clock == "ins"][-1]
    truth = boot_minus_monotonic + clock.monotonic_ns - clock.log_ns
    assert (ins.method, ins.utc_source) == (SyncMethod.TIMESYNC, UtcSource.SYSTEM_TIME)
    assert abs(ins.offset_ns - truth) <= ins.uncertainty_ns + 1_000_000
    # the autopilot believes that it is an hour later; its pty is read every 5 ms, and boot time is in whole ms
    assert abs(ins.utc_offset_ns - 3600 * 10**9 - (clock.realtime_ns - clock.log_ns)) < 100_000_000
    assert {sync.clock for sync in syncs} == {"ins", "lidar"}
    kinds = {message.get_type() for message in swathd.autopilot.heard}
    assert {"HEARTBEAT", "REQUEST_DATA_STREAM", "TIMESYNC", "STATUSTEXT", "NAMED_VALUE_FLOAT"} <= kinds
    assert "BAD_DATA" not in kinds
    assert swathd.autopilot.versions == {0xFE}  # as the autopilot speaks
