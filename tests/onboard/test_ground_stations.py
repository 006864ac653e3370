"""What ground stations make of our messages, by the code of ground stations: pymavlink's connection and MAVProxy's link module."""

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.mavlink import FrameParser
from onboard import announce
from onboard.announce import Announcer, numbers, states
from onboard.autopilotclock import AutopilotClock
from onboard.config import StreamsConfig
from onboard.lidarstate import State
from onboard.linkcounts import LinkCounts, note_frames
from onboard.requester import Requester
from onboard.status import LidarStatus, LinkStatus, RecorderStatus, Status
from onboard.voice import COMPONENT, Voice

S = 10**9
BAD = Status(
    time_ns=1, boot_id="b", version="1", pid=1, uptime_s=3.5, clock_steps=0,
    lidar=LidarStatus(state=State.SILENT, age_s=9.0, kernel_drops=4), links={"ins": LinkStatus(connected=True, age_s=9.0)},
    recorder=RecorderStatus(space="full"), failures=["a worker that died with a long and winding explanation of it all"],
)  # fmt: skip
MEANT = {
    dialect.MAV_SEVERITY_CRITICAL: ("white", "red"),
    dialect.MAV_SEVERITY_WARNING: ("black", "orange"),
    dialect.MAV_SEVERITY_INFO: ("white", (0, 128, 0)),
}
"""Colours of the console that a pilot takes for: act, look, all is well."""


def texts() -> list[dialect.MAVLink_message]:
    """One of each state that is told, good and bad."""
    announcer, found = Announcer(), []
    for status in (BAD, Status(1, "b", "1", 1, 3.5, 0, LidarStatus(age_s=0.1), {}, RecorderStatus())):
        for _ in range(12):
            if (text := announcer.next(states(status))) is not None:
                found.append(text)
    return found


def everything(version: int) -> list[bytes]:
    """All that the daemon ever sends on a link: requests over two minutes, numbers, texts, questions and answers of the clock."""
    counts, voice = LinkCounts(), Voice()
    autopilot = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    beat = dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3).pack(autopilot, force_mavlink1=version == 1)
    note_frames(counts, FrameParser().feed(1, bytes(beat)))
    requester, clock = Requester(StreamsConfig(), voice), AutopilotClock("ins")
    found = [data for second in range(120) for data in requester.due(counts, (100 + second) * S)]
    question = clock.question(300 * S)
    asked = frame_of(dialect.MAVLink_timesync_message(0, 12345), autopilot)
    messages = [*numbers(BAD), *texts(), *filter(None, (question, clock.hear(asked)))]
    return found + [voice.frame(message, 1, version) for message in messages]


def frame_of(message: dialect.MAVLink_message, sender: Any) -> Any:
    (frame,) = FrameParser().feed(301 * S, bytes(message.pack(sender)))
    return frame


@pytest.mark.parametrize("version", [1, 2])
def test_nothing_that_is_sent_touches_mission_camera_or_mode(version: int) -> None:
    heard = dialect.MAVLink(None).parse_buffer(b"".join(everything(version)))
    kinds = {message.get_type() for message in heard}
    asking = {"REQUEST_DATA_STREAM"} | ({"COMMAND_LONG"} if version == 2 else set())
    assert kinds == {"HEARTBEAT", "NAMED_VALUE_FLOAT", "STATUSTEXT", "TIMESYNC"} | asking
    commands = {message.command for message in heard if message.get_type() == "COMMAND_LONG"}
    assert commands <= {dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_REQUEST_MESSAGE}
    assert {(message.get_srcSystem(), message.get_srcComponent()) for message in heard} == {(1, COMPONENT)}


@pytest.mark.parametrize("version", [1, 2])
def test_pymavlink_keeps_the_vehicle_as_it_was(version: int, tmp_path: Path) -> None:
    """In a telemetry log as ground stations write it, between the heartbeats of an armed copter in AUTO."""
    autopilot = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    beat = bytes(dialect.MAVLink_heartbeat_message(2, 3, 128 | 1, 3, 4, 3).pack(autopilot, force_mavlink1=version == 1))
    frames = [beat, *everything(version)]
    path = tmp_path / "flight.tlog"
    path.write_bytes(
        b"".join(struct.pack(">Q", 1_700_000_000_000_000 + i * 1000) + data for i, data in enumerate(frames))
    )
    connection = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    named: dict[str, float] = {}
    shown = []
    while (message := connection.recv_match()) is not None:
        if message.get_type() == "NAMED_VALUE_FLOAT":
            named[message.name] = message.value
        elif message.get_type() == "STATUSTEXT":
            shown.append((message.severity, message.text))
    assert bool(connection.motors_armed())
    assert connection.flightmode == "AUTO"
    assert connection.sysid_state[1].mav_type == dialect.MAV_TYPE_QUADROTOR
    assert named == {"lidar_hz": 0.0, "lidar_lost": 4.0, "mav_lost_b": 0.0, "disk_min": -1.0}
    assert shown == [(text.severity, text.text) for text in texts()]
    connection.close()


