"""`swath simulate` as a user meets it, live playing included."""

import argparse
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from flightlog.errors import ConfigError, UsageError
from simulator import command, play


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(word) for word in words]))


def test_the_command_imports_no_science():
    check = (
        "import sys, simulator.command; sys.exit(bool({'numba', 'scipy', 'embreex', 'pymavlink'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", check], check=False).returncode == 0


def test_it_writes_all_files_and_says_where(tmp_path, capsys):
    assert run("--scene", "field", "--duration", "1", "-o", tmp_path / "out") == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "board.bin", "capture.pcap", "flight.mcap", "telemetry.tlog", "truth.csv", "truth.json"
    ]  # fmt: skip
    assert "1 s of field, seed 1" in capsys.readouterr().out


def test_the_sample_configuration_holds_every_default(tmp_path, capsys):
    assert run("--sample-config") == 0
    text = capsys.readouterr().out
    assert yaml.safe_load(text)["lidar"]["rpm"] == 600.0
    path = tmp_path / "options.yaml"
    path.write_text(text)
    assert run("--scene", "field", "--duration", "1", "--config", path, "-o", tmp_path / "out") == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--duration", "0"), "--duration: 0.0 found, expected at least 1"),
        (("--duration", "nan"), "--duration: nan found"),
        (("--seed", "-1"), "--seed: -1 found, expected at least 0"),
        (("--workers", "0"), "--workers: 0 found"),
        (("--scene", "moon"), "'moon' is not known"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(words, sentence, tmp_path):
    with pytest.raises(UsageError, match=sentence):
        run("-o", tmp_path, *words)
    assert not list(tmp_path.iterdir())


def test_no_folder_is_refused():
    with pytest.raises(UsageError, match="no folder to write to"):
        run("--scene", "field")


def test_an_unknown_option_in_the_file_is_named(tmp_path):
    path = tmp_path / "options.yaml"
    path.write_text("lidar:\n  rpn: 600\n")
    with pytest.raises(ConfigError, match="rpn"):
        run("--config", path, "-o", tmp_path / "out")


def test_a_start_that_is_no_time_is_named(tmp_path):
    path = tmp_path / "options.yaml"
    path.write_text("clocks:\n  start_utc: noon\n")
    with pytest.raises(ConfigError, match="noon"):
        run("--config", path, "-o", tmp_path / "out")


class Listener(threading.Thread):
    """Receives datagrams of a port until told to end."""

    def __init__(self):
        super().__init__(daemon=True)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.3)
        self.port = self.socket.getsockname()[1]
        self.ended = threading.Event()
        self.received = []

    def run(self):
        while True:
            try:
                self.received.append(self.socket.recv(2048))
            except TimeoutError:
                if self.ended.is_set():
                    self.socket.close()
                    return


class Terminal(threading.Thread):
    """Reads a terminal once its link is there."""

    def __init__(self, link):
        super().__init__(daemon=True)
        self.link, self.content = link, b""

    def run(self):
        while not self.link.is_symlink():
            time.sleep(0.01)
        device = os.open(self.link, os.O_RDONLY | os.O_NOCTTY)
        try:
            while data := os.read(device, 4096):
                self.content += data
        except OSError:  # the other end has closed
            pass
        os.close(device)


def test_live_sends_every_byte(tmp_path, capsys):
    lidar, position, terminal = Listener(), Listener(), Terminal(tmp_path / "ins")
    for thread in (lidar, position, terminal):
        thread.start()
    words = ("--scene", "field", "--duration", 3, "-o", tmp_path / "out", "--live", "--wait", 0.5)
    ports = ("--lidar-port", lidar.port, "--position-port", position.port, "--pty-link", tmp_path / "ins")
    assert run(*words, *ports) == 0
    lidar.ended.set()
    position.ended.set()
    for thread in (lidar, position, terminal):
        thread.join(120.0)
    capture = (tmp_path / "out" / "capture.pcap").read_bytes()
    assert capture.count(b"\x04\xd2\x00\x00\x40\x00\xff\x11") == len(lidar.received) > 5_000
    assert all(len(data) == 1206 for data in lidar.received)
    assert all(len(data) == 512 for data in position.received)
    said = capsys.readouterr().out
    assert "at most " in said  # so much was late
    tlog = (tmp_path / "out" / "telemetry.tlog").read_bytes()
    frames = b""
    at = 0
    while at < len(tlog):
        size = 8 + tlog[at + 9]
        frames += tlog[at + 8 : at + 8 + size]
        at += 8 + size
    assert terminal.content == frames
    assert f"MAVLink on {tmp_path / 'ins'}" in said
    assert not (tmp_path / "ins").is_symlink()


@pytest.mark.parametrize("oversleep_s", [0.0, 0.03])
def test_everything_is_played_at_its_time_and_never_before(monkeypatch, oversleep_s):
    """On a clock of the test's own, which only sleeping moves."""
    now_s, came_s = 1000.0, []

    def sleep(seconds):
        nonlocal now_s
        now_s += seconds + oversleep_s

    monkeypatch.setattr(play, "time", SimpleNamespace(monotonic=lambda: now_s, sleep=sleep))
    due_ns = 5_000_000_000 + 553_000 * np.arange(5000)
    played = play.Played()
    for event in play._paced((play._Event(int(time_ns), 0, b"") for time_ns in due_ns), played, None):
        assert event.time_ns == due_ns[len(came_s)]
        came_s.append(now_s - 1000.0)
    late_s = np.array(came_s) - (due_ns - due_ns[0]) * 1e-9
    assert late_s.min() > -1e-6
    # a slice of 2 ms is sent together, at its end
    assert late_s.max() <= 0.002 + oversleep_s + 1e-6
    assert played.worst_late_s == pytest.approx(late_s.max(), abs=1e-6)


def test_nobody_listening_is_no_error(tmp_path, capsys):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    words = ("--scene", "field", "--duration", 1, "-o", tmp_path / "out", "--live")
    assert run(*words, "--lidar-port", port, "--position-port", port) == 0
    assert "played" in capsys.readouterr().out


def test_the_documentation_shows_the_command_line():
    text = (Path(command.__file__).parents[1] / "docs" / "simulator.md").read_text()
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    for action in parser._actions:
        if action.option_strings and action.dest != "help":
            assert action.option_strings[-1] in text
