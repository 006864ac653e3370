"""Receive times of recordings whose computers' clocks were wrong, put right by the clocks of the devices in them."""

import random
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from flightlog import hdl32e, records
from flightlog.constants import HOUR_NS, NS_PER_MS, NS_PER_S
from flightlog.logfile import LogReader
from groundproc.cli import main
from groundproc.flight.importers.autopilotlogs import Tlog
from groundproc.flight.importers.captures import Capture
from groundproc.flight.importers.joining import Event
from groundproc.flight.importers.ports import Ports
from groundproc.flight.importers.starting import Start, moves, start_of
from groundproc.flight.importers.steady import Steady
from groundproc.flight.summary.log import summarise

START_NS = 1_779_272_223_000_000_000
PACKET_NS = 553_000
DAY_NS = 24 * HOUR_NS
Change = Callable[[int, int], int]


def lidar_events(count: int = 400, start_us: int = 3_599_900_000) -> list[Event]:
    """Data packets at the sensor's rate, over the hour, received with up to 0.3 ms of jitter; the bytes are told apart by their stamps."""
    rng = random.Random(5)
    events = []
    for i in range(count):
        stamp_us = (start_us + i * PACKET_NS // 1000) % 3_600_000_000
        data = bytearray(hdl32e.DATA_BYTES)
        data[1200:1204] = stamp_us.to_bytes(4, "little")
        late_ns = rng.randrange(300_000)
        events.append(Event(START_NS + i * PACKET_NS + late_ns, records.LIDAR.topic, bytes(data), b"\x0a\x00\x00\x01"))
    return events


def stamped(events: Sequence[Event], change: Change) -> list[Event]:
    return [event._replace(time_ns=change(i, event.time_ns)) for i, event in enumerate(events)]


def put_right(events: Sequence[Event]) -> tuple[list[Event], Steady]:
    steady = Steady()
    steady.begin(moves([start_of(lambda: iter(events))])[0])
    return list(steady(iter(events))), steady


def errors_ns(found: Sequence[Event], right: Sequence[Event]) -> list[int]:
    return [a.time_ns - b.time_ns for a, b in zip(found, right, strict=True)]


@pytest.mark.parametrize(
    "step_s", [3600.0, -3600.0, 7200.0, 86_400.0, 30.0, -600.0, 5.0, -5.0, 0.5, -0.5, 1.0e9, -1.0e9]
)
def test_a_step_of_the_capturing_clock_is_found_by_the_lidars_and_taken_off(step_s: float) -> None:
    right = lidar_events()
    found, steady = put_right(stamped(right, lambda i, t: t + round(step_s * 1e9) * (i >= 200)))
    # the first stamp behind the step is replaced by the lidar's time; its jitter, 0.3 ms, stays in all that follow
    assert max(map(abs, errors_ns(found, right))) <= 300_000
    assert [e.data for e in found] == [e.data for e in right]
    assert (steady.steps_ahead, steady.steps_back, steady.wild_stamps) == (int(step_s > 0), int(step_s < 0), 0)
    assert steady.stepped_ns == pytest.approx(-step_s * 1e9, abs=300_000)


@pytest.mark.parametrize("place", [0, 1, 7, 200, 399])
@pytest.mark.parametrize(
    "wild_ns", [5 * NS_PER_S, (1 << 31) * NS_PER_S, ((1 << 32) - 1) * NS_PER_S, START_NS + HOUR_NS]
)
def test_a_wild_stamp_is_mended_wherever_it_is(place: int, wild_ns: int) -> None:
    right = lidar_events()
    found, steady = put_right(stamped(right, lambda i, t: wild_ns if i == place else t))
    assert max(map(abs, errors_ns(found, right))) <= 300_000
    assert (steady.wild_stamps, steady.steps_ahead, steady.steps_back) == (1, 0, 0)


def test_many_wild_stamps_are_mended_one_by_one() -> None:
    right, rng = lidar_events(2000), random.Random(3)
    wild = set(rng.sample(range(2000), 100))
    found, steady = put_right(stamped(right, lambda i, t: rng.randrange(1 << 32) * NS_PER_S if i in wild else t))
    assert max(map(abs, errors_ns(found, right))) <= 300_000
    assert steady.wild_stamps == 100


def test_a_clock_set_by_an_hour_and_back_is_two_steps() -> None:
    right = lidar_events()
    found, steady = put_right(stamped(right, lambda i, t: t + HOUR_NS * (100 <= i < 200)))
    assert max(map(abs, errors_ns(found, right))) <= 600_000
    assert (steady.steps_ahead, steady.steps_back) == (1, 1)


def test_a_silence_is_a_silence_and_a_lidar_that_is_set_is_the_lidar() -> None:
    """Both clocks went on: 100 s, and an hour and 20 s. Only the lidar's did: it locked to its GPS."""
    for silence_ns in (100 * NS_PER_S, HOUR_NS + 20 * NS_PER_S, 12 * HOUR_NS + 1000 * NS_PER_S):
        quiet = silence_ns % HOUR_NS // 1000
        later = lidar_events(200, (3_599_900_000 + 200 * PACKET_NS // 1000 + quiet) % 3_600_000_000)
        late_ns = 200 * PACKET_NS + silence_ns
        right = lidar_events(200) + [e._replace(time_ns=e.time_ns + late_ns) for e in later]
        found, steady = put_right(right)
        assert errors_ns(found, right) == [0] * 400
        assert (steady.steps_ahead, steady.steps_back, steady.wild_stamps) == (0, 0, 0)
    after = [e._replace(time_ns=e.time_ns + 200 * PACKET_NS) for e in lidar_events(200, 1_234_000_000)]
    right = lidar_events(200) + after
    found, steady = put_right(right)
    assert errors_ns(found, right) == [0] * 400
    assert (steady.steps_ahead, steady.steps_back, steady.wild_stamps) == (0, 0, 0)


def test_packets_are_given_in_the_order_in_which_they_were_sent() -> None:
    """With their stamps or without: neighbours swapped, one late by 60 packets."""
    right = lidar_events()
    order = list(range(400))
    for i in range(0, 300, 4):
        order[i], order[i + 1] = order[i + 1], order[i]
    order.insert(380, order.pop(320))
    for keeps_stamp in (True, False):
        shuffled = [
            right[k] if keeps_stamp else right[k]._replace(time_ns=right[i].time_ns) for i, k in enumerate(order)
        ]
        found, steady = put_right(shuffled)
        assert [e.data for e in found] == [e.data for e in right]
        times = [e.time_ns for e in found]
        assert times == sorted(times)
        assert steady.out_of_order == 76
        assert (steady.wild_stamps, steady.steps_back, steady.steps_ahead) == (0, 0, 0)
        # what came late has the time of what it was to precede, never a later one
        assert max(map(abs, errors_ns(found, right))) <= 2 * PACKET_NS + 300_000


def test_swapped_neighbours_add_nothing_to_the_time_of_what_follows() -> None:
    """Packets 60 ms apart, every other pair swapped: the last one's time is its own."""
    right = [e._replace(time_ns=START_NS + i * 60 * NS_PER_MS) for i, e in enumerate(lidar_events(400))]
    data = [bytearray(e.data) for e in right]
    for i, each in enumerate(data):
        each[1200:1204] = (1_000_000 + i * 60_000).to_bytes(4, "little")
    right = [e._replace(data=bytes(d)) for e, d in zip(right, data, strict=True)]
    swapped = list(right)
    for i in range(0, 398, 4):
        swapped[i], swapped[i + 1] = swapped[i + 1], swapped[i]
    found, steady = put_right(swapped)
    assert errors_ns(found, right) == [0] * 400
    assert (steady.out_of_order, steady.steps_back) == (100, 0)


def test_a_recording_that_gets_its_date_on_the_way_has_it_from_the_first_packet_on() -> None:
    right = lidar_events()
    found, steady = put_right(stamped(right, lambda i, t: t if i >= 200 else t - START_NS + 300 * NS_PER_S))
    assert max(map(abs, errors_ns(found, right))) <= 300_000
    assert steady.steps_ahead == 1
    assert steady.moved_ns == pytest.approx(START_NS - 300 * NS_PER_S, abs=300_000)


def test_a_recording_without_any_date_begins_where_the_others_do() -> None:
    right = lidar_events()
    undated = stamped(right, lambda _, t: t - START_NS + 300 * NS_PER_S)
    beyond = stamped(right, lambda _, t: t - START_NS + (1 << 31) * NS_PER_S)
    other = start_of(lambda: iter(right))
    for events in (undated, beyond):
        assert moves([start_of(lambda events=events: iter(events)), other])[0] + events[0].time_ns == right[0].time_ns
    # alone it keeps its stamps, if a log can hold them
    assert moves([start_of(lambda: iter(undated)), None]) == [0, 0]
    alone, _ = put_right(beyond)
    assert 0 <= alone[0].time_ns < DAY_NS


def test_undated_recordings_of_one_computer_keep_its_clock_between_them() -> None:
    stated = 1_779_271_923 * NS_PER_S
    lidar, link = Start(0, False, 300 * NS_PER_S, stated - NS_PER_S), Start(0, False, 301 * NS_PER_S, stated)
    assert moves([lidar, link]) == [stated - NS_PER_S] * 2
    assert moves([Start(0, False, 300 * NS_PER_S, None), link]) == [stated] * 2
    # of two computers, each as its devices state it
    assert moves([Start(0, False, 900 * NS_PER_S, stated - 600 * NS_PER_S), link]) == [stated - 600 * NS_PER_S, stated]


@pytest.fixture
def telemetry(cases: Path) -> Iterator[list[Event]]:
    """A link's frames of 14 s, as recorded."""
    path = cases / "nan_attitude/t.tlog"
    source = Tlog(path, "ins", path)
    yield list(source.events())
    source.close()


@pytest.mark.parametrize("step_s", [3600.0, -3600.0, 60.0, -5.0, 86_400.0])
def test_the_autopilots_clock_tells_a_step_of_the_ground_stations(telemetry: list[Event], step_s: float) -> None:
    middle = len(telemetry) // 2
    found, steady = put_right(stamped(telemetry, lambda i, t: t + round(step_s * 1e9) * (i >= middle)))
    # to the jitter of this link's messages
    assert max(map(abs, errors_ns(found, telemetry))) < 60 * NS_PER_MS
    assert [e.data for e in found] == [e.data for e in telemetry]
    assert (steady.steps_ahead, steady.steps_back) == (int(step_s > 0), int(step_s < 0))


@pytest.mark.parametrize("step_s", [0.7, 1.0, 2.0, 2.9, 3.5, -0.7, -2.0])
@pytest.mark.parametrize("case", ["nan_attitude", "two_vehicles"])
def test_a_step_no_longer_than_a_radio_delays_is_told_by_what_follows(cases: Path, step_s: float, case: str) -> None:
    path = cases / case / "t.tlog"
    source = Tlog(path, "ins", path)
    right = list(source.events())
    source.close()
    middle = len(right) // 2
    found, steady = put_right(stamped(right, lambda i, t: t + round(step_s * 1e9) * (i >= middle)))
    # messages without a clock of their own just before the step get the time of the next one with one; order is restored
    assert max(map(abs, errors_ns(found, right))) < 120 * NS_PER_MS
    assert (steady.steps_ahead, steady.steps_back) == (int(step_s > 0), int(step_s < 0))


def test_a_radio_that_delays_for_seconds_is_no_step(cases: Path) -> None:
    """As a stalled link does: what was sent in two seconds comes at their end."""
    path = cases / "nan_attitude/t.tlog"
    source = Tlog(path, "ins", path)
    right = list(source.events())
    source.close()
    begin_ns, end_ns = right[200].time_ns, right[200].time_ns + 2 * NS_PER_S
    late = stamped(right, lambda i, t: end_ns if begin_ns <= t < end_ns else t)
    found, steady = put_right(late)
    assert errors_ns(found, late) == [0] * len(late)
    assert (steady.steps_ahead, steady.steps_back) == (0, 0)


@pytest.mark.parametrize("name", ["arducopter313_sim", "ardusub_2023", "copter_flight_2015"])
def test_recorded_links_are_left_as_they_are(recordings: Path, name: str) -> None:
    path = recordings / f"mavlink/{name}.tlog"
    source = Tlog(path, "ins", path)
    plain = list(source._as_stamped(source.count))
    found, steady = put_right(plain)
    source.close()
    assert errors_ns(found, plain) == [0] * len(plain)
    assert (steady.out_of_order, steady.wild_stamps, steady.steps_back, steady.steps_ahead) == (0, 0, 0, 0)


def test_a_recorded_lidar_is_left_as_it_is(recordings: Path) -> None:
    for name in ("hdl32e_monterey", "vlp16_gps"):
        source = Capture(recordings / f"lidar/{name}.pcap", Ports(), "ins")
        plain = list(source._as_stamped())
        found, steady = put_right(plain)
        source.close()
        assert errors_ns(found, plain) == [0] * len(plain)
        assert (steady.out_of_order, steady.wild_stamps, steady.steps_back, steady.steps_ahead) == (0, 0, 0, 0)


# The cases ------------------------------------------------------------------------------------------------------------


def imported(tmp_path: Path, *words: object) -> Path:
    log = tmp_path / "a.mcap"
    assert main(["import", *map(str, words), "-o", str(log)]) == 0
    return log


def info(log: Path) -> dict[str, object]:
    with LogReader(log) as reader:
        return summarise(reader)


@pytest.mark.parametrize("name", ["stamp_1970", "stamp_2038"])
def test_case_of_a_wild_stamp(cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    log = imported(tmp_path, "--pcap", cases / f"{name}.pcap")
    assert "1 stamps were wild" in capsys.readouterr().err
    with LogReader(log) as reader:
        (message,) = reader.messages((records.LIDAR.topic,))
        packets = records.decode_scan(message.data)
    # 553 us by the lidar's clock from packet to packet
    assert np.diff(records.receive_time_ns(packets)).tolist() == [553_000, 630_000]
    assert len(packets) == 3


def test_case_of_packets_out_of_order(cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = imported(tmp_path, "--pcap", cases / "reordered.pcap")
    assert "5 packets or frames were out of order" in capsys.readouterr().err
    lidar = info(log)["lidar"]
    assert isinstance(lidar, dict)
    assert (lidar["packets"], lidar["lost_packets"], lidar["out_of_order"]) == (40, 0, 0)


def test_case_of_an_hours_step(cases: Path, tmp_path: Path) -> None:
    log = imported(tmp_path, "--pcap", cases / "hour_step/l.pcap", "--mavlink", cases / "hour_step/t.tlog")
    found = info(log)
    assert str(found["end_utc"]).startswith("2026-05-20T10:17:15")
    assert (found["gap_count"], found["messages_backwards"]) == (0, 0)
    mavlink = found["mavlink"]
    assert isinstance(mavlink, dict)
    (autopilot,) = mavlink["ins"]["autopilots"]
    assert len(autopilot["boots"]) == 1


@pytest.mark.parametrize(("name", "frames"), [("t", 20), ("step", 40)])
def test_case_of_a_computer_without_a_clock(cases: Path, tmp_path: Path, name: str, frames: int) -> None:
    folder = cases / "tlog_1970"
    log = imported(tmp_path, "--pcap", folder / "l.pcap", "--mavlink", folder / f"{name}.tlog")
    found = info(log)
    mavlink = found["mavlink"]
    assert isinstance(mavlink, dict)
    assert (mavlink["ins"]["frames"], mavlink["ins"]["bad_bytes"]) == (frames, 0)
    # SYSTEM_TIME in it, or its later stamps, say when it was
    assert str(found["start_utc"]).startswith("2026-05-20T10:17:0")
