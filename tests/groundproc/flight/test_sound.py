"""Any value at the door of an autopilot's messages: what cannot be is left out and counted, everywhere."""

import json
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import mavlink
from flightlog.mavlink import FrameParser
from groundproc.cli import main
from groundproc.cloud import placing
from groundproc.cloud.points import Points
from groundproc.flight import autopilot
from groundproc.flight.importers import tlog
from groundproc.flight.sound import LARGEST, possible
from groundproc.flight.summary.telemetry import TelemetrySummary

WRONG = (np.nan, np.inf, -np.inf, 1e30, -1e30)
ATTITUDE = [1000, 0.1, -0.2, 3.0, 0.01, 0.02, 0.03]


def stream(messages: list[dialect.MAVLink_message]) -> list[mavlink.Frame]:
    """A heartbeat and some messages, as a link has them."""
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    parser = FrameParser()
    return [frame for m in [beat, *messages] for frame in parser.feed(0, bytes(m.pack(link)))]


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("field", range(1, 7))
def test_an_attitude_with_a_value_that_cannot_be_is_left_out_and_counted(field: int, wrong: float) -> None:
    rows = [[1000 + 100 * i, *ATTITUDE[1:]] for i in range(5)]
    rows[2][field] = wrong
    frames = stream([dialect.MAVLink_attitude_message(*row) for row in rows])
    (boot,) = autopilot.boots(frames)
    assert boot.tables["ATTITUDE"]["time_boot_ms"].tolist() == [1000, 1100, 1300, 1400]
    assert boot.left_out == {"ATTITUDE": 1}
    summary = TelemetrySummary()
    for frame in frames:
        summary.add(frame)
    assert summary.result(0, 0)["impossible"] == {"ATTITUDE": 1}


@pytest.mark.parametrize("name", LARGEST)
def test_every_field_that_is_used_has_a_largest_value(name: str) -> None:
    dtype = mavlink.payload_dtype(mavlink.message_id(name))
    for field, most in LARGEST[name].items():
        kind = dtype[field]
        wrong = WRONG if kind.kind == "f" else (np.iinfo(kind).max, np.iinfo(kind).min)
        for value in wrong:
            table = np.zeros(3, dtype)
            if name == "ATTITUDE_QUATERNION":
                table["q1"] = 1.0
            table[field][1] = value
            assert possible(table, name).tolist() == [True, abs(float(value)) <= most, True]


def test_a_quaternion_has_the_length_of_one() -> None:
    table = np.zeros(4, mavlink.payload_dtype(mavlink.message_id("ATTITUDE_QUATERNION")))
    table["q1"] = [1.0, 0.0, 1e30, np.nan]
    assert possible(table, "ATTITUDE_QUATERNION").tolist() == [True, False, False, False]


@pytest.mark.filterwarnings("error")
def test_points_without_a_place_are_counted_and_reach_no_product() -> None:
    xyz = np.zeros((6, 3))
    xyz[1, 0], xyz[2, 1], xyz[3, 2], xyz[4, 0] = np.nan, np.inf, -np.inf, 9e15
    kept = placing.without_strays(Points(np.arange(6), xyz))
    assert kept.time_ns.tolist() == [0, 5]
    assert kept.dropped.impossible == 4
    assert placing.without_strays(kept) is kept


def test_a_flight_with_attitudes_that_are_no_number_is_the_flight_without_them(
    cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = cases / "nan_attitude"
    without = tmp_path / "without.tlog"
    bad = write_without(case / "t.tlog", without, lambda frame: frame.name == "ATTITUDE" and not finite(frame))
    assert bad == 3
    clouds = []
    for name, telemetry in (("with", case / "t.tlog"), ("without", without)):
        log, folder = tmp_path / f"{name}.mcap", tmp_path / name
        assert main(["import", "--pcap", str(case / "l.pcap"), "--mavlink", str(telemetry), "-o", str(log)]) == 0
        assert main(["info", str(log)]) == 0
        assert ("left out              3 ATTITUDE" in capsys.readouterr().out) is (name == "with")
        assert (
            main(["process", str(log), "-o", str(folder), "--method", "ins", "--products", "cloud.laz"]) == 3
        )  # no mount, and short
        told = json.loads((folder / "quality.json").read_text())
        assert told["autopilot"]["impossible"] == ({"ATTITUDE": 3} if name == "with" else {})
        clouds.append(laspy.read(folder / "cloud.laz").xyz)
    assert np.array_equal(*clouds)
    assert np.abs(clouds[0]).max() < 1e7


def finite(frame: mavlink.Frame) -> bool:
    (row,) = mavlink.table([frame], frame.name)
    return all(np.isfinite(row[field]) for field in ("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"))


def write_without(source: Path, target: Path, unwanted: Callable[[mavlink.Frame], bool]) -> int:
    """A telemetry log without some frames; gives their number."""
    count, parser = 0, FrameParser()
    with target.open("wb") as file:
        for record in tlog.records(source.read_bytes(), tlog.TlogCount()):
            frames = parser.feed(record.time_ns, record.data)
            if any(map(unwanted, frames)):
                count += 1
                continue
            file.write((record.time_ns // 1000).to_bytes(8, "big") + record.data)
    return count
