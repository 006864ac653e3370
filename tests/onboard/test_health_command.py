"""`swathd health` as a process, on status files written here."""

import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from onboard.lidarstate import State
from onboard.status import LidarStatus, RecorderStatus, Status, to_json

COMMAND = [sys.executable, "-m", "onboard.cli", "health", "--config"]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "swathd.yaml"
    path.write_text(f"status_file: {tmp_path}/status.json\n")
    return path


def write(config: Path, status: Status) -> None:
    config.with_name("status.json").write_text(to_json(status))


def now(**more: object) -> Status:
    boot_id = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    good = Status(
        time_ns=time.monotonic_ns() + 600_000_000_000,  # not to be stale however slow the machine is
        boot_id=boot_id,
        version="1",
        pid=1,
        uptime_s=10.0,
        clock_steps=0,
        lidar=LidarStatus(age_s=0.1, packets_s=1808.0, expected_packets_s=1808.5),
        links={},
        recorder=RecorderStatus(segment="00001-000.mcap", minutes_left=42.0),
    )
    return replace(good, **more)  # type: ignore[arg-type]


def call(config: Path, *words: str) -> tuple[int, str]:
    done = subprocess.run([*COMMAND, config, *words], capture_output=True, text=True, check=False, timeout=300)
    return done.returncode, done.stdout


@pytest.mark.parametrize(
    ("lidar", "code", "word"),
    [
        (LidarStatus(age_s=0.1), 0, "GOOD"),
        (LidarStatus(age_s=0.1, kernel_drops=3), 1, "WARNING"),
        (LidarStatus(state=State.NO_LINK), 2, "CRITICAL"),
    ],
)
def test_the_exit_code_is_that_of_a_monitoring_plug_in(config: Path, lidar: LidarStatus, code: int, word: str) -> None:
    write(config, now(lidar=lidar))
    found, said = call(config)
    assert (found, said.split(":")[0]) == (code, word)
    assert len(said.splitlines()) < 24  # one screen
    found, said = call(config, "--json")
    assert (found, json.loads(said)["verdict"]) == (code, word)


def test_an_old_status_is_stale_and_none_is_critical_in_json_too(config: Path) -> None:
    code, said = call(config, "--json")
    assert code == 2
    assert json.loads(said)["findings"][0].endswith("swathd has not run")
    write(config, now(time_ns=time.monotonic_ns() - 60_000_000_000))
    code, said = call(config)
    assert code == 2
    found = re.search(r"stale: the status is (\d+) s old", said)
    assert found is not None
    assert int(found[1]) >= 60


def test_watching_shows_what_changes_until_it_is_interrupted(config: Path) -> None:
    write(config, now())
    with subprocess.Popen([*COMMAND, config, "--watch"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        write(config, now(lidar=LidarStatus(state=State.SILENT, age_s=7.0)))
        line = ""
        while "CRITICAL" not in line:
            line = process.stdout.readline()
            assert line
        process.send_signal(signal.SIGINT)
        process.stdout.read()
    assert "GOOD" in first
    assert process.returncode == 2


def test_a_daemon_that_has_ended_is_noticed_at_once(config: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    write(config, now(pid=ended.pid))
    code, text = call(config)
    assert code == 2
    assert f"swathd (process {ended.pid}) has ended" in text


def test_words_from_outside_do_not_act_on_the_terminal(config: Path) -> None:
    write(config, now(lidar=LidarStatus(age_s=0.1, nmea="$GPRMC\x1b[2J\x07\nGOOD: forged")))
    _, text = call(config)
    assert "\x1b" not in text
    assert "\x07" not in text
    assert not any(line.startswith("GOOD: forged") for line in text.splitlines())
    assert r"$GPRMC\x1b[2J\x07\nGOOD: forged" in text
