"""The lidar's web server: a stand-in of it, and what is there instead in the field."""

import importlib.resources
import importlib.util
import io
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from flightlog import config
from flightlog.errors import ConfigError, SourceError
from onboard import lidar_settings
from onboard.cli import main
from onboard.lidar_settings import FovSetting, LidarSettings, LidarWeb, compare
from onboard.status import LidarStatus, LinkStatus, RecorderStatus, Status, to_json


def _standin() -> ModuleType:
    spec = importlib.util.spec_from_file_location("standin_lidar", Path(__file__).with_name("standin_lidar.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


STANDIN = _standin()


@pytest.fixture
def lidar() -> Iterator[Callable[..., Any]]:
    made = []

    def make(**how: object) -> Any:
        made.append(STANDIN.StandinLidar(**how))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_the_shipped_settings_are_those_of_the_source_and_equal_the_defaults() -> None:
    text = importlib.resources.files("firmware_config").joinpath("hdl32e.yaml").read_text(encoding="utf-8")
    settings = config.loads(text, LidarSettings, "hdl32e.yaml")
    assert settings == LidarSettings()
    assert (settings.rpm, settings.fov) == (600, FovSetting(255, 105))


def test_settings_that_no_sensor_takes_are_refused() -> None:
    with pytest.raises(ConfigError, match="rpm 630 found, expected a multiple of 60"):
        config.loads("rpm: 630", LidarSettings, "x.yaml")
    with pytest.raises(ConfigError, match="360 found, expected 0 to 359"):
        config.loads("fov: {start: 360}", LidarSettings, "x.yaml")
    with pytest.raises(ConfigError, match="expected one of Strongest, Last, Dual"):
        config.loads("returns: Both", LidarSettings, "x.yaml")


def test_a_sensor_from_the_factory_differs_in_its_field_of_view_only(lidar: Callable[..., Any]) -> None:
    found = LidarWeb(lidar().address).read("settings")
    assert [str(d) for d in compare(LidarSettings(), found)] == [
        "fov.start: 0 found, 255 wanted",
        "fov.end: 359 found, 105 wanted",
    ]


def test_values_compare_however_the_firmware_writes_them() -> None:
    tree = {
        "rpm": "600", "returns": "STRONGEST", "laser": True, "fov": {"start": 255.0, "end": "105"},
        "host": {"addr": "255.255.255.255", "dport": "2368", "tport": 8308},
    }  # fmt: skip
    assert compare(LidarSettings(), tree) == []
    del tree["host"]
    assert [d.found for d in compare(LidarSettings(), tree)] == [None] * 3


def test_apply_sets_what_differs_saves_and_verifies(
    lidar: Callable[..., Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")  # of no concern on the lidar's cable
    sensor = lidar()
    sensor.settings |= {"rpm": 1200, "returns": "Dual", "laser": "Off"}
    sensor.settings["host"]["dport"] = 2370
    assert main(["lidar", "show", "--address", sensor.address]) == 1
    assert sensor.posts == []
    assert main(["lidar", "apply", "--yes", "--address", sensor.address]) == 0
    assert sorted(sensor.posts[:-1]) == [
        ("/cgi/setting", "laser=on"),
        ("/cgi/setting", "returns=Strongest"),
        ("/cgi/setting", "rpm=600"),
        ("/cgi/setting/fov", "end=105"),
        ("/cgi/setting/fov", "start=255"),
        ("/cgi/setting/host", "dport=2368"),
    ]
    assert sensor.posts[-1] == ("/cgi/save", "submit")
    sensor.power_cycle()
    capsys.readouterr()
    assert main(["lidar", "show", "--address", sensor.address]) == 0
    out = capsys.readouterr().out
    assert "model HDL-32E, serial 11001120123456, motor On at 600 rpm, PPS Locked" in out
    assert "all settings are as wanted" in out
    assert main(["lidar", "apply", "--address", sensor.address]) == 0  # nothing to do, nobody to ask


def test_nothing_is_changed_without_a_yes(
    lidar: Callable[..., Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = lidar()
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    assert main(["lidar", "apply", "--address", sensor.address]) == 2
    assert "nothing was changed: say --yes to set 2 of them" in capsys.readouterr().err
    assert sensor.posts == []


@pytest.mark.parametrize(("armed", "code"), [(True, 2), (False, 0), (None, 0)])
def test_a_vehicle_that_is_armed_keeps_its_lidar_as_it_is(
    lidar: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], armed: bool | None, code: int
) -> None:
    boot_id = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    link = LinkStatus(connected=True, age_s=0.1, armed=armed)
    status = Status(time.monotonic_ns(), boot_id, "", 1, 1.0, 0, LidarStatus(), {"ins": link}, RecorderStatus())
    (tmp_path / "status.json").write_text(to_json(status))
    (tmp_path / "swathd.yaml").write_text(f"recorder: {{directory: {tmp_path}}}")
    sensor = lidar()
    words = ["lidar", "apply", "--yes", "--address", sensor.address, "--config", str(tmp_path / "swathd.yaml")]
    assert main(words) == code
    assert bool(sensor.posts) == (code == 0)
    assert ("the vehicle is armed" in capsys.readouterr().err) == (code == 2)


def test_a_slow_sensor_is_waited_for_and_a_deaf_one_told_of(lidar: Callable[..., Any]) -> None:
    slow = lidar(slow_s=0.5)
    web, wanted = LidarWeb(slow.address), LidarSettings()
    web.apply(compare(wanted, web.read("settings")))
    assert compare(wanted, web.read("settings")) != []
    web.verify(wanted)
    deaf = LidarWeb(lidar(deaf=True).address)
    deaf.apply(compare(wanted, deaf.read("settings")))
    with pytest.raises(SourceError, match=r"did not take its settings: fov.start: 0 found, 255 wanted; fov.end"):
        deaf.verify(wanted, settle_s=0.3)


def test_old_firmware_without_a_web_server_is_told_by_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))  # bound and not listening: refused
        assert main(["lidar", "show", "--address", f"127.0.0.1:{sock.getsockname()[1]}"]) == 1
    assert "has no web server (connection refused): old HDL-32E firmware has none" in capsys.readouterr().err


def test_silence_is_told_from_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lidar_settings, "_TIMEOUT_S", 0.2)
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        sock.listen()
        with pytest.raises(SourceError, match="nothing answers at"):
            LidarWeb(f"127.0.0.1:{sock.getsockname()[1]}").read("settings")


@pytest.mark.parametrize("answer", [b"\x00\x01garbage\r\n\r\n", b""])
def test_what_is_no_web_server_is_one_sentence(answer: bytes) -> None:
    import threading

    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            peer, _ = server.accept()
            with peer:
                peer.recv(4096)
                peer.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(SourceError, match="cannot be asked"):
            LidarWeb(f"127.0.0.1:{server.getsockname()[1]}").read("settings")
        thread.join()


def test_another_device_with_a_web_server_is_no_lidar(lidar: Callable[..., Any]) -> None:
    with pytest.raises(SourceError, match="is not what an HDL-32E's web server gives"):
        LidarWeb(lidar(pages=False).address).read("settings")
    with pytest.raises(SourceError, match="answers 404 Not Found"):
        LidarWeb(lidar().address).read("diagnosis")


def test_a_refused_form_is_told_with_its_address(lidar: Callable[..., Any]) -> None:
    web = LidarWeb(lidar().address)
    bad = LidarSettings(returns="Sideways")
    with pytest.raises(SourceError, match=r"/cgi/setting answers 400"):
        web.apply(compare(bad, web.read("settings")))
