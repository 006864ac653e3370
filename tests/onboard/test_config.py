from pathlib import Path

import pytest

from flightlog.config import loads, sample
from flightlog.errors import ConfigError
from onboard import config
from onboard.config import SwathdConfig


def read(text: str) -> SwathdConfig:
    return loads(text, SwathdConfig, "swathd.yaml")


def test_the_sample_is_the_default() -> None:
    assert read(sample(SwathdConfig)) == SwathdConfig()
    assert "# where it begins, azimuth of the sensor [deg]\n    start_deg: 255.0" in sample(SwathdConfig)


def test_the_default_field_of_view_is_105_deg_to_either_side() -> None:
    assert (SwathdConfig().lidar.fov.start_deg, SwathdConfig().lidar.fov.end_deg) == (360 - 105, 105)


def test_links_are_those_with_a_device() -> None:
    assert list(SwathdConfig().links()) == ["ins"]
    both = read("ins: {device: /dev/ttyACM0}\nfc: {device: 'udp:0.0.0.0:14550'}")
    assert list(both.links()) == ["ins", "fc"]
    assert both.ins.serial
    assert both.ins.requests
    assert not both.fc.serial
    assert not both.fc.requests
    assert both.fc.udp_address() == ("0.0.0.0", 14550)
    assert not read("ins: {device: null}").links()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lidar: {prot: 1}", "swathd.yaml: lidar: unknown key 'prot'"),
        ("lidar: {data_port: 70000}", "swathd.yaml: lidar: data_port: 70000 found, expected 1 to 65535"),
        ("lidar: {fov: {start_deg: -105}}", "start_deg: -105.0 found, expected 0 to 360"),
        ("ins: {baud: 57600}", "swathd.yaml: ins: device is missing"),
        ("ins: {device: 'udp:14550'}", "swathd.yaml: ins: device 'udp:14550' found, expected udp:ADDRESS:PORT"),
        ("fc: {device: 'udp:0.0.0.0:0'}", "expected udp:ADDRESS:PORT"),
        ("recorder: {directory: 7}", "swathd.yaml: recorder: directory: 7 found, expected a text"),
    ],
)
def test_a_wrong_option_is_one_sentence_with_its_place(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_status_file_is_where_systemd_says_or_beside_the_logs(tmp_path: Path) -> None:
    assert SwathdConfig().status_path("/run/swathd") == Path("/run/swathd/status.json")
    assert SwathdConfig().status_path(None) == Path("/var/lib/swathd/status.json")
    assert read("status_file: /tmp/s.json").status_path("/run/swathd") == Path("/tmp/s.json")
    (tmp_path / "c.yaml").write_text("lidar: {poll_ms: 30}\n")
    assert config.load(tmp_path / "c.yaml").lidar.poll_ms == 30
