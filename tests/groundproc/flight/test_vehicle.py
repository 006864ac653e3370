"""Which of several vehicles on a link carried the lidar: a case with its right values, and made-up motion."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import sharing
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.logfile import LogReader
from flightlog.mavlink import Frame, FrameParser
from groundproc.cli import main
from groundproc.flight import autopilot, timebase, vehicle
from groundproc.flight.flight import read_flight
from groundproc.flight.importers import tlog
from groundproc.flight.pairing import legs
from groundproc.flight.sharing import parted
from groundproc.flight.sync import GyroTrack
from groundproc.flight.timeline import LidarRun
from groundproc.steps.clocks import describe_sync

FramesOf = Callable[..., list[Frame]]
Array = npt.NDArray[np.float64]
HOST_NS = 1_700_000_000_000_000_000
MS = 1_000_000


@pytest.fixture(scope="module")
def two_vehicles(cases: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    log = tmp_path_factory.mktemp("vehicles") / "log.mcap"
    case = cases / "two_vehicles"
    assert main(["import", "--pcap", str(case / "l.pcap"), "--mavlink", str(case / "t.tlog"), "-o", str(log)]) == 0
    return log


def test_the_vehicle_whose_gyros_fit_is_taken_although_half_of_its_messages_are_missing(two_vehicles: Path) -> None:
    with LogReader(two_vehicles) as reader:
        flight = read_flight([reader], "ins")
    assert {(boot.system, boot.component) for boot in flight.boots} == {(1, 1)}
    first, second = flight.choice.described()
    assert (first["address"], second["address"]) == ("1/1", "2/1")
    assert first["gyro_correlation"] > 0.9
    assert second["gyro_correlation"] < 0.5
    (note,) = flight.choice.notes
    assert "1/1 is taken, 2/1 left out" in note
    (leg,) = legs(flight.runs, flight.boots, np.eye(3), "gyro")
    assert -describe_sync(leg)["offset_s"] == pytest.approx(928.8388, abs=0.002)


def test_info_names_both_vehicles_with_their_scores(two_vehicles: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(two_vehicles)]) == 0
    text = capsys.readouterr().out
    assert "1/1 is taken, 2/1 left out" in text
    assert "1/1: 0.9" in text
    assert "2/1: 0." in text


def motion(seed: int, count: int = 6000) -> Array:
    """Rates of a vehicle that turns about all axes [rad/s], 100 a second."""
    smooth = np.exp(-0.5 * np.square(np.arange(-60, 61) / 20.0))
    noise = np.random.default_rng(seed).standard_normal((3, count + 120))
    return np.stack([np.convolve(row, smooth / np.linalg.norm(smooth), "valid") for row in noise], axis=1) * 0.3


def lidar_run(rates: Array) -> LidarRun:
    time_ns = HOST_NS + np.arange(len(rates), dtype=np.int64) * 10 * MS
    return LidarRun(
        int(time_ns[0]),
        int(time_ns[-1]),
        timebase.host_line(time_ns, time_ns),
        GyroTrack("the lidar", time_ns, rates),
        (),
    )


def attitudes(rates: Array, first: int, last: int, boot_ms: int) -> list[tuple[int, object]]:
    """Every fourth of some rates, in the ins frame, as ATTITUDE from forward, right, down."""
    return [
        (
            HOST_NS + i * 10 * MS,
            dialect.MAVLink_attitude_message(boot_ms + i * 10, 0.0, 0.0, 0.0, rates[i, 1], rates[i, 0], -rates[i, 2]),
        )
        for i in range(first, last, 4)
    ]


def together(*streams: list[Frame]) -> list[Frame]:
    return sorted((frame for stream in streams for frame in stream), key=lambda frame: frame.time_ns)


def test_the_gyros_overrule_the_order_in_which_vehicles_were_heard(frames_of: FramesOf) -> None:
    mine, strangers = motion(1), motion(2)
    frames = together(
        frames_of(attitudes(strangers, 0, 6000, 5_000), system=1), frames_of(attitudes(mine, 2, 6000, 90_000), system=7)
    )
    found = autopilot.vehicles(frames)
    assert found[0].name == "1/1"
    choice = vehicle.choose(found, [lidar_run(mine)])
    assert choice.vehicle.name == "7/1"
    assert [score.name for score in choice.scores] == ["7/1", "1/1"]


def test_two_autopilots_on_one_airframe_are_left_to_the_rule_aboard(frames_of: FramesOf) -> None:
    mine = motion(1)
    frames = together(
        frames_of(attitudes(mine, 0, 6000, 5_000), system=1), frames_of(attitudes(mine, 2, 6000, 90_000), system=2)
    )
    choice = vehicle.choose(autopilot.vehicles(frames), [lidar_run(mine)])
    assert choice.vehicle.name == "1/1"
    assert "the gyros of both fit" in choice.notes[0]


def test_without_gyros_of_the_lidar_the_rule_stands_and_the_doubt_is_said(frames_of: FramesOf) -> None:
    still = np.zeros((6000, 3))
    frames = together(
        frames_of(attitudes(motion(1), 0, 6000, 5_000), system=1),
        frames_of(attitudes(motion(2), 2, 6000, 9_000), system=2),
    )
    choice = vehicle.choose(autopilot.vehicles(frames), [lidar_run(still)])
    assert choice.vehicle.name == "1/1"
    assert "check which one carried it" in choice.notes[0]
    assert all(score.peak is None and score.reason for score in choice.scores)


def test_one_vehicle_after_another_is_no_change_of_id_when_the_gyros_contradict(frames_of: FramesOf) -> None:
    mine, strangers = motion(1), motion(2)
    before = frames_of(attitudes(strangers, 0, 2000, 500_000), system=2)
    after = frames_of(attitudes(mine, 2000, 6000, 5_000), system=1)
    (heard,) = autopilot.vehicles([*before, *after])
    choice = vehicle.choose([heard], [lidar_run(mine)])
    assert {boot.system for boot in choice.vehicle.boots} == {1}
    assert "2/1 left out: another vehicle" in choice.notes[0]


def test_a_reboot_under_a_new_id_is_kept_and_said(frames_of: FramesOf) -> None:
    mine = motion(1)
    before = frames_of(attitudes(mine, 0, 2000, 500_000), system=2)
    after = frames_of(attitudes(mine, 2100, 6000, 5_000), system=1)
    (heard,) = autopilot.vehicles([*before, *after])
    choice = vehicle.choose([heard], [lidar_run(mine)])
    assert len(choice.vehicle.boots) == 2
    assert choice.notes == ("the autopilot's MAVLink address changed during the flight: 2/1, then 1/1",)


# One id for several ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("later_ms", [0, 10_000, 100_000])
def test_two_vehicles_with_one_id_are_told_apart_and_the_one_with_the_lidar_is_taken(
    cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], later_ms: int
) -> None:
    link, log = tmp_path / "t.tlog", tmp_path / "a.mcap"
    link.write_bytes(sharing.shared_tlog((cases / "two_vehicles/t.tlog").read_bytes(), later_ms))
    words = ["import", "--pcap", str(cases / "two_vehicles/l.pcap"), "--mavlink", str(link), "-o", str(log)]
    assert main(words) == 0
    with LogReader(log) as reader:
        flight = read_flight([reader], "ins")
    (leg,) = legs(flight.runs, flight.boots, np.eye(3), "gyro")
    assert -describe_sync(leg)["offset_s"] == pytest.approx(928.8388, abs=0.002)
    first, second = flight.choice.described()
    assert first["gyro_correlation"] > 0.9
    assert second["gyro_correlation"] < 0.5
    assert "share the MAVLink id 1/1" in flight.choice.notes[0]
    assert main(["info", str(log)]) == 3
    text = capsys.readouterr().out
    assert "told apart by the numbers of their messages" in text
    assert "verdict: doubtful: several vehicles share the MAVLink id 1/1" in text


def test_one_vehicle_heard_by_two_links_stays_one(frames_of: FramesOf) -> None:
    rates = motion(1)
    twice = [frames_of(attitudes(rates, first, 6000, 5_000 + first), system=1) for first in (0, 2)]
    other = [frame._replace(sequence=(frame.sequence + 100) % 256) for frame in twice[1]]
    (only,) = autopilot.vehicles(together(twice[0], other))
    assert only.name == "1/1"
    assert len(only.boots) == 1


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_link_that_loses_most_of_its_messages_is_of_one_vehicle(frames_of: FramesOf, share: float) -> None:
    frames = frames_of(attitudes(motion(1), 0, 6000, 5_000), system=1)
    kept = np.random.default_rng(4).random(len(frames)) > share
    (only,) = autopilot.vehicles([frame for frame, keep in zip(frames, kept, strict=True) if keep])
    assert only.name == "1/1"


@pytest.mark.parametrize("name", ["arducopter313_sim", "ardusub_2023", "copter_flight_2015"])
def test_recorded_links_are_of_one_vehicle(recordings: Path, name: str) -> None:
    frames = [frame for record in tlog.records((recordings / f"mavlink/{name}.tlog").read_bytes(), tlog.TlogCount())
              for frame in FrameParser().feed(record.time_ns, record.data)]  # fmt: skip
    for address in {(frame.system, frame.component) for frame in frames if frame.known}:
        mine = [frame for frame in frames if frame.known and (frame.system, frame.component) == address]
        assert len(parted(mine)) == 1
