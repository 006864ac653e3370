"""The simulated log on the autopilot's card, as pymavlink's own reader has it."""

import io
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from pymavlink import DFReader

from flightlog import dataflash
from simulator import boardlog
from simulator.clocks import clocks
from simulator.config import Options
from simulator.simulation import Job, Simulation


@pytest.fixture(scope="module")
def theirs(plain_flight: Any) -> dict[str, list[Any]]:
    reader = DFReader.DFReader_binary(str(plain_flight.board))
    found: dict[str, list[Any]] = {}
    while (entry := reader.recv_msg()) is not None:
        found.setdefault(entry.get_type(), []).append(entry)
    reader.data_map.close()
    reader.filehandle.close()
    return found


def test_every_message_reads_as_pymavlink_has_it(plain_flight: Any, theirs: dict[str, list[Any]]) -> None:
    ours = dataflash.parse(plain_flight.board.read_bytes(), "board.bin")
    assert ours.bad_bytes == 0
    assert ours.counts == {name: len(rows) for name, rows in theirs.items() if name != "FMT"}
    for name in ("IMU", "ATT", "POS", "GPS", "GPA", "BARO", "XKF1", "MAG", "PARM", "MODE"):
        table = ours.tables[name]
        for field in table.dtype.names or ():
            if table.dtype[field].kind != "S":
                expected = np.array([getattr(row, field) for row in theirs[name]], np.float64)
                assert np.allclose(table[field].astype(np.float64), expected, rtol=1e-12, atol=0.0), (name, field)


def test_rates_are_those_asked_for_and_the_order_is_that_of_time(theirs: dict[str, list[Any]]) -> None:
    for name, rate_hz in (("IMU", 50), ("ATT", 25), ("POS", 10), ("GPS", 5), ("BARO", 10)):
        steps = np.diff([row.TimeUS for row in theirs[name]])
        assert steps.mean() == pytest.approx(1e6 / rate_hz, rel=1e-3), name


def test_the_time_of_a_fix_is_that_of_its_epoch(plain_flight: Any, theirs: dict[str, list[Any]]) -> None:
    truth = plain_flight.truth["clocks"]
    for row in theirs["GPS"][:3]:
        # GPS time is 18 s ahead of UTC since 2017
        utc_s = datetime(1980, 1, 6, tzinfo=UTC).timestamp() + row.GWk * 604_800 + row.GMS * 1e-3 - 18
        boot_s = row.TimeUS * 1e-6 - truth["boot"]["start_ns"] * 1e-9
        assert utc_s == pytest.approx(truth["utc"]["start_ns"] * 1e-9 + boot_s - boardlog.FIX_LATE_S, abs=2e-3)


def test_units_are_declared_for_every_field() -> None:
    for kind in boardlog.KINDS:
        assert len(kind.labels.split(",")) == len(kind.letters) == len(kind.units) == len(kind.multipliers), kind.name


def test_a_reboot_ends_the_log(tmp_path: Any) -> None:
    options = Options()
    options = replace(options, faults=replace(options.faults, reboot_at_s=0.5, reboot_silence_s=1.0))
    simulation = Simulation(Job("field", 2.0, 5, tmp_path, options))
    stream = io.BytesIO()
    log = boardlog.BoardLog(stream, simulation.ins, clocks(options.clocks), options, simulation.origin, 5)
    for chunk in range(20):
        log.add(chunk * 0.1, chunk * 0.1 + 0.1, chunk)
    found = dataflash.parse(stream.getvalue(), "board.bin")
    assert found.counts["IMU"] == 25
