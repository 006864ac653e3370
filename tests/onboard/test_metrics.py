"""What monitors read: the JSON of health by its schema, and the text file for Prometheus as its own parser sees it."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import jsonschema
import pytest
from prometheus_client.parser import text_string_to_metric_families
from recording import recording

from onboard import health, metrics
from onboard.health import Level, Verdict
from onboard.healthschema import schema
from onboard.lidarstate import State
from onboard.status import ClockStatus, DownlinkStatus, LidarStatus, LinkStatus, RecorderStatus, Status, to_json

DOCS = Path(__file__).parents[2] / "docs"


def full(**more: object) -> Status:
    status = Status(
        time_ns=time.monotonic_ns() + 600_000_000_000,
        boot_id=Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
        version="1",
        pid=1,
        uptime_s=10.5,
        clock_steps=2,
        lidar=LidarStatus(age_s=0.1, packets_s=1808.0, kept=99, kernel_drops=3, rejected={'a "quoted"\\ reason': 4}),
        links={"ins": LinkStatus(connected=True, age_s=0.2, armed=True, achieved_hz={"ATTITUDE": 49.5}, asked_hz={"ATTITUDE": 50})},
        recorder=RecorderStatus(segment="00001-000.mcap", minutes_left=42.0, space="low", free_bytes=12_345_678_901),
        downlink=DownlinkStatus("10.0.0.2"),
        clocks={"lidar": ClockStatus("ENVELOPE", 1.5, 0.25, 10, 0, "NONE")},
        temperature_c=51.0,
    )  # fmt: skip
    return replace(status, **more)  # type: ignore[arg-type]


def values(text: str) -> dict[tuple[str, str], float]:
    """Samples by name and the value of the label, as Prometheus' own parser reads them."""
    return {
        (sample.name, ",".join(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_prometheus_reads_every_number_as_it_is() -> None:
    found = values(metrics.text(full(), Verdict(Level.WARNING, ["one"]), True))
    assert found["swathd_verdict", ""] == 1
    assert found["swathd_armed", ""] == 1
    assert found["swathd_lidar_kept_packets_total", ""] == 99
    assert found["swathd_lidar_lost_packets_total", "kernel"] == 3
    assert found["swathd_lidar_rejected_packets_total", 'a "quoted"\\ reason'] == 4
    assert found["swathd_link_message_hertz", "ins,ATTITUDE"] == 49.5
    assert found["swathd_recorder_free_bytes", ""] == 12_345_678_901
    assert found["swathd_recorder_left_seconds", ""] == 2520
    assert found["swathd_clock_uncertainty_seconds", "lidar"] == pytest.approx(0.25e-3)
    assert found["swathd_temperature_celsius", ""] == 51.0
    assert found["swathd_info", "1,00001-000.mcap"] == 1
    assert sum(value for (name, _), value in found.items() if name == "swathd_lidar_state") == 1
    assert found["swathd_recorder_space", "low"] == 1


def test_counters_and_gauges_are_told_by_their_names_and_have_a_word_of_explanation() -> None:
    for family in text_string_to_metric_families(metrics.text(full(), Verdict(Level.GOOD, []), None)):
        assert family.documentation.endswith(".")
        assert family.type == ("counter" if family.samples[0].name.endswith("_total") else "gauge")


def test_what_is_not_known_is_left_out_and_not_zero() -> None:
    status = full(temperature_c=None, lidar=LidarStatus(), links={}, clocks={}, recorder=RecorderStatus())
    found = values(metrics.text(status, Verdict(Level.GOOD, []), None))
    names = {name for name, _ in found}
    assert names.isdisjoint(
        {"swathd_temperature_celsius", "swathd_armed", "swathd_lidar_age_seconds", "swathd_recorder_left_seconds"}
    )


BARE = full(links={}, clocks={}, downlink=None, temperature_c=None)


@pytest.mark.parametrize("status", [full(), BARE, full(lidar=LidarStatus(state=State.NO_LINK))])
def test_the_json_is_what_the_schema_says(status: Status) -> None:
    tree = health.told(Verdict(Level.GOOD, []), None, json.loads(to_json(status)))
    jsonschema.Draft202012Validator.check_schema(schema())
    jsonschema.validate(tree, schema())
    for name in ("schema", "verdict", "status"):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({key: value for key, value in tree.items() if key != name}, schema())


def test_the_committed_schema_is_that_of_the_program() -> None:
    assert json.loads((DOCS / "health.schema.json").read_text()) == schema()


def test_several_operators_see_the_same_at_once(tmp_path: Path) -> None:
    config = tmp_path / "swathd.yaml"
    config.write_text(f"status_file: {tmp_path}/status.json\n")
    (tmp_path / "status.json").write_text(to_json(full()))
    words = [sys.executable, "-m", "onboard.cli", "health", "--config", config, "--json"]
    running = [subprocess.Popen(words, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    trees = [json.loads(process.communicate(timeout=300)[0]) for process in running]
    assert trees[0] == trees[1] == trees[2]
    jsonschema.validate(trees[0], schema())
    # and where there is no status, the answer has the same shape
    (tmp_path / "status.json").unlink()
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == Level.CRITICAL
    jsonschema.validate(json.loads(done.stdout), schema())


def test_the_daemon_writes_it_each_second(tmp_path: Path) -> None:
    path = tmp_path / "swathd.prom"
    with recording(tmp_path, tmp_path / "logs", lidar=True):
        end = time.monotonic() + 120
        while not path.exists() or not values(path.read_text())["swathd_lidar_kept_packets_total", ""]:
            assert time.monotonic() < end
            time.sleep(0.1)
    assert values(path.read_text())["swathd_link_connected", "ins"] == 1
    assert sorted(each.name for each in tmp_path.glob("*.prom*")) == ["swathd.prom"]
