"""Clocks that are made here, with known offset and rate, and links that delay; and what a real ArduCopter 3.1.3 sent."""

import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.mavlink import Frame, FrameParser
from flightlog.nmea import Rmc
from flightlog.records import SyncMethod, UtcSource
from onboard.autopilotclock import AutopilotClock
from onboard.clocksync import Envelope, RoundTrips, utc_of_lidar

S, MS, US = 1_000_000_000, 1_000_000, 1000
START = 1_700_000_000 * S
HOUR = 3600 * S


class Boot:
    """An autopilot's clock: `ppm` faster than the host's, `offset` ahead at the start."""

    def __init__(self, offset: int, ppm: float) -> None:
        self.offset, self.ppm = offset, ppm

    def at(self, log_ns: int) -> int:
        return log_ns + self.offset + round((log_ns - START) * self.ppm * 1e-6)

    def error(self, line: object, log_ns: int) -> float:
        return line.offset_at(log_ns) - (self.at(log_ns) - log_ns)  # type: ignore[attr-defined]


def asked(boot: Boot, seconds: int, seed: int, base: int = 2 * MS) -> RoundTrips:
    """Ask once a second over a link that takes `base` each way, and often longer on one of them."""
    random, trips = np.random.default_rng(seed), RoundTrips()
    for second in range(seconds):
        there, back = (base + int(random.exponential(5 * MS)) for _ in range(2))
        sent = START + second * S
        trips.add(sent, sent + there + back, boot.at(sent + there))
    return trips


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.floats(-100, 100))
def test_the_quickest_answers_give_offset_and_rate(seed: int, ppm: float) -> None:
    boot = Boot(-1_600_000_000 * S, ppm)
    line = asked(boot, 120, seed).line(now := START + 120 * S)
    assert line is not None
    assert line.method == SyncMethod.TIMESYNC
    # an answer is off by at most half of what its trip took; the best of 120 took 2 x (2 ms + little)
    assert abs(boot.error(line, now)) < 1.5 * MS
    assert 2 * MS <= line.uncertainty_ns < 4 * MS
    assert abs(line.skew_ppm - ppm) < 20  # half a millisecond over the first half minute of quick answers


def test_the_error_is_never_more_than_half_of_the_only_round_trip() -> None:
    boot, trips = Boot(-S, 0.0), RoundTrips()
    trips.add(START, START + 10 * MS, boot.at(START + 10 * MS))  # all of the delay on the way there
    line = trips.line(START)
    assert line is not None
    assert abs(boot.error(line, START)) == line.uncertainty_ns == 5 * MS


def test_an_autopilot_that_was_started_again_begins_a_new_line() -> None:
    trips = asked(Boot(-1000 * S, 0.0), 20, 1)
    again = Boot(-1_600_000_000 * S, 0.0)
    now = START + 30 * S
    trips.add(now, now + 4 * MS, again.at(now + 2 * MS))
    assert trips.restarts == 1
    line = trips.line(now)
    assert line is not None
    assert again.error(line, now) == 0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.floats(-100, 100))
def test_the_envelope_of_stamps_received_one_way_gives_offset_and_rate_but_for_the_shortest_delay(
    seed: int, ppm: float
) -> None:
    boot, envelope, random = Boot(-1_600_000_000 * S, ppm), Envelope(), np.random.default_rng(seed)
    for i in range(25 * 120):
        made = START + i * 40 * MS
        stamp = boot.at(made) // MS * MS  # whole milliseconds, cut
        envelope.add(made + 6 * MS + int(random.exponential(8 * MS)), stamp)
    now = START + 120 * S
    line = envelope.line(now)
    assert line is not None
    assert line.method == SyncMethod.ENVELOPE
    # 6 ms of delay are not seen; cutting costs up to 1 ms, and the quickest of a window are 0.1 ms late
    assert -8 * MS < boot.error(line, now) < -4 * MS
    assert abs(line.skew_ppm - ppm) < 20


def test_late_messages_move_no_envelope_and_a_restart_begins_it_anew() -> None:
    envelope = Envelope()
    for i in range(100):
        envelope.add(START + i * 100 * MS, 1000 * S + i * 100 * MS)
    envelope.add(START + 11 * S, 1010 * S)  # a message that waited for a second
    assert envelope.restarts == 0
    for i in range(6):
        envelope.add(START + 20 * S + i * 100 * MS, 2 * S + i * 100 * MS)
    assert envelope.restarts == 1
    line = envelope.line(START + 20 * S)
    assert line is not None
    assert line.offset_ns == 2 * S - (START + 20 * S)


def test_the_top_of_the_hour_does_not_interrupt_the_lidars_line() -> None:
    envelope = Envelope(HOUR, 50 * US)
    for second in range(3500, 3700):
        envelope.add(START + second * S, second % 3600 * S)
    assert envelope.restarts == 0
    line = envelope.line(START + 3700 * S)
    assert line is not None
    assert (START + 3700 * S + line.offset_ns) % HOUR == 100 * S


def rmc(utc_ns: int, valid: bool = True) -> Rmc:
    return Rmc(utc_ns, valid, 0, 0, 0, 0)


