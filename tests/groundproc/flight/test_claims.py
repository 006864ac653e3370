"""Absolute times held against each other."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.clock import utc_text
from flightlog.errors import ClockError
from flightlog.logfile import LogReader
from flightlog.mavlink import FrameParser
from flightlog.mount import Mount
from groundproc.cli import main
from groundproc.flight.claims import FIRST_NS, GPRMC, HOST, SYSTEM_TIME, settled
from groundproc.flight.flight import read_flight
from groundproc.flight.importers.tlog import TlogCount
from groundproc.flight.importers.tlog import records as tlog_records
from groundproc.flight.pairing import legs
from groundproc.flight.summary.log import summarise
from groundproc.flight.summary.telemetry import TelemetrySummary
from groundproc.steps.clocks import describe_leg

S = 10**9
NOW = 1_779_274_790 * S
ERA = 1024 * 7 * 86_400 * S


def test_claims_that_agree_are_left_alone() -> None:
    found = settled({GPRMC: NOW, SYSTEM_TIME: NOW - S // 10, HOST: NOW + 700 * S})
    assert (dict(found.add_ns), found.mended, found.doubts) == ({GPRMC: 0, SYSTEM_TIME: 0, HOST: 0}, (), ())


@pytest.mark.parametrize("eras", [1, 2])
@pytest.mark.parametrize("name", [GPRMC, SYSTEM_TIME])
def test_a_receiver_that_is_eras_behind_is_brought_to_the_others(name: str, eras: int) -> None:
    claims = {GPRMC: NOW, SYSTEM_TIME: NOW, HOST: NOW + 3600 * S}
    claims[name] -= eras * ERA
    found = settled(claims)
    assert found.add_ns[name] == eras * ERA
    (said,) = found.mended
    assert f"{eras * 1024} weeks behind" in said
    assert utc_text(NOW) in said


def test_both_receivers_behind_are_told_by_the_computer_or_by_what_there_was() -> None:
    behind = {GPRMC: NOW - ERA, SYSTEM_TIME: NOW - ERA}
    for others in ({HOST: NOW + 86_400 * S}, {HOST: 300 * S}, {}):
        found = settled(behind | others)
        assert NOW - ERA < FIRST_NS
        assert (found.add_ns[GPRMC], found.add_ns[SYSTEM_TIME]) == (ERA, ERA)
        assert len(found.mended) == 2


@pytest.mark.parametrize("leaps", [1, 2, 18])
@pytest.mark.parametrize("ahead", [GPRMC, SYSTEM_TIME])
def test_whole_leap_seconds_are_taken_off_the_one_that_is_ahead(ahead: str, leaps: int) -> None:
    claims = {GPRMC: NOW, SYSTEM_TIME: NOW - 150_000_000, HOST: NOW + 41 * S}
    claims[ahead] += leaps * S
    found = settled(claims)
    assert found.add_ns[ahead] == -leaps * S
    assert f"{leaps} whole seconds ahead" in found.mended[0]
    # a computer whose clock was right bears out the other
    claims[HOST] = claims[ahead] + 10_000_000
    other = GPRMC if ahead == SYSTEM_TIME else SYSTEM_TIME
    assert settled(claims).add_ns[other] == leaps * S


def test_what_nothing_explains_is_a_doubt() -> None:
    found = settled({GPRMC: NOW, SYSTEM_TIME: NOW + 7 * S + 550_000_000, HOST: NOW})
    assert dict(found.add_ns) == {GPRMC: 0, SYSTEM_TIME: 0, HOST: 0}
    assert "contradict each other by 7.5 s" in found.doubts[0] or "by 7.6 s" in found.doubts[0]


def test_a_date_that_cannot_be_is_no_claim() -> None:
    never = 29_617_920_000 * S  # 2908
    found = settled({SYSTEM_TIME: never, HOST: NOW})
    assert SYSTEM_TIME not in found.add_ns
    assert "which cannot be" in found.doubts[0]


def test_a_receiver_that_knows_no_date_says_the_first_of_an_era() -> None:
    epoch = 315_964_800 * S
    for utc_ns in (epoch + 40 * S, epoch + ERA + 3600 * S):
        assert GPRMC not in settled({GPRMC: utc_ns, HOST: NOW}).add_ns


def test_info_never_calls_a_date_known_that_cannot_be() -> None:
    summary, sender = TelemetrySummary(), dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    never_us, now_us = 29_617_920_000 * 10**6, NOW // 1000
    for number, unix_us in enumerate((0, never_us, now_us)):
        message = dialect.MAVLink_system_time_message(unix_us, 1000 * number)
        for frame in FrameParser().feed(NOW, bytes(message.pack(sender))):
            summary.add(frame)
    found = summary.result(0, 0)
    assert found["first_system_time_utc"] == utc_text(NOW)
    assert found["impossible_system_times"] == 1


def test_case_of_a_receiver_an_era_behind(cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, folder = tmp_path / "a.mcap", cases / "rmc_week_rollover"
    assert main(["import", "--pcap", str(folder / "l.pcap"), "--mavlink", str(folder / "t.tlog"), "-o", str(log)]) == 0
    with LogReader(log) as reader:
        flight = read_flight([reader], "ins")
        summary: dict[str, Any] = summarise(reader)
    assert summary["utc"]["right"][GPRMC].startswith("2026-05-20T10:59:5")
    main(["info", str(log)])
    assert "1024 weeks behind" in capsys.readouterr().out
    (leg,) = legs(flight.runs, flight.boots, Mount().mat_ins_lidar(), "auto")
    start_ns = int(leg.utc_from_lidar(np.array([flight.runs[0].line.device_ns(leg.first_receive_ns)]))[0])
    # 2026-05-20T10:59:50Z by SYSTEM_TIME and the lidar's own second; the capture's computer was a second ahead of both
    assert utc_text(start_ns).startswith("2026-05-20T10:59:5")
    assert leg.utc.source == GPRMC
    said = describe_leg(leg)["utc"]
    assert "1024 weeks behind" in said["mended"][0]
    assert said["warnings"] == []


def test_receive_times_of_another_rate_than_the_autopilots_clock_tie_nothing(cases: Path, tmp_path: Path) -> None:
    """A link whose autopilot's clock runs at 4.3 times the receive times, as in one recorded log: no sigma makes that a tie."""
    folder, log, link = cases / "two_vehicles", tmp_path / "a.mcap", tmp_path / "t.tlog"
    count = TlogCount()
    frames = [(t, data) for t, data in tlog_records((cases / "two_vehicles/t.tlog").read_bytes(), count)]
    first_ns = frames[0][0]
    stamps_us = [(first_ns + round((t - first_ns) / 4.3)) // 1000 & ~3 for t, _ in frames]
    link.write_bytes(b"".join(us.to_bytes(8, "big") + data for us, (_, data) in zip(stamps_us, frames, strict=True)))
    assert main(["import", "--pcap", str(folder / "l.pcap"), "--mavlink", str(link), "-o", str(log)]) == 0
    with LogReader(log) as reader:
        flight = read_flight([reader], "ins")
    with pytest.raises(
        ClockError, match=r"autopilot: its clock ran at 4\.(3|29)\d* times the receive times, expected 1 within 300 ppm"
    ):
        legs(flight.runs, flight.boots, Mount().mat_ins_lidar(), "host")
