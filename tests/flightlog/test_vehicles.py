"""Who the autopilot is: by evidence, by type, by component; anew after silence. Frames are pymavlink's."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.mavlink import Frame, FrameParser
from flightlog.vehicles import MOST_SENDERS, SILENT_NS, Vehicles

S = 1_000_000_000
ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED


def frame(time_ns: int, system: int, component: int, message: dialect.MAVLink_message) -> Frame:
    speaker = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    (found,) = FrameParser().feed(time_ns, bytes(message.pack(speaker)))
    return found


def beat(
    time_ns: int, system: int = 1, component: int = 1, kind: int = 2, autopilot: int = 3, *, armed: bool = False
) -> Frame:
    mode = ARMED if armed else 0
    return frame(time_ns, system, component, dialect.MAVLink_heartbeat_message(kind, autopilot, mode, 0, 4, 3))


def attitude(time_ns: int, system: int = 1, component: int = 1) -> Frame:
    return frame(time_ns, system, component, dialect.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0, 0, 0))


def heard(*frames: Frame) -> Vehicles:
    vehicles = Vehicles()
    for each in frames:
        vehicles.hear(each)
    return vehicles


def test_a_ground_station_with_the_words_of_an_autopilot_is_none() -> None:
    vehicles = heard(beat(0, 252, 0, kind=6, autopilot=0), beat(S, armed=True))
    assert vehicles.autopilot == (1, 1)
    assert vehicles.armed(S) is True
    assert vehicles.vehicles() == [(1, 1)]


def test_an_id_that_says_armed_and_disarmed_in_turn_is_armed() -> None:
    """Two vehicles that share it, each with a heartbeat a second."""
    vehicles = Vehicles()
    for i in range(10):
        vehicles.hear(beat(i * S, armed=True))
        vehicles.hear(beat(i * S + S // 2))
        assert i == 0 or vehicles.armed(i * S + S // 2) is True
    # once only one of them is heard, it is believed
    for i in range(10, 14):
        vehicles.hear(beat(i * S))
    assert vehicles.armed(13 * S) is False
    # a landing is believed at once
    landed = heard(beat(0, armed=True), beat(S, armed=True), beat(2 * S))
    assert landed.armed(2 * S) is False


def test_evidence_goes_before_heartbeats_whoever_was_first() -> None:
    vehicles = heard(beat(0, 7, 1), attitude(1, 3, 1), beat(2, 7, 1))
    assert vehicles.autopilot == (3, 1)
    assert vehicles.vehicles() == [(3, 1), (7, 1)]


def test_component_1_is_preferred_and_among_equals_the_first() -> None:
    assert heard(beat(0, 1, 4), beat(1, 1, 1)).autopilot == (1, 1)
    assert heard(attitude(0, 2, 1), attitude(1, 1, 1), attitude(2, 1, 1)).autopilot == (2, 1)


def test_a_gimbal_that_sends_attitudes_is_no_autopilot() -> None:
    vehicles = heard(beat(0, 1, 154, kind=26, autopilot=8), attitude(1, 1, 154), beat(2))
    assert vehicles.autopilot == (1, 1)
    # it said so only after it was taken for one
    vehicles = heard(attitude(0, 1, 154), beat(1, 1, 154, kind=26, autopilot=8))
    assert vehicles.autopilot is None


def test_a_system_id_changed_in_flight_is_followed_after_silence() -> None:
    vehicles = heard(beat(0), *(beat(k * S // 2, 3, armed=True) for k in range(1, 6)))
    assert vehicles.autopilot == (1, 1)
    # the other vehicle says that it is armed: that is believed at once, whoever is the autopilot
    assert vehicles.armed(5 * S // 2) is True
    for k in range(6, 12):
        vehicles.hear(beat(k * S // 2, 3, armed=True))
    assert vehicles.autopilot == (3, 1)


def test_a_stranger_cannot_disarm_and_silence_is_doubt() -> None:
    vehicles = heard(beat(0, armed=True), beat(1, 9))
    assert vehicles.armed(1) is True
    vehicles = heard(attitude(0), beat(1, 9))
    assert vehicles.autopilot == (1, 1)
    assert vehicles.armed(1) is None, "its own autopilot has said nothing yet"
    vehicles = heard(beat(0))
    assert vehicles.armed(SILENT_NS) is False
    assert vehicles.armed(SILENT_NS + 1) is None


@pytest.mark.parametrize("word", [attitude, beat])
def test_who_comes_back_waits_until_the_other_is_silent(word: Callable[..., Frame]) -> None:
    vehicles = heard(word(0, 1), word(S, 2), word(2 * S + SILENT_NS, 2))
    assert vehicles.autopilot == (2, 1)
    for k in range(4, 10):
        vehicles.hear(word(k * S, 1))
        vehicles.hear(word(k * S + 1, 2))
    assert vehicles.autopilot == (2, 1), "both are heard: no change without need"
    vehicles.hear(word(10 * S + SILENT_NS, 1))
    assert vehicles.autopilot == (1, 1)
    assert vehicles.vehicles() == [(1, 1), (2, 1)]


def test_a_newcomer_is_believed_once_the_other_was_silent_for_more_than_three_seconds() -> None:
    assert heard(beat(0), beat(SILENT_NS, 3)).autopilot == (1, 1)
    assert heard(beat(0), beat(SILENT_NS + 1, 3)).autopilot == (3, 1)


def test_of_two_that_fly_the_one_with_a_heartbeat_is_believed() -> None:
    vehicles = heard(attitude(0, 2), attitude(1, 3), beat(2, 3))
    assert vehicles.autopilot == (3, 1)
    assert vehicles.vehicles() == [(3, 1), (2, 1)]


def test_each_change_of_the_autopilot_is_told_once() -> None:
    vehicles = Vehicles()
    words = [
        beat(0, 252, 0, kind=6), beat(1, 7), beat(2, 7), attitude(3, 7), attitude(4, 3), beat(5, 3), beat(6, 7),
        attitude(7 + SILENT_NS, 3), beat(8 + SILENT_NS, 3, kind=6), attitude(9 + SILENT_NS, 7),
    ]  # fmt: skip
    told = [vehicles.hear(word) for word in words]
    #  a station, 7, no news, that it flies, another flies too, and says so, no news; 7 is silent; it was a station; 7 is back
    assert told == [False, True, False, False, False, False, False, True, True, True]
    assert vehicles.autopilot == (7, 1)


def test_what_a_sender_said_is_counted_and_kept() -> None:
    vehicles = heard(beat(5), beat(6, armed=True), attitude(7), attitude(8), attitude(9))
    sender = vehicles.senders[1, 1]
    assert (sender.frames, sender.heartbeats, sender.evidence) == (5, 2, 3)
    assert (sender.first_ns, sender.newest_ns, sender.armed_ns) == (5, 9, 6)
    assert sender.armed is True


def test_zeros_that_mavlink_2_leaves_out_are_put_back_at_the_end() -> None:
    """A generic vehicle on the ground may send a heartbeat of nothing but zeros: one byte of it travels."""
    for fields, armed in (((0, 0, 0, 0, 0, 0), False), ((2, 3, ARMED, 0, 0, 0), True)):
        speaker = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        (sent,) = FrameParser().feed(0, bytes(dialect.MAVLink_heartbeat_message(*fields).pack(speaker)))
        assert len(sent.payload) < 9
        vehicles = heard(sent)
        assert vehicles.autopilot == (1, 1)
        assert vehicles.armed(0) is armed
        assert vehicles.senders[1, 1].version == 2


def test_frames_of_an_unknown_id_prove_nothing() -> None:
    vehicles = Vehicles()
    unknown = beat(0)._replace(known=False)
    assert vehicles.hear(unknown) is False
    assert vehicles.senders == {}


def test_made_up_addresses_fill_no_memory() -> None:
    vehicles = heard(attitude(0), *(beat(k, 2 + k % 250, k // 250 + 1) for k in range(1000)))
    assert len(vehicles.senders) == MOST_SENDERS
    assert vehicles.overlooked == 1000 - MOST_SENDERS + 1
    assert vehicles.hear(beat(1000, 99, 99)) is False
    assert vehicles.autopilot == (1, 1)


@given(st.lists(st.tuples(st.integers(1, 3), st.sampled_from([1, 2, 154]), st.booleans(), st.booleans()), max_size=30))
def test_the_autopilot_was_always_heard_and_never_said_that_it_is_none(
    words: list[tuple[int, int, bool, bool]],
) -> None:
    vehicles = Vehicles()
    for k, (system, component, is_beat, armed) in enumerate(words):
        kind, pilot = (26, 8) if component == 154 else (2, 3)
        time_ns = k * S
        vehicles.hear(
            beat(time_ns, system, component, kind, pilot, armed=armed)
            if is_beat
            else attitude(time_ns, system, component)
        )
        if vehicles.autopilot is not None:
            sender = vehicles.senders[vehicles.autopilot]
            assert sender.frames > 0
            assert not sender.is_other


@pytest.mark.parametrize(("case", "right"), [("gcs_generic", (1, 1)), ("sysid_changed", (3, 1))])
def test_cases_that_failed_once(cases: Path, case: str, right: tuple[int, int]) -> None:
    data, at, frames = (cases / case / "frames.bin").read_bytes(), 0, []
    while at < len(data):
        (size,) = struct.unpack_from("<H", data, at)
        # a second from frame to frame, as heartbeats come
        frames += FrameParser().feed(len(frames) * S, data[at + 2 : at + 2 + size])
        at += 2 + size
    vehicles = heard(*frames)
    assert vehicles.autopilot == right
    assert vehicles.armed(frames[-1].time_ns) is True
