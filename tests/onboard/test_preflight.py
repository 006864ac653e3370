"""The check before a flight, with real sockets, a real pty and a real disk."""

import importlib.util
import json
import socket
from pathlib import Path
from typing import Any

import pytest
from lidar_stream import Stream, from_address

from onboard import cli
from onboard.config import FovConfig, LidarConfig, RecorderConfig
from onboard.health import Level
from onboard.lidar_settings import LidarSettings
from onboard.lidarstate import State
from onboard.parameters import shipped
from onboard.preflight import check_buffer, check_disk, judge_lidar, missing_deg
from onboard.status import LidarStatus

_standin = importlib.util.spec_from_file_location("standin_autopilot", Path(__file__).with_name("standin_autopilot.py"))
assert _standin is not None
assert _standin.loader is not None
standin: Any = importlib.util.module_from_spec(_standin)
_standin.loader.exec_module(standin)


def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


class Aircraft:
    """A configuration file, and the check of it."""

    def __init__(self, folder: Path) -> None:
        self.data, self.position = port(), port()
        self.tree = {
            "lidar": {"address": "127.0.0.1", "data_port": self.data, "position_port": self.position,
                      "receive_buffer_kb": 64, "fov": {"start_deg": 0, "end_deg": 0}},
            "ins": {"device": None},
            "recorder": {"directory": str(folder / "logs"), "min_free_mb": 1},
        }  # fmt: skip
        self.config = folder / "swathd.yaml"

    def check(self, capsys: pytest.CaptureFixture[str], seconds: float = 4) -> tuple[int, dict[str, dict[str, str]]]:
        self.config.write_text(json.dumps(self.tree))
        code = cli.main(["check", "--config", str(self.config), "--json", "--seconds", str(seconds)])
        items = json.loads(capsys.readouterr().out)["items"]
        for item in items:  # whatever fails comes with its remedy, and nothing else does
            assert bool(item["remedy"]) == (item["level"] != "GOOD"), item
        return code, {item["name"]: item for item in items}


@pytest.fixture
def aircraft(tmp_path: Path) -> Aircraft:
    return Aircraft(tmp_path)


def test_all_well_is_exit_code_0(aircraft: Aircraft, capsys: pytest.CaptureFixture[str]) -> None:
    with from_address("127.0.0.2") as sock:
        stream = Stream(sock, ("127.0.0.1", aircraft.data), ("127.0.0.1", aircraft.position))
        code, items = aircraft.check(capsys)
        stream.stop()
    assert {name: item["level"] for name, item in items.items() if item["level"] != "GOOD"} == {}
    assert code == 0
    assert items["lidar"]["found"].endswith("packets/s from 127.0.0.2, strongest return")
    assert int(items["lidar speed"]["found"].split()[0]) == pytest.approx(600, rel=0.01)


def test_each_failure_is_named_with_its_remedy(aircraft: Aircraft, capsys: pytest.CaptureFixture[str]) -> None:
    aircraft.tree["ins"] = {"device": "/dev/not-there"}
    aircraft.tree["mount"] = "no-such-mount.yaml"
    code, items = aircraft.check(capsys, 3)
    assert code == 2
    assert items["lidar"]["level"] == items["link ins"]["level"] == items["mount"]["level"] == "CRITICAL"
    assert items["lidar"]["found"] in ("no packets", "no link")
    assert "/dev/not-there cannot be opened: No such file" in items["link ins"]["found"]


def test_a_sensor_that_turns_at_another_speed_and_a_taken_port_are_told(
    aircraft: Aircraft, capsys: pytest.CaptureFixture[str]
) -> None:
    with from_address("127.0.0.2") as sock:
        stream = Stream(sock, ("127.0.0.1", aircraft.data), ("127.0.0.1", aircraft.position), rpm=1200.0)
        code, items = aircraft.check(capsys)
        stream.stop()
    assert (code, items["lidar speed"]["level"]) == (1, "WARNING")
    found, _, wanted = items["lidar speed"]["found"].partition(" rpm of ")
    assert int(found) == pytest.approx(1200, rel=0.01)  # azimuths are whole hundredths, and one packet is looked at
    assert wanted == "600"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", aircraft.data))
        code, items = aircraft.check(capsys, 3)
    assert code == 2
    assert "another program has it" in items["lidar"]["found"]


def test_a_wrong_configuration_is_one_finding(aircraft: Aircraft, capsys: pytest.CaptureFixture[str]) -> None:
    aircraft.tree["lidr"] = {}
    code, items = aircraft.check(capsys)
    assert code == 2
    assert "unknown key 'lidr'" in items["config"]["found"]


def test_a_directory_that_cannot_be_written_and_a_full_disk_are_critical(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert [item.level for item in check_disk(RecorderConfig(str(tmp_path / "file" / "logs")))] == [Level.CRITICAL]
    full = check_disk(RecorderConfig(str(tmp_path), min_free_mb=1_000_000))[0]
    assert (full.name, full.level) == ("disk space", Level.CRITICAL)


def test_a_small_receive_buffer_comes_with_the_setting_that_helps(tmp_path: Path) -> None:
    (tmp_path / "rmem_max").write_text("212992\n")
    item = check_buffer(LidarConfig(), tmp_path / "rmem_max")
    assert (item.level, item.found) == (Level.WARNING, "208 kB of the 9216 kB asked for")
    assert item.remedy == "sysctl -w net.core.rmem_max=9437184"


@pytest.mark.parametrize(
    ("sent", "recorded", "missing"),
    [((0, 0), (255, 105), 0), ((255, 105), (255, 105), 0), ((255, 105), (0, 0), 150), ((270, 90), (255, 105), 30),
     ((10, 350), (255, 105), 20), ((0, 180), (255, 105), 105), ((100, 200), (255, 105), 205)],
)  # fmt: skip
def test_what_the_sensor_does_not_send_is_missing(
    sent: tuple[float, float], recorded: tuple[float, float], missing: float
) -> None:
    status = LidarStatus(fov_start_deg=sent[0], fov_end_deg=sent[1])
    assert missing_deg(status, LidarConfig(fov=FovConfig(*recorded))) == missing


@pytest.mark.parametrize("state", [state for state in State if state not in (State.GOOD, State.RATE_LOW)])
def test_a_lidar_in_trouble_has_its_states_name_and_a_remedy(state: State) -> None:
    (item,) = judge_lidar(LidarStatus(state=state), LidarConfig(), LidarSettings())
    assert item.level == Level.CRITICAL
    assert item.found == state
    assert len(item.remedy) > 15


def test_an_autopilot_is_asked_for_its_rates_and_its_parameters(
    aircraft: Aircraft, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = shipped("ins", "3.1.3")
    values = {name: [parameter.value, standin.REAL32] for name, parameter in wanted.items()}
    (changed, *_) = values
    values[changed] = [wanted[changed].value + 1, standin.REAL32]
    autopilot = standin.StandinAutopilot(values)
    aircraft.tree["ins"] = {"device": autopilot.device}
    try:
        code, items = aircraft.check(capsys)
    finally:
        autopilot.close()
    assert code == 2  # there is no lidar
    assert items["link ins"]["found"].startswith("autopilot 7/1, MAVLink 1")
    assert items["link ins rates"]["level"] == "WARNING"  # it has no streams but a slow one
    assert "SRx_" in items["link ins rates"]["remedy"]
    assert items["parameters ins"]["found"].startswith(f"1 of {len(wanted)} differ: {changed}: ")
    assert items["parameters ins"]["remedy"].startswith("swathd parameters apply --device ")