@pytest.fixture
def station() -> Any:
    """MAVProxy's link module without the rest of MAVProxy; what it would print is in `said`."""
    module = pytest.importorskip("MAVProxy.modules.mavproxy_link", reason="pip install --no-deps MAVProxy")
    link = object.__new__(module.LinkModule)
    said: list[tuple[str, Any, Any]] = []
    console = SimpleNamespace(
        writeln=lambda text, fg="black", bg="white": said.append((text, fg, bg)),
        write=lambda *_, **__: None,
        set_status=lambda *_, **__: None,
    )
    settings = SimpleNamespace(
        target_system=1, target_component=1, shownoise=True, altreadout=0, distreadout=0, checkdelay=False
    )
    status = SimpleNamespace(
        statustexts_by_sysidcompid={}, last_apm_msg=None, last_apm_msg_time=0, heartbeat_error=False, last_heartbeat=0, armed=True,
        msgs={}, watch=None, highest_msec={}, flightmode="AUTO",
    )  # fmt: skip
    link.mpstate = SimpleNamespace(
        console=console, settings=settings, status=status, mav_master=[], vehicle_type="copter", vehicle_name="Copter"
    )
    link.outstanding_timesyncs = []
    link.said = said
    return link


@pytest.mark.parametrize("version", [1, 2])
def test_mavproxy_shows_each_text_whole_in_the_colour_that_is_meant(station: Any, version: int) -> None:
    voice, wanted = Voice(), texts()
    for text in wanted:
        (message,) = dialect.MAVLink(None).parse_buffer(voice.frame(text, 1, version))
        station.master_msg_handling(message, SimpleNamespace(target_system=1, target_component=1, linkerror=False))
    # by itself it shows the texts of the autopilot's component alone
    assert [text for text in station.said if text[0].startswith("AP: ")] == []
    station.mpstate.settings.target_component = 0
    for text in wanted:
        (message,) = dialect.MAVLink(None).parse_buffer(voice.frame(text, 1, version))
        station.master_msg_handling(message, SimpleNamespace(target_system=1, target_component=0, linkerror=False))
    lines = [text for text in station.said if text[0].startswith("AP: ")]
    assert [line[0] for line in lines] == [f"AP: {text.text}" for text in wanted]
    assert [(fg, bg) for _, fg, bg in lines] == [MEANT[text.severity] for text in wanted]
    assert {MEANT[text.severity] for text in wanted} == set(MEANT.values())
    assert station.mpstate.status.statustexts_by_sysidcompid == {"1.191": {}}  # none waits for a rest that never comes


def test_mavproxy_takes_our_heartbeat_for_no_vehicle(station: Any) -> None:
    heard = dialect.MAVLink(None).parse_buffer(b"".join(everything(2)))
    beats = [message for message in heard if message.get_type() == "HEARTBEAT"]
    assert beats
    assert not any(station.heartbeat_is_from_autopilot(message) for message in beats)
    own = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    (vehicle,) = dialect.MAVLink(None).parse_buffer(dialect.MAVLink_heartbeat_message(2, 3, 128, 3, 4, 3).pack(own))
    assert station.heartbeat_is_from_autopilot(vehicle)


def test_a_text_is_never_taken_for_the_first_piece_of_a_longer_one() -> None:
    """MAVLink 2 strings pieces together by an id: ours is 0, a text by itself, and 50 characters at the most."""
    for text in [announce.text(2, "x" * 80), *texts()]:
        (heard,) = dialect.MAVLink(None).parse_buffer(Voice().frame(text, 1, 2))
        assert (heard.id, heard.chunk_seq) == (0, 0)
        assert len(heard.text) <= 50