def test_a_lidar_that_follows_gps_has_its_hour_from_the_sentence_and_another_has_none() -> None:
    # the Monterey recording: the sentence of second 393 is first seen at stamp 393.848 s
    utc = round(datetime(2012, 12, 4, 22, 6, 33, tzinfo=UTC).timestamp()) * S
    hour = utc // HOUR * HOUR
    assert utc_of_lidar(393_848 * MS, rmc(utc)) == (hour, UtcSource.RMC_FIX)
    assert utc_of_lidar(393_848 * MS + 5 * HOUR, rmc(utc, valid=False)) == (hour - 5 * HOUR, UtcSource.RMC_NO_FIX)
    assert utc_of_lidar(200 * S, rmc(utc)) == (0, UtcSource.NONE)  # counts from when it was switched on
    assert utc_of_lidar(392_900 * MS, rmc(utc)) == (0, UtcSource.NONE)  # no sentence comes before its second
    assert utc_of_lidar(393_848 * MS, None) == (0, UtcSource.NONE)
    # across the hour: the sentence is of its last second
    last = hour + HOUR - S
    assert utc_of_lidar(HOUR - 150 * MS, rmc(last))[0] == hour
    assert utc_of_lidar(500 * MS, rmc(last))[0] == hour + HOUR


# Messages -------------------------------------------------------------------------------------------------------------


def frame(message: dialect.MAVLink_message, log_ns: int) -> Frame:
    mavlink = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    return FrameParser().feed(log_ns, bytes(message.pack(mavlink)))[0]


def test_our_questions_are_answered_and_answers_to_others_ignored() -> None:
    clock, boot = AutopilotClock("ins"), Boot(-1_600_000_000 * S, 0.0)
    question = clock.question(START)
    assert question is not None
    assert (question.tc1, question.ts1) == (0, START)
    assert clock.question(START + S // 2) is None
    # an answer to what somebody else asked, from long ago by our clock
    clock.hear(frame(dialect.MAVLink_timesync_message(boot.at(START), START - 1), START + 3 * MS))
    assert clock.line(START) is None
    clock.hear(frame(dialect.MAVLink_timesync_message(boot.at(START + 2 * MS), START), START + 4 * MS))
    sync = clock.sync(START + S)
    assert sync is not None
    assert (sync.offset_ns, sync.uncertainty_ns, sync.method) == (boot.offset, 2 * MS, SyncMethod.TIMESYNC)
    # the same answer a second time is nobody's
    clock.hear(frame(dialect.MAVLink_timesync_message(boot.at(START + 900 * MS), START), START + 901 * MS))
    again = clock.sync(START + S)
    assert again is not None
    assert again.samples == 1


def test_the_autopilots_questions_are_answered_with_our_time() -> None:
    answer = AutopilotClock("ins").hear(frame(dialect.MAVLink_timesync_message(0, 777), START))
    assert answer is not None
    assert (answer.tc1, answer.ts1) == (START, 777)


def test_who_does_not_answer_is_asked_more_rarely() -> None:
    clock = AutopilotClock("ins")
    asked_at = [second for second in range(100) if clock.question(START + second * S) is not None]
    assert asked_at == [*range(10), *range(10, 100, 10)]


def test_system_time_gives_utc_and_zero_means_that_it_is_not_known() -> None:
    clock = AutopilotClock("ins")
    clock.hear(frame(dialect.MAVLink_system_time_message(0, 5000), START))
    sync = clock.sync(START)
    assert sync is not None
    assert sync.utc_source == UtcSource.NONE
    clock.hear(frame(dialect.MAVLink_system_time_message(1_400_000_000_000_000, 6000), START + S))
    sync = clock.sync(START + 2 * S)
    assert sync is not None
    assert sync.utc_source == UtcSource.SYSTEM_TIME
    assert START + 2 * S + sync.utc_offset_ns == 1_400_000_001 * S


def test_a_real_arducopter_3_1_3_is_tied_by_its_stamps(recordings: Path) -> None:
    raw, offset = (recordings / "mavlink" / "arducopter313_sim.tlog").read_bytes(), 0
    clock, parser, delays = AutopilotClock("ins"), FrameParser(), []
    while offset + 16 < len(raw):
        (host_us,) = struct.unpack_from(">Q", raw, offset)
        size = raw[offset + 9] + 8
        for found in parser.feed(host_us * US, raw[offset + 8 : offset + 8 + size]):
            clock.hear(found)
            if found.message_id == dialect.MAVLINK_MSG_ID_ATTITUDE:
                delays.append((host_us * US, host_us * US - int.from_bytes(found.payload[:4], "little") * MS))
        offset += 8 + size
    now = host_us * US
    sync = clock.sync(now)
    assert sync is not None
    assert (sync.method, sync.utc_source, sync.restarts) == (SyncMethod.ENVELOPE, UtcSource.SYSTEM_TIME, 0)
    times, late = np.array(delays).T
    late = late + sync.offset_ns + (times - now) * sync.skew_ppm * 1e-6
    # no stamp comes before it was made: the line lies on top of all of them and touches the quickest
    assert late.min() > -2
    assert np.median(late) < 3 * MS
    # autopilot and host were one machine: one crystal, one wall clock
    assert abs(sync.skew_ppm) < 5
    assert abs(sync.utc_offset_ns) < 250 * MS


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([2, 30, 33, 111]), st.binary(max_size=60), st.integers(0, 2**62))
def test_any_payload_is_taken(number: int, payload: bytes, log_ns: int) -> None:
    clock = AutopilotClock("ins")
    head = bytes([0xFD, len(payload), 0, 0, 0, 1, 1, number, 0, 0])
    clock.hear(Frame(log_ns, 1, 1, number, 0, 2, True, head + payload + b"\0\0"))
    clock.sync(log_ns)
