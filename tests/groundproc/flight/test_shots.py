"""A flight's shots come in pieces that bound the memory, however the log was cut into messages."""

from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest

from flightlog import hdl32e
from flightlog.constants import NS_PER_S
from flightlog.logfile import LogReader
from groundproc.cli import main
from groundproc.field.madeup import write_flight
from groundproc.flight.flight import read_flight
from groundproc.flight.mounting import find_mount
from groundproc.flight.pairing import legs
from groundproc.flight.shots import Tally, shots
from groundproc.flight.summary.lidar import LidarSummary
from groundproc.flight.timeline import Leg
from groundproc.sensors.shots import Gate

MESSAGE_S = 0.1
"""Of a made-up flight's log."""


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[LogReader]:
    write_flight(tmp_path / "flight.mcap", 4.0)
    with LogReader(tmp_path / "flight.mcap") as reader:
        yield reader


def timeline_of(reader: LogReader) -> list[Leg]:
    flight = read_flight([reader], "ins", lambda done: None)
    mount, _ = find_mount(None, [reader])
    return list(legs(flight.runs, flight.boots, mount.mat_ins_lidar(), "auto"))


def test_a_piece_is_half_a_second_and_no_shot_is_lost_between_two(reader: LogReader) -> None:
    tally = Tally()
    pieces = list(shots([reader], timeline_of(reader), Gate(), tally=tally))
    spans_s = [float(np.ptp(piece.time_ns)) / NS_PER_S for piece in pieces]
    assert max(spans_s) < 0.5 + MESSAGE_S
    assert len(pieces) <= 4.0 / 0.5
    # with one return a shot, each is a point, or is counted as none
    gated = [sum(astuple(piece.gated)) for piece in pieces]
    assert sum(map(len, pieces)) + sum(gated) == tally.packets * hdl32e.BLOCKS * hdl32e.LASERS
    times = np.concatenate([piece.time_ns for piece in pieces])
    assert (np.diff(times) > 0).all()


def test_shots_are_the_same_where_nobody_counts_and_packets_are_not_looked_through(
    reader: LogReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    timeline, counted = timeline_of(reader), Tally()
    pieces = list(shots([reader], timeline, Gate(), tally=counted))
    assert counted.packets
    monkeypatch.setattr(LidarSummary, "add", None)
    for piece, same in zip(pieces, shots([reader], timeline, Gate()), strict=True):
        np.testing.assert_array_equal(piece.xyz_m, same.xyz_m)
        np.testing.assert_array_equal(piece.time_ns, same.time_ns)


def test_packets_that_a_capture_lacks_are_counted_though_no_recorder_says_so(recordings: Path, tmp_path: Path) -> None:
    thinned, log = tmp_path / "thinned.pcap", tmp_path / "a.mcap"
    whole = (recordings / "lidar/hdl32e_monterey.pcap").read_bytes()
    kept, place, data_packets, left_out = whole[:24], 24, 0, 0
    while place < len(whole):
        size = 16 + int.from_bytes(whole[place + 8 : place + 12], "little")
        is_data = size > hdl32e.DATA_BYTES
        data_packets += is_data
        if is_data and data_packets % 7 == 3:
            left_out += 1
        else:
            kept += whole[place : place + size]
        place += size
    thinned.write_bytes(kept)
    assert main(["import", "--pcap", str(thinned), "-o", str(log)]) == 0
    with LogReader(log) as opened:
        tally = Tally()
        assert list(shots([opened], [], Gate(), tally=tally)) == []
    assert (tally.packets, tally.lost_packets) == (data_packets - left_out, left_out)
