"""`swath pull` against a real OpenSSH server with the restricted key, over the loopback."""

import getpass
import hashlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundproc.cli import main
from groundproc.field import pull
from onboard.daemon import boot_id
from onboard.status import LidarStatus, LinkStatus, RecorderStatus, Status, to_json

SSHD = shutil.which("sshd") or "/usr/sbin/sshd"
MEGABYTE = 1 << 20

pytestmark = pytest.mark.skipif(
    not Path(SSHD).exists() or not Path("/usr/bin/rrsync").exists() or shutil.which("ssh-keygen") is None,
    reason="openssh-server and rsync are not installed",
)


class Aircraft:
    """A log folder with a manifest behind sshd, whose only key leads to `swathd gate`."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.logs = folder, folder / "logs"
        self.logs.mkdir(parents=True)
        self.status = folder / "status.json"
        self.config = folder / "swathd.yaml"
        self.config.write_text(
            f"ins: {{device: null}}\nrecorder: {{directory: {self.logs}}}\nstatus_file: {self.status}\n"
        )
        for name in ("host", "key"):
            subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / name], check=True)
        swathd = Path(sys.executable).with_name("swathd")
        key = (folder / "key.pub").read_text()
        authorized = folder / "authorized_keys"
        authorized.write_text(f'restrict,command="{swathd} gate --config {self.config}" {key}')
        authorized.chmod(0o600)
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            self.port = int(sock.getsockname()[1])
        (folder / "sshd_config").write_text(
            f"Port {self.port}\nListenAddress 127.0.0.1\nHostKey {folder}/host\nPidFile none\nStrictModes no\n"
            f"AuthorizedKeysFile {authorized}\nPasswordAuthentication no\nKbdInteractiveAuthentication no\nUsePAM no\n"
            "PermitRootLogin prohibit-password\nMaxStartups 50\n"
        )
        (folder / "ssh_config").write_text(
            f"Host *\n  StrictHostKeyChecking accept-new\n  UserKnownHostsFile {folder}/known_hosts\n  LogLevel ERROR\n"
        )
        self.host = f"{getpass.getuser()}@127.0.0.1"

    def start(self) -> None:
        if os.geteuid() == 0:
            Path("/run/sshd").mkdir(exist_ok=True)
        with (self.folder / "sshd.log").open("ab") as log:
            self.process = subprocess.Popen([SSHD, "-D", "-e", "-f", self.folder / "sshd_config"], stderr=log)
        deadline = time.monotonic() + 60
        while True:
            with socket.socket() as sock:
                if not sock.connect_ex(("127.0.0.1", self.port)):
                    return
            assert self.process.poll() is None, (self.folder / "sshd.log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(60)

    def say_health(self, armed: bool | None, age_s: float = 0.0) -> None:
        """A status file as the daemon writes it."""
        link = LinkStatus(connected=True, age_s=0.3, armed=armed, autopilot="1/1")
        # long-lived unless it is to be old: a test may be slow
        time_ns = time.monotonic_ns() + int(-age_s * 1e9 if age_s else 600e9)
        status = Status(
            time_ns, boot_id(), "1", 1, 60.0, 0, LidarStatus(age_s=0.1), {"ins": link}, RecorderStatus("00003-000.mcap")
        )
        self.status.write_text(to_json(status))

    def record(self, name: str, size: int, seed: int = 1) -> bytes:
        """A closed segment with its line in the manifest."""
        data = np.random.default_rng(seed).bytes(size)
        path = self.logs / name
        path.write_bytes(data)
        path.chmod(0o440)
        with (self.logs / "manifest.jsonl").open("a") as file:
            line = {"file": name, "size": size, "sha256": hashlib.sha256(data).hexdigest(), "messages": {"/x": 1}}
            file.write(json.dumps(line) + "\n")
        return data

    @property
    def acknowledged(self) -> list[str]:
        path = self.logs / "acknowledged.jsonl"
        return [json.loads(line)["file"] for line in path.read_text().splitlines()] if path.exists() else []

    @property
    def vehicle(self) -> pull.Vehicle:
        return pull.Vehicle(self.host, self.port, self.folder / "key", self.folder / "ssh_config")

    def pull(self, directory: Path, *words: str) -> int:
        options = ["--port", str(self.port), "--identity", str(self.folder / "key")]
        options += ["--ssh-config", str(self.folder / "ssh_config"), "-o", str(directory)]
        return main(["pull", self.host, *options, *words])

    def ssh(self, *words: str, **options: Any) -> "subprocess.CompletedProcess[str]":
        line = [*self.vehicle.ssh(), *words]
        return subprocess.run(line, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=120, **options)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Aircraft]:
    aircraft = Aircraft(tmp_path_factory.mktemp("aircraft"))
    aircraft.start()
    yield aircraft
    aircraft.stop()


@pytest.fixture
def aircraft(server: Aircraft) -> Aircraft:
    """With nothing on it, disarmed."""
    shutil.rmtree(server.logs)
    server.logs.mkdir()
    server.say_health(False)
    return server


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_closed_segments_come_verified_and_are_acknowledged(aircraft: Aircraft, tmp_path: Path) -> None:
    first = aircraft.record("00001-000.mcap", 3 * MEGABYTE, 1)
    second = aircraft.record("00002-000.mcap", 12345, 2)
    (aircraft.logs / "00003-000.mcap").write_bytes(b"still open")
    assert aircraft.pull(tmp_path) == 0
    assert files(tmp_path) == {"00001-000.mcap": first, "00002-000.mcap": second}
    assert aircraft.acknowledged == ["00001-000.mcap", "00002-000.mcap"]


def test_a_dry_run_lists_and_brings_nothing(
    aircraft: Aircraft, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    aircraft.record("00001-000.mcap", 1_500_000, 1)
    aircraft.record("00001-001.mcap", 12345, 2)
    aircraft.say_health(True)  # to look is allowed in the air
    assert aircraft.pull(tmp_path / "new", "--dry-run") == 0
    said = capsys.readouterr().out.splitlines()
    assert said[1].split() == ["00001-000.mcap", "1.5", "to", "bring"]
    assert said[-1] == "2 to bring (1.5 MB), 0 here already"
    assert not (tmp_path / "new").exists()
    assert aircraft.acknowledged == []


def test_a_second_pull_brings_what_is_new_only(
    aircraft: Aircraft, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    aircraft.record("00001-000.mcap", 1000, 1)
    assert aircraft.pull(tmp_path) == 0
    aircraft.record("00001-001.mcap", 2000, 2)
    capsys.readouterr()
    assert aircraft.pull(tmp_path) == 0
    said = capsys.readouterr()
    assert said.out.splitlines() == [str(tmp_path / "00001-001.mcap")]
    assert "1 brought (0.0 MB), 1 here already, 1 newly acknowledged, 0 failed" in said.err
    assert aircraft.acknowledged == ["00001-000.mcap", "00001-001.mcap"]


@pytest.mark.parametrize(
    ("armed", "age_s", "words", "code"),
    [(True, 0, [], 1), (True, 0, ["--anyway"], 1), (None, 0, [], 1), (None, 0, ["--anyway"], 0), (False, 60, [], 1)],
)
def test_refused_while_armed_or_while_that_is_unknown(
    aircraft: Aircraft, tmp_path: Path, armed: bool | None, age_s: float, words: list[str], code: int
) -> None:
    aircraft.record("00001-000.mcap", 1000)
    aircraft.say_health(armed, age_s)
    assert aircraft.pull(tmp_path, *words) == code
    assert bool(files(tmp_path)) == (code == 0)
    assert bool(aircraft.acknowledged) == (code == 0)


def test_a_daemon_that_never_ran_leaves_armed_unknown(aircraft: Aircraft, tmp_path: Path) -> None:
    aircraft.status.unlink()
    with pytest.raises(pull.PullError, match="not known"):
        pull.check_disarmed(aircraft.vehicle, anyway=False)


def test_an_interrupted_pull_goes_on_where_it_was(
    aircraft: Aircraft, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = aircraft.record("00001-000.mcap", 8 * MEGABYTE)
    line = [
        Path(sys.executable).with_name("swath"),
        "pull",
        aircraft.host,
        "-o",
        tmp_path,
        "--port",
        str(aircraft.port),
    ]
    line += ["--identity", aircraft.folder / "key", "--ssh-config", aircraft.folder / "ssh_config"]
    # a link of 1 MB/s, which breaks when part of the file is here
    slow = tmp_path / "bin/rsync"
    slow.parent.mkdir()
    slow.write_text('#!/bin/sh\nexec /usr/bin/rsync --bwlimit=1000 "$@"\n')
    slow.chmod(0o755)
    path = f"{slow.parent}:{os.environ['PATH']}"
    part = tmp_path / pull.INCOMING / "00001-000.mcap"
    process = subprocess.Popen(
        line, env={**os.environ, "PATH": path}, start_new_session=True, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120
    while not part.exists() or part.stat().st_size < MEGABYTE:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.killpg(process.pid, 9)
    process.wait(60)
    have = part.stat().st_size
    assert MEGABYTE <= have < len(data)
    assert data.startswith(part.read_bytes())
    assert aircraft.acknowledged == []

    said: list[str] = []
    log = tmp_path / "rsync.log"
    slow.write_text(f'#!/bin/sh\nexec /usr/bin/rsync --stats --log-file={log} "$@"\n')
    monkeypatch.setenv("PATH", path)
    outcome = pull.pull(aircraft.vehicle, tmp_path, said.append)
    assert outcome.troubles == []
    assert [sentence.split(":")[1].split(" at")[0] for sentence in said] == [" goes on"]
    literal = next(one for one in log.read_text().splitlines() if "Literal data" in one)
    assert int(literal.split("Literal data:")[1].split()[0].replace(",", "")) == len(data) - have
    assert (tmp_path / "00001-000.mcap").read_bytes() == data
    assert aircraft.acknowledged == ["00001-000.mcap"]


@pytest.mark.parametrize("what", ["damaged part", "damaged whole", "too long"])
def test_what_is_wrong_here_is_mended(aircraft: Aircraft, tmp_path: Path, what: str) -> None:
    data = aircraft.record("00001-000.mcap", 2 * MEGABYTE)
    left = bytearray(data if what == "damaged whole" else data[:MEGABYTE] if what == "damaged part" else data + b"x")
    left[5000] ^= 1
    part = tmp_path / pull.INCOMING / "00001-000.mcap"
    part.parent.mkdir()
    part.write_bytes(left)
    stamp = (aircraft.logs / "00001-000.mcap").stat().st_mtime
    os.utime(part, (stamp, stamp))  # the same size and time: rsync alone would take it for good
    assert aircraft.pull(tmp_path) == 0
    assert files(tmp_path) == {"00001-000.mcap": data}


def test_a_segment_that_is_not_what_the_manifest_says_is_not_acknowledged(
    aircraft: Aircraft, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = bytearray(aircraft.record("00001-000.mcap", 10_000, 1))
    damaged[77] ^= 4
    (aircraft.logs / "00001-000.mcap").chmod(0o640)
    (aircraft.logs / "00001-000.mcap").write_bytes(damaged)
    (aircraft.logs / "00001-000.mcap").chmod(0o440)
    good = aircraft.record("00001-001.mcap", 10_000, 2)
    assert aircraft.pull(tmp_path) == 1
    assert "not what its manifest says" in capsys.readouterr().err
    assert {name for name in files(tmp_path) if "/" not in name} == {"00001-001.mcap"}
    assert files(tmp_path)["00001-001.mcap"] == good
    assert aircraft.acknowledged == ["00001-001.mcap"]


def test_another_aircrafts_log_of_the_same_name_is_not_overwritten(aircraft: Aircraft, tmp_path: Path) -> None:
    aircraft.record("00001-000.mcap", 1000)
    (tmp_path / "00001-000.mcap").write_bytes(b"of another aircraft")
    assert aircraft.pull(tmp_path) == 1
    assert files(tmp_path) == {"00001-000.mcap": b"of another aircraft"}
    assert aircraft.acknowledged == []


def test_a_link_that_is_not_there_is_one_sentence(
    aircraft: Aircraft, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["pull", "swath@127.0.0.1", "--port", "1", "-o", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    for host in ("-oProxyCommand=id", "", "swath@host; id"):
        with pytest.raises(pull.UsageError):
            pull.Vehicle(host)


def test_a_manifest_cannot_name_a_place_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    good = {"file": "00001-000.mcap", "size": 1, "sha256": "0" * 64}
    for bad in (
        {"file": "../x.mcap"},
        {"file": "/etc/x.mcap"},
        {"file": ".x.mcap"},
        {"sha256": "0"},
        {"size": -1},
        {"file": 3},
    ):
        monkeypatch.setattr(pull.Vehicle, "ask", lambda *_, bad=bad: json.dumps({**good, **bad}))
        with pytest.raises(pull.PullError, match="line 1 of its manifest"):
            pull.segments(pull.Vehicle("a@b"))


def test_the_key_is_good_for_nothing_else(aircraft: Aircraft, tmp_path: Path) -> None:
    aircraft.record("00001-000.mcap", 1000)
    (tmp_path / "evil.mcap").write_bytes(b"evil")
    host, before = aircraft.host, files(aircraft.logs)
    rsh = ["-e", " ".join(map(str, aircraft.vehicle.ssh()))]
    for command in ("id", "sh -c id", "", "cat /etc/passwd", "ack " + "0" * 64, "health; id"):
        done = aircraft.ssh(host, *([command] if command else []))
        assert (done.returncode, done.stdout) == (126, ""), command
        assert "swathd:" in done.stderr
    for words in (
        [str(tmp_path / "evil.mcap"), f"{host}:evil.mcap"],
        [f"{host}:../swathd.yaml", str(tmp_path / "stolen")],
        [f"{host}:/etc/passwd", str(tmp_path / "stolen")],
        ["--remove-source-files", f"{host}:00001-000.mcap", str(tmp_path / "moved")],
        ["--delete", "-r", f"{tmp_path}/", f"{host}:"],
    ):
        assert subprocess.run(["rsync", *rsh, *words], capture_output=True, timeout=120).returncode, words
    assert not (tmp_path / "stolen").exists()
    # no port is forwarded for it, no terminal given, no subsystem opened
    tunnel = aircraft.ssh("-o", "ExitOnForwardFailure=yes", "-R", "0:127.0.0.1:9", host, "health", "--json")
    assert tunnel.returncode == 255
    assert "PTY" in aircraft.ssh("-tt", host, "health").stderr
    assert aircraft.ssh("-s", host, "sftp").returncode == 255
    assert files(aircraft.logs) == before


def test_the_health_comes_over_ssh_with_its_exit_code(aircraft: Aircraft) -> None:
    done = aircraft.ssh(aircraft.host, "health")
    assert done.returncode == 0, done.stdout
    assert done.stdout.startswith("GOOD: 00003-000.mcap")
    aircraft.say_health(None, age_s=60)
    done = aircraft.ssh(aircraft.host, "health")
    assert done.returncode == 2
    assert "stale" in done.stdout
