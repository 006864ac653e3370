"""A log made long by repetition has no seam that the summary would see."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from groundproc.cli import main

TOOL = Path(__file__).resolve().parents[2] / "benchmarks" / "long_log.py"
TIMES = 4


def repeated(source: Path, target: Path) -> None:
    subprocess.run([sys.executable, TOOL, source, target, "--times", str(TIMES)], check=True, capture_output=True)


def summary(log: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["info", "--json", str(log)]) == code
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    return content


def check_link(one: dict[str, Any], many: dict[str, Any]) -> None:
    """Checksums are right, sequence numbers and boot time run on."""
    assert many["frames"] == TIMES * one["frames"]
    assert many["bad_bytes"] == many["lost_frames"] == 0
    assert len(many["autopilots"][0]["boots"]) == 1


def test_nothing_is_missing_at_the_seams(
    simulated: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from simulator.config import Options

    options = replace(Options(), link=replace(Options().link, version=2))
    flight = simulated("short_flight", "field", 2.0, options)
    repeated(flight.log, tmp_path / "long.mcap")
    # 2 s are too short to make anything of
    one, many = summary(flight.log, capsys, code=1), summary(tmp_path / "long.mcap", capsys)
    assert many["lidar"]["packets"] == TIMES * one["lidar"]["packets"]
    assert many["lidar"]["missing_packets"] == many["lidar"]["out_of_order"] == 0
    assert many["lidar"]["clock"]["jumps"] == 0
    check_link(one["mavlink"]["ins"], many["mavlink"]["ins"])


def test_the_gps_sentences_of_the_lidar_keep_to_its_stamps(
    gps_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    repeated(gps_flight.log, tmp_path / "long.mcap")
    # its lidar is thinned: doubtful, once and repeated
    one, many = (summary(log, capsys, code=3) for log in (gps_flight.log, tmp_path / "long.mcap"))
    check_link(one["mavlink"]["ins"], many["mavlink"]["ins"])
    one, many = one["position"], many["position"]
    assert many["gps"]["unreadable"] == 0
    assert many["gps"]["valid"] >= TIMES * (
        one["gps"]["valid"] - 1
    )  # the first may be the last of the repetition before
    assert many["gps"]["lag_s"] == pytest.approx(one["gps"]["lag_s"], abs=0.01)
    assert many["clock_state"] == one["clock_state"]
